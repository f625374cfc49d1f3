"""Credentials for the bus, and access control by role."""
