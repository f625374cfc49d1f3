"""What the processes of tests/unit/execution do: each of them imports this and little else."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np

from schemas.results import BridgeResult, CrossingResult
from schemas.settings import IdentificationSettings
from services.finding.crossing_data import CrossingData
from services.identification.bridge_state import FusionSettings, RecentCrossings
from tests.identifications import Identifications
from tests.waiting import LONGEST_S


def nothing() -> None:
    """These searches have no kernels."""


def quick(data: CrossingData, settings: IdentificationSettings, **others: Any) -> CrossingResult:
    others["report"]("half", 0.5)
    return Identifications()(data, settings, stopwatch=others["stopwatch"])


def deadly(data: CrossingData, settings: IdentificationSettings, **others: Any) -> CrossingResult:
    """The way back kills its process, always."""
    if data.stay.direction < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return quick(data, settings, **others)


def deadly_once(
    data: CrossingData, settings: IdentificationSettings, **others: Any
) -> CrossingResult:
    """Each crossing kills the first process that tries it."""
    mark = Path(os.environ["DEADLY_ONCE"]) / data.crossing_id
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return quick(data, settings, **others)


def broken(data: CrossingData, settings: IdentificationSettings, **others: Any) -> CrossingResult:
    raise np.linalg.LinAlgError("singular")


def slow(data: CrossingData, settings: IdentificationSettings, **others: Any) -> CrossingResult:
    """For ever."""
    while True:
        time.sleep(1.0)


def busy(data: CrossingData, settings: IdentificationSettings, **others: Any) -> CrossingResult:
    """For ever, and with all of a processor; the way there only."""
    while data.stay.direction > 0:
        pass
    return quick(data, settings, **others)


def hung_once(
    data: CrossingData, settings: IdentificationSettings, **others: Any
) -> CrossingResult:
    """Each crossing hangs in the first process that tries it."""
    mark = Path(os.environ["DEADLY_ONCE"]) / data.crossing_id
    if not mark.exists():
        mark.touch()
        slow(data, settings, **others)
    return quick(data, settings, **others)


def die() -> None:
    os._exit(3)


def sleep_for_ever() -> None:
    time.sleep(1e6)


def sleep_at_the_second_start() -> None:
    starts = Path(os.environ["DEADLY_ONCE"])
    (starts / f"start {len(list(starts.iterdir()))}").touch()
    if len(list(starts.iterdir())) == 3:  # a mark of the crossing that killed the first is there
        sleep_for_ever()


STATE = BridgeResult(verdict="rejected")  # type: ignore[call-arg]


def named_by_number(counted: RecentCrossings, bridge: str, fusing: FusionSettings) -> BridgeResult:
    """Record which process made it of what, and when."""
    (Path(os.environ["DEADLY_ONCE"]) / f"{time.monotonic_ns()} {bridge} {counted.number}").touch()
    return STATE.model_copy(update={"crossings_left_out_count": counted.number})


def after_a_signal(counted: RecentCrossings, bridge: str, fusing: FusionSettings) -> BridgeResult:
    state = named_by_number(counted, bridge, fusing)
    wait_for(str(Path(os.environ["DEADLY_ONCE"]) / "go on"))
    return state


def dies(counted: RecentCrossings, bridge: str, fusing: FusionSettings) -> BridgeResult:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def dies_once(counted: RecentCrossings, bridge: str, fusing: FusionSettings) -> BridgeResult:
    mark = Path(os.environ["DEADLY_ONCE"]) / "died"
    if not mark.exists():
        mark.touch()
        dies(counted, bridge, fusing)
    return named_by_number(counted, bridge, fusing)


def for_ever(counted: RecentCrossings, bridge: str, fusing: FusionSettings) -> BridgeResult:
    time.sleep(1e6)
    raise AssertionError


def bad(counted: RecentCrossings, bridge: str, fusing: FusionSettings) -> BridgeResult:
    raise np.linalg.LinAlgError("singular")


def two_of(number: int) -> int:
    return 2 * number


def no_answer() -> None:
    raise np.linalg.LinAlgError("singular")


def wait_for(path: str) -> str:
    deadline = time.monotonic() + LONGEST_S
    while not Path(path).exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    return path
