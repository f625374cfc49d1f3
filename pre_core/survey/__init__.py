"""How well a bridge will be known, and what damage will be seen, before anyone drives."""
