"""A bridge over years: observations of its change, and their significance."""
