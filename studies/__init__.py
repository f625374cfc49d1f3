"""Studies of the program: they run from the checkout and are not part of the wheel."""
