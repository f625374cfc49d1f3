"""The live service that identifies crossings."""
