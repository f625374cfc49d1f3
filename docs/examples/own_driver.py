"""A driver for sensors of your own: `python own_driver.py ENDPOINT SPOOL_FOLDER`, until Ctrl-C."""

import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

from schemas.signals import AccelChannel, GnssFix
from services.bus.playback import stopped_by_signals
from services.bus.session import open_session
from services.truck.gateway import Gateway
from services.truck.spool import Spool

SITE = '[vehicle]\nid = "truck-1"\n'  # your truck's part of the site file

connect = partial(open_session, connect=sys.argv[1], timeout_s=0.0)
with stopped_by_signals() as stop:
    gateway = Gateway(connect, "live", "truck-1", Spool(Path(sys.argv[2])))
    gateway.info(SITE, device_time_ns=time.monotonic_ns(), wall_time_ns=time.time_ns())
    while not stop.wait(0.05):
        # Replace these two lines by your own: 50 ms at 1 kHz, m/s², up, without gravity.
        now = {"device_time_ns": time.monotonic_ns(), "wall_time_ns": time.time_ns()}
        front, rear = np.random.default_rng().standard_normal((2, 50))
        channels = {
            "sprung_front": AccelChannel(1000.0, front),
            "unsprung_rear": AccelChannel(1000.0, rear),
        }
        gateway.accel(channels, **now)
        gateway.gnss(GnssFix(0, 0, *now.values(), 50.0, 8.0, 100.0, speed_m_per_s=10.0))
    gateway.delivery.wait(10.0)  # what does not arrive in time stays in the spool
    gateway.close()
