"""Estimates from several crossings of one bridge."""
