"""When each recorded message is published: the spacing of the drive, and what the user does to it.

The player knows neither terminal nor bus. It asks `Controls.wait` for what to do while it waits,
and shows what it does through `Controls.show`.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from math import inf
from typing import Final, NamedTuple

from schemas.signals import NS_PER_S
from schemas.topics import topic
from services.bus.playback import GAP_S
from services.recordings.recording import Message
from services.recordings.together import Timed

SPEEDS: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 0.0)
"""What the keys for faster and slower go through; 0, as fast as possible, is the fastest."""
LEAD_S: Final = 5.0
"""So long before a truck comes onto a bridge a jump ends: its road before the bridge is needed."""
REFRESH_S: Final = 0.1
"""So soon a key has its effect and the display follows."""


class Command(Enum):
    """What a user may want while messages are published."""

    PAUSE = "pause, or go on"
    STEP = "publish one message, and pause"
    FASTER = "faster"
    SLOWER = "slower"
    NEXT_CROSSING = "jump to the next crossing"
    QUIT = "quit"


class Status(NamedTuple):
    """Where the player is."""

    position_ns: int
    speed: float
    is_paused: bool
    sent: int
    note: str
    """What the last key did not do, and why; mostly empty."""


class Controls(NamedTuple):
    """The user."""

    wait: Callable[[float], Command | None]
    """Wait so many seconds at most; returns early with what is wanted."""
    show: Callable[[Status], None]


class Course(NamedTuple):
    """How messages are to be played."""

    speed: float
    """Times real speed; 0: as fast as possible."""
    skip_gaps: bool = False
    start_paused: bool = False
    crossings_ns: Sequence[int] = ()
    """When trucks come onto bridges, ascending."""


class Played(NamedTuple):
    """What came of it."""

    covered_ns: int
    """How far in the drive it came, jumps and skipped gaps included."""
    jumped_over: int
    """Messages left out by jumps to a crossing."""
    skipped_ns: int
    """Silence that was not waited for."""
    has_quit: bool
    course: Course
    """How another round goes on: at the speed, and with the pause, that the user has chosen."""


def play(
    messages: Iterable[Timed],
    put: Callable[[Message], None],
    course: Course,
    controls: Controls,
    clock: Callable[[], float] = time.monotonic,
) -> Played:
    """Put the messages when each is due, until there are no more or the user quits.

    Who was held up makes up for it. A latched message is published even where a jump passes it.
    """
    tape = _Tape(course, clock)
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
    return Played(covered_ns, jumped_over, tape.skipped_ns, tape.has_quit, chosen)


def _wait_for_turn(tape: "_Tape", due_ns: int, controls: Controls) -> None:
    """Return when a message is due, has been jumped over, or the user has quit."""
    while not tape.has_quit and due_ns >= tape.target_ns:
        tape.take_into_view(due_ns)
        left_s = tape.left_s(due_ns)
        is_stale = tape.is_stale()
        if tape.is_stepping or (left_s <= 0.0 and not is_stale):
            tape.has_reached(due_ns)
            return
        command = controls.wait(max(0.0, min(left_s, REFRESH_S)))
        if command is not None:
            tape.obey(command)
        if command is not None or is_stale:
            controls.show(tape.status())


class _Tape:
    """Which moment of the drive belongs to which moment of the clock."""

    def __init__(self, course: Course, clock: Callable[[], float]) -> None:
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
        """Go to the next message at once if it is the first, behind a gap, or the end of a jump."""
        silence_ns = due_ns - self.position_ns
        skips = self._course.skip_gaps and silence_ns > GAP_S * NS_PER_S
        if self.is_new or due_ns >= self.target_ns > 0 or skips:
            if skips and not self.is_new and not self.target_ns:
                self.skipped_ns += silence_ns
            self.is_new = False
            self.target_ns = 0
            self._anchor(due_ns)

    def has_reached(self, due_ns: int) -> None:
        """A message is published."""
        self.is_stepping = False
        self.position_ns = max(self.position_ns, due_ns)

    def left_s(self, due_ns: int) -> float:
        """Seconds of the clock until a moment of the drive."""
        if self.is_paused:
            return inf
        if self.speed == 0.0:
            return 0.0
        due_s = self._anchor_s + (due_ns - self._anchor_ns) / NS_PER_S / self.speed
        return due_s - self._clock()

    def is_stale(self) -> bool:
        """Whether the user has not been asked for a while; counts as asking."""
        now_s = self._clock()
        if now_s - self._shown_s < REFRESH_S:
            return False
        self._shown_s = now_s
        return True

    def obey(self, command: Command) -> None:
        """Do what the user wants."""
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
        """The moment of the drive that it is now."""
        if self.is_paused or self.speed == 0.0 or self.is_new:
            return self.position_ns
        gone_s = self._clock() - self._anchor_s
        return self._anchor_ns + round(gone_s * self.speed * NS_PER_S)

    def status(self) -> Status:
        """What there is to show."""
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
    """The next of `SPEEDS` in a direction; at the end it stays."""

    def rank(one: float) -> float:
        return inf if one == 0.0 else one

    if faster:
        return next((one for one in SPEEDS if rank(one) > rank(speed)), 0.0)
    return next((one for one in reversed(SPEEDS) if rank(one) < rank(speed)), speed)
