"""Timing of published messages: the spacing of the drive, and the user's commands.

The player knows neither terminal nor bus. It gets commands from `Controls.wait` while it waits, and
shows its status through `Controls.show`.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from math import inf
from typing import Final, NamedTuple

from schemas.signals import NS_PER_S
from schemas.topics import Message, topic
from services.bus.playback import GAP_S
from services.recordings.merge import TimedMessage

SPEEDS: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 0.0)
"""Speeds of the keys for faster and slower; 0, as fast as possible, is the fastest."""
LEAD_S: Final = 5.0
"""Time before a truck enters a bridge at which a jump ends: the road before the bridge is needed.
"""
REFRESH_S: Final = 0.1
"""Longest delay of a key and of the display."""


class Command(Enum):
    """A user's command during the replay."""

    PAUSE = "pause, or go on"
    STEP = "publish one message, and pause"
    FASTER = "faster"
    SLOWER = "slower"
    NEXT_CROSSING = "jump to the next crossing"
    QUIT = "quit"


class Status(NamedTuple):
    """The state of the player."""

    position_ns: int
    speed: float
    is_paused: bool
    sent: int
    note: str
    """Reason why the last key had no effect; usually empty."""


class Controls(NamedTuple):
    """The user's controls."""

    wait: Callable[[float], Command | None]
    """Wait at most so many seconds; return early with a command."""
    show: Callable[[Status], None]


class PlaybackSettings(NamedTuple):
    """Settings of a playback."""

    speed: float
    """Multiple of real speed; 0: as fast as possible."""
    skip_gaps: bool = False
    start_paused: bool = False
    crossings_ns: Sequence[int] = ()
    """Times at which trucks enter bridges, ascending."""


class PlaybackResult(NamedTuple):
    """Result of a playback."""

    covered_ns: int
    """Covered duration of the drive, jumps and skipped gaps included."""
    jumped_over: int
    """Number of messages skipped by jumps to a crossing."""
    skipped_ns: int
    """Silence that was skipped."""
    has_quit: bool
    course: PlaybackSettings
    """Settings of the next round, with the speed and pause that the user has chosen."""


def play(
    messages: Iterable[TimedMessage],
    put: Callable[[Message], None],
    course: PlaybackSettings,
    controls: Controls,
    clock: Callable[[], float] = time.monotonic,
) -> PlaybackResult:
    """Publish the messages when due, until the last one or until the user quits.

    Delays are caught up. A latched message is published even if a jump passes it.
    """
    tape = _Timeline(course, clock)
    jumped_over = 0
    first_ns = last_ns = None
    for timed in messages:
        message = timed.message
        is_latched = topic(message.key.owner, message.key.stream).latched
        if timed.due_ns < tape.target_ns and not is_latched:
            jumped_over += 1
            continue
        if not is_latched or tape.is_new:
            _wait_for_turn(tape, timed.due_ns, controls)
        if tape.has_quit:
            break
        if timed.due_ns < tape.target_ns and not is_latched:  # the user has just jumped
            jumped_over += 1
            continue
        put(message)
        tape.sent += 1
        last_ns = timed.due_ns
        first_ns = last_ns if first_ns is None else first_ns
    controls.show(tape.status())
    covered_ns = 0 if first_ns is None or last_ns is None else last_ns - first_ns
    chosen = course._replace(speed=tape.speed, start_paused=tape.is_paused)
    return PlaybackResult(covered_ns, jumped_over, tape.skipped_ns, tape.has_quit, chosen)


def _wait_for_turn(tape: "_Timeline", due_ns: int, controls: Controls) -> None:
    """Return when a message is due or has been jumped over, or the user has quit."""
    while not tape.has_quit and due_ns >= tape.target_ns:
        tape.take_into_view(due_ns)
        left_s = tape.left_s(due_ns)
        is_stale = tape.is_stale()
        if tape.is_stepping or (left_s <= 0.0 and not is_stale):
            tape.has_reached(due_ns)
            return
        command = controls.wait(max(0.0, min(left_s, REFRESH_S)))
        if command is not None:
            tape.apply(command)
        if command is not None or is_stale:
            controls.show(tape.status())


class _Timeline:
    """Mapping between the time of the drive and of the clock."""

    def __init__(self, course: PlaybackSettings, clock: Callable[[], float]) -> None:
        self._course = course
        self._clock = clock
        self._anchor_s = self._shown_s = -inf
        self._anchor_ns = 0
        self.speed = course.speed
        self.is_paused = course.start_paused
        self.is_new = True
        self.is_stepping = self.has_quit = False
        self.position_ns = self.target_ns = self.skipped_ns = self.sent = 0
        self.note = ""

    def take_into_view(self, due_ns: int) -> None:
        """Jump to the next message if it is the first, after a gap, or the end of a jump."""
        silence_ns = due_ns - self.position_ns
        skips = self._course.skip_gaps and silence_ns > GAP_S * NS_PER_S
        if self.is_new or due_ns >= self.target_ns > 0 or skips:
            if skips and not self.is_new and not self.target_ns:
                self.skipped_ns += silence_ns
            self.is_new = False
            self.target_ns = 0
            self._anchor(due_ns)

    def has_reached(self, due_ns: int) -> None:
        """Note that a message is published."""
        self.is_stepping = False
        self.position_ns = max(self.position_ns, due_ns)

    def left_s(self, due_ns: int) -> float:
        """Return the seconds of the clock until a moment of the drive."""
        if self.is_paused:
            return inf
        if self.speed == 0.0:
            return 0.0
        due_s = self._anchor_s + (due_ns - self._anchor_ns) / NS_PER_S / self.speed
        return due_s - self._clock()

    def is_stale(self) -> bool:
        """Return whether the user has not been asked for a while; counts as asking."""
        now_s = self._clock()
        if now_s - self._shown_s < REFRESH_S:
            return False
        self._shown_s = now_s
        return True

    def apply(self, command: Command) -> None:
        """Execute a command of the user."""
        self.note = ""
        self._anchor(self.now_ns())
        match command:
            case Command.QUIT:
                self.has_quit = True
            case Command.PAUSE:
                self.is_paused = not self.is_paused
            case Command.STEP:
                self.is_paused = self.is_stepping = True
            case Command.FASTER | Command.SLOWER:
                self.speed = _next_speed(self.speed, faster=command is Command.FASTER)
            case Command.NEXT_CROSSING:
                self._jump()

    def now_ns(self) -> int:
        """Return the current moment of the drive."""
        if self.is_paused or self.speed == 0.0 or self.is_new:
            return self.position_ns
        gone_s = self._clock() - self._anchor_s
        return self._anchor_ns + round(gone_s * self.speed * NS_PER_S)

    def status(self) -> Status:
        """Return the status to show."""
        return Status(self.now_ns(), self.speed, self.is_paused, self.sent, self.note)

    def _anchor(self, moment_ns: int) -> None:
        self.position_ns = self._anchor_ns = moment_ns
        self._anchor_s = self._clock()

    def _jump(self) -> None:
        here_ns = max(self.position_ns, self.target_ns)  # two jumps at once go past two crossings
        before = [ns - round(LEAD_S * NS_PER_S) for ns in self._course.crossings_ns]
        ahead = [ns for ns in before if ns > here_ns]
        if ahead:
            self.target_ns = ahead[0]
        else:
            self.note = "no crossing ahead"


def _next_speed(speed: float, *, faster: bool) -> float:
    """Return the next of `SPEEDS` in a direction; the last one stays."""

    def rank(one: float) -> float:
        return inf if one == 0.0 else one

    if faster:
        return next((one for one in SPEEDS if rank(one) > rank(speed)), 0.0)
    return next((one for one in reversed(SPEEDS) if rank(one) < rank(speed)), speed)
