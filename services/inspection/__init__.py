"""Checks of truck, site file and recordings before a survey."""
