"""The command `driveby`, also as `python -m driveby`."""

import sys

from services.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
