"""The command `driveby` as a process that ends with the tests that have started it."""

import os
import sys

from services.cli.main import main
from services.cluster import run as cluster
from services.execution import scheduler
from tests.parent import die_with_parent


def hurry() -> None:
    """Take seconds for what takes a minute, where a test says so."""
    cluster.FROZEN_S = float(os.environ.get("DRIVEBY_TEST_FROZEN_S", "600"))
    scheduler.CALL_S = float(os.environ.get("DRIVEBY_TEST_CALL_S", scheduler.CALL_S))


if __name__ == "__main__":
    die_with_parent()
    hurry()
    sys.exit(main(sys.argv[1:]))
