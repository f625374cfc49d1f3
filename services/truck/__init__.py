"""Publication of what a truck measures."""
