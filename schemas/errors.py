"""What a person gets to read when a file or an option that they gave is wrong."""


class InputError(ValueError):
    """Bad input: one line that names the file, the field and what would be right.

    The command line prints the line and leaves with exit code 2.
    """

    def __init__(self, line: str) -> None:
        super().__init__(one_line(line))


def one_line(text: str) -> str:
    """A text without line breaks, and without what a terminal would obey rather than show.

    Names in files and messages may be anybody's.
    """
    spaced = " ".join(text.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in spaced)
