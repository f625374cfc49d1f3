"""Where identifications run: here, in processes, or elsewhere."""
