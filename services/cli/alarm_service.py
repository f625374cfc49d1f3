"""`driveby alarm serve`: tells on the bus which bridges have changed, until somebody takes note."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

from schemas.alarms import Alarm, encode_alarm
from services.bus.playback import leave_at_once, stopped_by_signals
from services.bus.publisher import Publisher
from services.bus.session import connected
from services.history.alarm_files import alarms_of, standing
from services.history.alarms import Checked

_LOOK_S = 1.0
"""How often it looks whether somebody has acknowledged an alarm."""


class Teller:
    """Publishes each alarm when it is raised and when it is acknowledged, and no other time.

    Alarms are latched: the bridge's last one answers whoever comes later. What stands when the
    service starts is told first, so that a restart forgets nothing.
    """

    def __init__(self, put: Callable[[Alarm, bytes], None]) -> None:
        self._put = put
        self._standing: dict[tuple[str, str], Alarm] = {}

    def tell(self, folder: Path, time_ns: int) -> None:
        """Tell what is new since the last time."""
        now = {(alarm.realm, alarm.bridge): alarm for alarm in standing(folder)[0]}
        for whose, alarm in self._standing.items():
            if whose in now and now[whose].alarm_id == alarm.alarm_id:
                continue
            for one in alarms_of(folder, *whose)[0]:
                if one.alarm_id == alarm.alarm_id and one.acknowledged is not None:
                    self._put(one, encode_alarm(one, time_ns))
        for whose, alarm in now.items():
            before = self._standing.get(whose)
            if before is None or before.alarm_id != alarm.alarm_id:
                self._put(alarm, encode_alarm(alarm, time_ns))
        self._standing = now


def serve(
    folder: Path, check: Callable[[], Checked], endpoint: str, tls: Path | None, every_s: float
) -> int:
    """Check the history every so often and tell its alarms, until a signal; return 0."""
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
        due_s = time.monotonic()
        while not stop.is_set():
            if time.monotonic() >= due_s:
                check()
                due_s = time.monotonic() + every_s
            teller.tell(folder, time.time_ns())
            stop.wait(_LOOK_S)
        for publisher in publishers.values():
            publisher.close()
    return 0
