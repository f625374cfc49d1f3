"""Times of simulated drives: runs ten minutes apart, on one day or on several."""

from typing import Final, NamedTuple

from services.common.errors import InputError
from services.common.language import utc_second
from services.drives.runs import Run
from services.simulation.positions import START_TIME_S

BETWEEN_RUNS_S: Final = 600.0
"""Time from the beginning of a run to that of the next."""
_DAY_S: Final = 86_400.0
_MAX_RUNS: Final = 1000
"""Largest number of all runs: a recording of simulated ones is made in memory."""
_START_S: Final = (0.0, 4_102_444_800.0)
"""Earliest and latest start: 1970 and 2100."""


class Schedule(NamedTuple):
    """Number and times of drives over the same road."""

    runs: int = 1
    """Runs of a day."""
    days: int = 1
    start_s: float | None = None
    """Unix time at which the first begins; None: the usual one of the simulation."""

    @property
    def drives(self) -> int:
        """Number of runs on all days."""
        return self.runs * self.days

    def begin_s(self, number: int, usual_start_s: float = START_TIME_S) -> float:
        """Return the Unix time at which a drive begins."""
        start_s = usual_start_s if self.start_s is None else self.start_s
        day, run = divmod(number, self.runs)
        return start_s + day * _DAY_S + run * BETWEEN_RUNS_S

    def in_words(self, duration_s: float) -> str:
        """Return the drives in words, each of this duration, with the start of the first."""
        runs = "" if self.runs == 1 else f"{self.runs} runs of "
        days = "" if self.days == 1 else f"{self.days} days, "
        return f"{days}{runs}{duration_s:.1f} s, from {utc_second(self.begin_s(0))} UTC"


ONCE: Final = Schedule()


def schedule_of(runs: int, days: int, start: str | None, *, name: str = "--start") -> Schedule:
    """Return the schedule of these options; raise InputError for an impossible one.

    `name` is that of the start in an error.
    """
    from services.drives.tables.stamps import start_of

    if runs * days > _MAX_RUNS:
        raise InputError(f"--days: makes {runs * days} runs, it must be at most {_MAX_RUNS}")
    start_s = None if start is None else start_of(start, None, name, has_zone_option=False)
    if start_s is not None and not _START_S[0] <= start_s <= _START_S[1]:
        raise InputError(f'{name}: is "{start}", it must be a time from 1970 to 2100')
    return Schedule(runs, days, start_s)


def begun_at(run: Run, begin_s: float) -> Run:
    """Return the run as if it had begun at a Unix time."""
    seconds = begin_s - float(run.accel_time_s[0])
    if seconds == 0.0:
        return run
    gnss = run.gnss._replace(time_s=run.gnss.time_s + seconds)
    return run._replace(accel_time_s=run.accel_time_s + seconds, gnss=gnss)
