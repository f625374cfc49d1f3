"""Panels of a crossing in Rerun: a module each, with its layout and its drawing."""
