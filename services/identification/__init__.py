"""Identification of a detected crossing, up to its published result. No I/O, no clock."""
