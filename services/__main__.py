"""`python -m services` is `driveby`."""

import sys

from services.cli import main

sys.exit(main())
