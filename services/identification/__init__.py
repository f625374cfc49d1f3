"""From messages to crossings and from a crossing to a result. No I/O, no clock."""
