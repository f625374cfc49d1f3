"""Crossings that were never driven: of a known truth, or drawn from ranges."""
