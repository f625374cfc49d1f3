"""Ways to search, one file each and all of one shape, and the one loop that runs them."""
