"""Reproduction of the paper's twelve scenarios."""
