"""Pictures of recordings and results: figures as PNG or SVG, and files for the Rerun viewer."""
