"""Functions that several services need; imports none of the services."""
