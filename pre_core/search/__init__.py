"""Search methods, one file each and all of one form, and the loop that runs them."""
