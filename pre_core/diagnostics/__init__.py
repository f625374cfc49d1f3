"""What numbers can be trusted for: of signals, of a fit, of many crossings."""
