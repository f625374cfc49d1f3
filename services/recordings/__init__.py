"""MCAP files: written so that they stay readable, read even if damaged, recovered."""
