"""Functions for notebooks, without a bus: read, identify, simulate (`import driveby`)."""
