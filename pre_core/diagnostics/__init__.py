"""Diagnostics of signals, of a fit, and of many crossings."""
