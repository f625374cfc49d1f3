"""`python -m services` is `driveby`."""

import sys

from services.cli.main import program

sys.exit(program())
