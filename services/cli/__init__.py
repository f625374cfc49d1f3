"""The command `driveby`: one module per group of commands, their output, and the demo."""
