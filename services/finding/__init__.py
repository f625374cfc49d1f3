"""Detection of crossings and their data in messages. No I/O, no clock, no validation record."""
