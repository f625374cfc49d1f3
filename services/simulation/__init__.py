"""Simulated crossings, of a known truth or drawn from ranges."""
