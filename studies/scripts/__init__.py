"""Measurements behind the pages that `driveby validate` does not print."""
