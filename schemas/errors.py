"""The error for files and options that are wrong, as users read it."""


class InputError(ValueError):
    """An error in the input: one line that names the file, the field and what would be right.

    The command line prints the line and exits with code 2.
    """

    def __init__(self, line: str) -> None:
        super().__init__(one_line(line))


def one_line(text: str) -> str:
    """Return a text without line breaks and terminal control characters.

    Names in files and messages are not trusted.
    """
    spaced = " ".join(text.split())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in spaced)
