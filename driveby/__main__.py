"""The command `driveby`, also as `python -m driveby`."""

import sys

from services.cli.main import program

if __name__ == "__main__":
    sys.exit(program())
