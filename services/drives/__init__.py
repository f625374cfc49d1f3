"""Measurements of a truck, from CSV files, other recordings or a simulation."""
