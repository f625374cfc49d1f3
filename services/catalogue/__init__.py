"""Contents of recordings: of one file, and of a folder of them."""
