"""The command `driveby`: one file a group of commands, what they print, and the demo."""
