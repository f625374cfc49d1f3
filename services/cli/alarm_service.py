"""The command `driveby alarm serve`: publish changed bridges until they are acknowledged."""

import contextlib
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from schemas.alarms import Alarm, encode_alarm
from services.bus.playback import leave_at_once, stopped_by_signals
from services.bus.publisher import Publisher
from services.bus.session import wait_for_router
from services.common.errors import FailureError, InputError
from services.history.alarm_files import acknowledged_since, active_alarms, alarms_of
from services.history.alarms import AlarmCheck

_log = logging.getLogger(__name__)
_POLL_S = 1.0
"""Interval in s at which acknowledgements are checked."""
_REMEMBERED_S: Final = 30 * 86_400.0
"""Age in s up to which acknowledgements are published at the start.

A subscriber that received an alarm, and not its end while this service was stopped, still shows it.
"""


class AlarmPublisher:
    """Publisher of each alarm, when it is raised and when it is acknowledged.

    Alarms are latched: a later subscriber receives the bridge's last one. Standing alarms and
    recent acknowledgements are published at the start, so that a restart loses nothing.
    """

    def __init__(self, put: Callable[[Alarm, bytes], None]) -> None:
        self._put = put
        self._active: dict[tuple[str, str], Alarm] | None = None
        """Published alarms; None before the first publication."""

    def publish_changes(self, folder: Path, time_ns: int) -> None:
        """Publish the changes since the last call."""
        now = {(alarm.realm, alarm.bridge): alarm for alarm in active_alarms(folder)[0]}
        if self._active is None:
            for alarm in acknowledged_since(folder, time_ns / 1e9 - _REMEMBERED_S):
                self._put(alarm, encode_alarm(alarm, time_ns))
        before = self._active or {}
        for whose, alarm in before.items():
            if whose in now and now[whose].alarm_id == alarm.alarm_id:
                continue
            for one in alarms_of(folder, *whose)[0]:
                if one.alarm_id == alarm.alarm_id and one.acknowledged is not None:
                    self._put(one, encode_alarm(one, time_ns))
        for whose, alarm in now.items():
            if whose not in before or before[whose].alarm_id != alarm.alarm_id:
                self._put(alarm, encode_alarm(alarm, time_ns))
        self._active = now


def serve(
    folder: Path, check: Callable[[], AlarmCheck], endpoint: str, tls: Path | None, every_s: float
) -> int:
    """Check the history at intervals and publish its alarms, until a signal; return 0.

    InputError or FailureError: the first check of the history fails. A later failure is logged and
    the check is repeated; active alarms are published all the same.
    """
    publishers: dict[str, Publisher] = {}
    with stopped_by_signals(leave_at_once) as stop, contextlib.ExitStack() as stack:
        bus = wait_for_router(endpoint, tls, stop.is_set)
        if bus is None:
            return 0
        session = stack.enter_context(bus)

        def put(alarm: Alarm, payload: bytes) -> None:
            publisher = publishers.setdefault(alarm.realm, Publisher(session, alarm.realm))
            publisher.put("bridge", alarm.bridge, "alarm", payload)
            state = "acknowledged" if alarm.acknowledged else "active"
            print(f"alarm of {alarm.bridge}, {state}: {alarm.sentence()}", flush=True)

        alarms = AlarmPublisher(put)
        alarms.publish_changes(folder, time.time_ns())  # a check may take minutes
        check()
        print(f"ready, checking {folder} every {every_s / 60.0:g} min", flush=True)
        due_s = time.monotonic() + every_s
        while not stop.is_set():
            if time.monotonic() >= due_s:
                try:
                    check()
                except (InputError, FailureError) as error:
                    _log.error("%s; checking again in %.0f s", error, every_s)
                due_s = time.monotonic() + every_s
            alarms.publish_changes(folder, time.time_ns())
            stop.wait(_POLL_S)
        for publisher in publishers.values():
            publisher.close()
    return 0
