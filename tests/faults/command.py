"""The command `driveby` as a process that ends with the tests that have started it."""

import sys

from services.cli.main import main
from tests.parent import die_with_parent

if __name__ == "__main__":
    die_with_parent()
    sys.exit(main(sys.argv[1:]))
