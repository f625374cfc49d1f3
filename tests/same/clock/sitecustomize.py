"""Stop the clocks of every Python process that finds this folder on its path.

The stopwatch stands at zero, so that a result does not contain how long it took. Where
`DRIVEBY_SAME_CLOCK` names a moment (s since 1970 UTC), that is the time of day, too.
"""

import os
import time

time.perf_counter = lambda: 0.0
if moment := os.environ.get("DRIVEBY_SAME_CLOCK"):
    now_s = int(moment)
    time.time = lambda: float(now_s)
    time.time_ns = lambda: now_s * 1_000_000_000
