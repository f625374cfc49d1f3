"""Executors of identifications: inline, in processes, or on a cluster."""
