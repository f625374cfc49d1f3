"""What several services need. Imports none of them."""
