"""What several crossings of one bridge say together."""
