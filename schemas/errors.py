"""What a person gets to read when a file or an option that they gave is wrong."""


class InputError(ValueError):
    """Bad input: one line that names the file, the field and what would be right.

    The command line prints the line and leaves with exit code 2.
    """

    def __init__(self, line: str) -> None:
        super().__init__(" ".join(line.split()))
