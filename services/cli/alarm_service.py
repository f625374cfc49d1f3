"""`driveby alarm serve`: tells on the bus which bridges have changed, until somebody takes note."""

import contextlib
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from schemas.alarms import Alarm, encode_alarm
from services.bus.playback import leave_at_once, stopped_by_signals
from services.bus.publisher import Publisher
from services.bus.session import connected
from services.common.errors import FailureError, InputError
from services.history.alarm_files import acknowledged_since, alarms_of, standing
from services.history.alarms import Checked

_log = logging.getLogger(__name__)
_LOOK_S = 1.0
"""How often it looks whether somebody has acknowledged an alarm."""
_REMEMBERED_S: Final = 30 * 86_400.0
"""Acknowledgements of so long are told at the start: who heard an alarm, and not its end while this
service was not there, still shows it."""


class Teller:
    """Publishes each alarm when it is raised and when it is acknowledged, and no other time.

    Alarms are latched: the bridge's last one answers whoever comes later. What stands when the
    service starts, and what somebody took note of lately, is told first, so that a restart forgets
    nothing.
    """

    def __init__(self, put: Callable[[Alarm, bytes], None]) -> None:
        self._put = put
        self._standing: dict[tuple[str, str], Alarm] | None = None
        """None until something was told."""

    def tell(self, folder: Path, time_ns: int) -> None:
        """Tell what is new since the last time."""
        now = {(alarm.realm, alarm.bridge): alarm for alarm in standing(folder)[0]}
        if self._standing is None:
            for alarm in acknowledged_since(folder, time_ns / 1e9 - _REMEMBERED_S):
                self._put(alarm, encode_alarm(alarm, time_ns))
        before = self._standing or {}
        for whose, alarm in before.items():
            if whose in now and now[whose].alarm_id == alarm.alarm_id:
                continue
            for one in alarms_of(folder, *whose)[0]:
                if one.alarm_id == alarm.alarm_id and one.acknowledged is not None:
                    self._put(one, encode_alarm(one, time_ns))
        for whose, alarm in now.items():
            if whose not in before or before[whose].alarm_id != alarm.alarm_id:
                self._put(alarm, encode_alarm(alarm, time_ns))
        self._standing = now


def serve(
    folder: Path, check: Callable[[], Checked], endpoint: str, tls: Path | None, every_s: float
) -> int:
    """Check the history every so often and tell its alarms, until a signal; return 0.

    InputError or FailureError: the history cannot be looked at when it is looked at first. Later
    that is an error in the log, and it is tried again: what stands is told all the same.
    """
    publishers: dict[str, Publisher] = {}
    with stopped_by_signals(leave_at_once) as stop, contextlib.ExitStack() as stack:
        bus = connected(endpoint, tls, stop.is_set)
        if bus is None:
            return 0
        session = stack.enter_context(bus)

        def put(alarm: Alarm, payload: bytes) -> None:
            publisher = publishers.setdefault(alarm.realm, Publisher(session, alarm.realm))
            publisher.put("bridge", alarm.bridge, "alarm", payload)
            state = "acknowledged" if alarm.acknowledged else "stands"
            print(f"{alarm.bridge}: {alarm.sentence()}: {state}", flush=True)

        teller = Teller(put)
        teller.tell(folder, time.time_ns())  # a check may take minutes
        check()
        due_s = time.monotonic() + every_s
        while not stop.is_set():
            if time.monotonic() >= due_s:
                try:
                    check()
                except (InputError, FailureError) as error:
                    _log.error("%s; it is looked at again in %.0f s", error, every_s)
                due_s = time.monotonic() + every_s
            teller.tell(folder, time.time_ns())
            stop.wait(_LOOK_S)
        for publisher in publishers.values():
            publisher.close()
    return 0
