"""What runs: the command line, the services on the bus, and what they share."""
