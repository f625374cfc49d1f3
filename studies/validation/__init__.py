"""Validation of method `pre` against simulated crossings of known truth."""
