"""Figures of recordings and results as PNG or SVG, and files for the Rerun viewer."""
