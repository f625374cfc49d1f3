"""Command line, services on the bus, and their common parts."""
