"""Credentials for the bus, and who may say and hear what on it."""
