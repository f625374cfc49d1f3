"""Forecast of a survey before the drive, by simulated crossings of a site file."""
