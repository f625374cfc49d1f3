"""A truck as a process: four channels of 50 samples and now and then a fix, until SIGTERM.

Says `BOOT SEQUENCE` of every batch after it was handed over, so that a test knows what must arrive
even if the process is killed in the next moment.

    python truck_process.py ENDPOINT REALM VEHICLE SPOOL BATCHES_PER_S
"""

import os
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

from schemas.signals import CHANNELS, AccelChannel, GnssFix
from services.bus.playback import stopped_by_signals
from services.bus.session import open_session
from services.truck.gateway import Gateway
from services.truck.spool import Spool
from tests.parent import die_with_parent

STEP_ENV = "DRIVEBY_TEST_CLOCK_STEP"
"""`AFTER_BATCHES:SECONDS`: the wall clock jumps."""


def main(endpoint: str, realm: str, vehicle: str, spool: str, batches_per_s: str) -> None:
    period_s = 1.0 / float(batches_per_s)
    after, _, jump_s = os.environ.get(STEP_ENV, "0:0").partition(":")
    channel = AccelChannel(1000.0, np.random.default_rng(1).standard_normal(50))
    with stopped_by_signals() as stop:
        connect = partial(open_session, connect=endpoint, timeout_s=0.0)
        gateway = Gateway(connect, realm, vehicle, Spool(Path(spool)))
        now = {"device_time_ns": time.monotonic_ns(), "wall_time_ns": time.time_ns()}
        gateway.info(f'[vehicle]\nid = "{vehicle}"\n', **now)
        number = 0
        due = time.monotonic()
        while not stop.is_set():
            device_ns, wall_ns = time.monotonic_ns(), time.time_ns()
            if int(after) and number >= int(after):
                wall_ns += int(jump_s) * 1_000_000_000
            gateway.accel(
                dict.fromkeys(CHANNELS, channel), device_time_ns=device_ns, wall_time_ns=wall_ns
            )
            if number % 2 == 0:
                gateway.gnss(GnssFix(0, 0, device_ns, wall_ns, 50.0, 8.0, 100.0, 10.0))
            print(gateway.boot_id, number, flush=True)
            number += 1
            due += period_s
            time.sleep(max(0.0, due - time.monotonic()))
        deadline = time.monotonic() + 240.0
        # A logger that is about to come back has not spoken yet.
        while (missing := gateway.delivery.wait(1.0)) and time.monotonic() < deadline:
            pass
        print(f"missing {missing} deferred {gateway.deferred}", flush=True)
        gateway.close()


if __name__ == "__main__":
    die_with_parent()
    main(*sys.argv[1:])
