"""Publication of recordings, byte for byte, in a realm of their own."""
