"""Pictures of what was recorded and found: a figure as PNG, a recording for the Rerun viewer."""
