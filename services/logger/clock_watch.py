"""The clocks of all trucks and of the logger, and events on their steps and drifts. No clock."""

from schemas.events import Event, EventKind
from schemas.signals import NS_PER_S, Identity, Stamp
from schemas.topics import Key, is_from_recording, is_simulated
from services.logger.clocks import TruckClock, clock_step_ns


class ClockWatch:
    """Clocks by realm and vehicle, each by its most frequent stream."""

    def __init__(self) -> None:
        self._clocks: dict[tuple[str, str], TruckClock] = {}
        self._clock_stream: dict[tuple[str, str], tuple[str, int]] = {}
        self._own_clock_ns: int | None = None
        self._lag_ns = 0
        self._due: list[tuple[Key, Event]] = []

    def note(self, where: Key, identity: Identity, stamp: Stamp, now_ns: int) -> None:
        """Compare a live message's times with earlier ones, and with its arrival."""
        if stamp.device_time_ns is None or is_from_recording(where.realm):
            return
        truck = (where.realm, where.identifier)
        stream, highest = self._clock_stream.get(truck, (where.stream, -1))
        if stream != where.stream and where.stream != "accel":
            return  # one stream is enough; accelerations are the most frequent
        clock = self._clocks.get(truck)
        if clock is None or stream != where.stream or identity.boot_id > clock.boot_id:
            clock = self._clocks[truck] = TruckClock(identity.boot_id)
            highest = -1
        if identity.boot_id < clock.boot_id or identity.sequence <= highest:
            return
        self._clock_stream[truck] = (where.stream, identity.sequence)
        step_ns = clock.wall_against_device(stamp.wall_time_ns, stamp.device_time_ns)
        if step_ns:
            text = f"the truck's wall clock jumped by {step_ns * 1e-9:+.3f} s"
            event = Event(
                EventKind.CLOCK_STEP,
                now_ns,
                text,
                vehicle=where.identifier,
                stream=where.stream,
                boot_id=identity.boot_id,
                first_sequence=identity.sequence,
            )
            self._due.append((where, event))
        if not is_simulated(where.realm):  # `driveby truck --speed` gives samples any age
            clock.arrived(stamp.wall_time_ns, now_ns)
        self._lag_ns = max(self._lag_ns, now_ns - stamp.wall_time_ns)

    def steps(self, realm: str, now_ns: int, now_s: float) -> list[tuple[Key, Event]]:
        """Return steps of the logger's clock, in a realm, and of trucks since the last call."""
        due, self._due = self._due, []
        offset_ns = now_ns - round(now_s * NS_PER_S)
        step_ns = clock_step_ns(self._own_clock_ns, offset_ns)
        self._own_clock_ns = offset_ns
        if not step_ns:
            return due
        for clock in self._clocks.values():
            clock.forget()
        text = f"the logger's wall clock jumped by {step_ns * 1e-9:+.3f} s"
        where = Key(realm, "vehicle", "", "")
        return [(where, Event(EventKind.CLOCK_STEP, now_ns, text)), *due]

    def lag_s(self) -> float:
        """Return the longest delay of live messages since the last call.

        It includes the clocks' difference and the length of a batch, whose time is that of its
        start.
        """
        lag_ns, self._lag_ns = self._lag_ns, 0
        return lag_ns * 1e-9

    def figures(self) -> dict[str, float]:
        """Return each truck's lag behind the logger's clock, and its drift, by name."""
        figures = {}
        for (_, vehicle), clock in self._clocks.items():
            drift = clock.drift()
            if drift is not None:
                figures[f"clock_offset_s/{vehicle}"] = drift.offset_s
                if drift.drift_ppm is not None:
                    figures[f"clock_drift_ppm/{vehicle}"] = drift.drift_ppm
        return figures

    def forget(self, where: Key, boot_id: int) -> None:
        """Forget the clock of a boot, if a forgotten stream determined it."""
        truck = (where.realm, where.identifier)
        clock = self._clocks.get(truck)
        is_its = self._clock_stream.get(truck, ("", 0))[0] == where.stream
        if clock is not None and clock.boot_id == boot_id and is_its:
            del self._clocks[truck], self._clock_stream[truck]

    def drifts(self, now_ns: int, now_s: float) -> list[tuple[Key, Event]]:
        """Return the drifts that are due; `now_s` is a monotonic clock."""
        events = []
        for (realm, vehicle), clock in self._clocks.items():
            drift = clock.due(now_s)
            if drift is not None:
                ppm = "" if drift.drift_ppm is None else f", {drift.drift_ppm:+.1f} ppm"
                text = f"the truck's clock is {drift}{ppm}"
                event = Event(
                    EventKind.CLOCK_DRIFT, now_ns, text, vehicle=vehicle, boot_id=clock.boot_id
                )
                events.append((Key(realm, "vehicle", vehicle, ""), event))
        return events
