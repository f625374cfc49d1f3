"""Drawn crossings beyond the physics of the method, simulated by `services.simulation`."""
