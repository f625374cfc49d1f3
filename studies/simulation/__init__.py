"""Drawn crossings with physics that the method lacks, simulated by `services.simulation`."""
