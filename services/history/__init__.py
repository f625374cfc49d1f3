"""What is known of crossings: results on the disk, what was told, draws."""
