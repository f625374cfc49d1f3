"""MCAP files: written to stay readable, read even if damaged, recovered."""
