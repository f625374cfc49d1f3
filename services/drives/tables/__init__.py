"""Tables in the forms of loggers' vendors, read as runs of a drive."""
