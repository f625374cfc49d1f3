"""The command `driveby`."""


def main() -> int:
    """Run the command line."""
    return 0
