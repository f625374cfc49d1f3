"""A report of results to hand over: one printable HTML file, and PDF through a browser."""
