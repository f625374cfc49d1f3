"""False alarms, and how soon a loss is found: bridges drawn from the method's own statistics.

    python -m tests.benchmarks.alarms [--only alarms|delays]

Weeks of three crossings by three trucks over a bridge of seven elements (the likelihoods of
tests/fleet.py), each with 0.5 % of change of its own. Beside that a bridge does not change (white),
drifts slowly (an Ornstein-Uhlenbeck process of 1.2 % with a correlation time of 26 weeks, half of
its variance common to all elements), or follows its temperature (season: -0.3 % a kelvin, 11 K of
annual wave, 4 K of weather). Of bridges whose temperature is known the first eight weeks are
training, of the others the first year. Sound bridges are watched until week 104, or 156 where the
temperature is unknown; losses begin half a year into what is judged, roughly, and are followed for
a year and a half.

Every bridge has its own seed, of `--seed`, the row's number and its own.
"""

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import beta

from pre_core.arrays import FloatArray
from pre_core.monitoring.baseline import Period
from pre_core.monitoring.change_detection import AlarmRules, Change, detect_change
from pre_core.monitoring.observation import Observation, combine_observations
from services.execution.blas import one_blas_thread
from services.identification.observed import observation_of
from tests.fleet import bridge_of, crossing_of, season_deg_c, templates, trucks_of

WEEK_S = 7.0 * 86_400.0
CHANGE = 0.005
WEATHER_K, WEATHER_KEPT = 4.0, 0.5
WANDER = 0.012
SOUND_WEEKS = {True: 104, False: 156}
"""By whether temperatures are known."""
LOST_AT, FOLLOWED = {True: 26, False: 78}, 78
STATED = (1.0, 0.5, 0.2, 0.1, 0.01)
LOSSES = (0.05, 0.07, 0.10, 0.15, 0.20, 0.30)
ELEMENTS = {3: "element 4, at midspan", 0: "element 1, at an end"}


class Kind(NamedTuple):
    """What a bridge does beside changing."""

    name: str
    correlation_weeks: float | None = None
    """Correlation time of its drift."""
    has_season: bool = False


KINDS = (
    Kind("white"),
    Kind("drift", 26.0),
    Kind("season", has_season=True),
)


class Loss(NamedTuple):
    """What becomes of one element."""

    element: int
    share: float
    is_slow: bool = False
    """A share in a year, evenly, rather than at once."""


class Sound(NamedTuple):
    """A bridge without a loss, watched."""

    years: float
    """Judged, up to the alarm of the default rules if there was one."""
    has_alarm: bool
    first: tuple[float, ...]
    """Years until the statistic passed the threshold of each of `STATED`, whatever the size of the
    change; years watched where it did not, negative."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="false alarms and delays")
    parser.add_argument("--bridges", type=int, default=300, help="sound ones in each row")
    parser.add_argument("--losses", type=int, default=50, help="bridges for each loss")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", choices=("alarms", "delays"), help="one of both tables")
    parser.add_argument("--first-row", type=int, default=0, help="continue with this row, from 0")
    options = parser.parse_args()
    with (
        one_blas_thread(),
        ProcessPoolExecutor(options.processes, get_context("forkserver")) as pool,
    ):

        def run(one: Callable[[int], Any], number: int) -> list[Any]:
            return list(pool.map(one, range(number), chunksize=4))

        if options.only != "delays":
            _false_alarms(run, options.bridges, options.seed, options.first_row)
        if options.only != "alarms":
            _delays(run, options.losses, options.seed, options.first_row)


def _false_alarms(
    run: "Callable[..., list[Sound]]", bridges: int, seed: int, first_row: int
) -> None:
    heads = ["series", "temperature", "bridges", "years judged", "alarms", "per year, 95 %"]
    print("\n".join(_head([*heads, *(f"chance alone, {stated:g}" for stated in STATED)])))
    for number, (kind, is_known) in enumerate(_series()):
        if number < first_row:
            continue
        found = run(partial(_sound, (seed, number), kind, is_known), bridges)
        years = sum(one.years for one in found)
        alarms = sum(one.has_alarm for one in found)
        low, high = _interval(alarms, len(found))
        cells = [kind.name, "known" if is_known else "unknown", str(len(found)), f"{years:.0f}"]
        per_bridge = len(found) / years
        cells += [
            str(alarms),
            f"{alarms / years:.4f} ({low * per_bridge:.4f} to {high * per_bridge:.4f})",
        ]
        for at in range(len(STATED)):
            firsts = [one.first[at] for one in found]
            rate = sum(first > 0.0 for first in firsts) / sum(map(abs, firsts))
            cells.append(f"{rate:.4f}")
        print(f"| {' | '.join(cells)} |", flush=True)
    print(flush=True)


def _delays(run: "Callable[..., list[float]]", bridges: int, seed: int, first_row: int) -> None:
    heads = ["series", "temperature", "at least", "loss"]
    for name in ELEMENTS.values():
        heads += [f"{name}: found", "median", "90 %"]
    print("\n".join(_head(heads)))
    for number, (kind, is_known, at_least, share, is_slow) in enumerate(_losses()):
        if number < first_row:
            continue
        cells = [kind.name, "known" if is_known else "unknown", f"{100.0 * at_least:g} %"]
        cells.append(f"{100.0 * share:.0f} %{' a year' if is_slow else ''}")
        for element in ELEMENTS:
            loss = Loss(element, share, is_slow)
            weeks = run(
                partial(_delay, (seed, 100 + number), kind, is_known, at_least, loss), bridges
            )
            middle, late = np.quantile(weeks, [0.5, 0.9], method="higher")
            found = int(np.isfinite(weeks).sum())
            cells += [f"{found} of {len(weeks)}", _weeks(middle), _weeks(late)]
        print(f"| {' | '.join(cells)} |", flush=True)


def _series() -> Iterator[tuple[Kind, bool]]:
    for kind in KINDS:
        for is_known in (True, False):
            yield kind, is_known


def _losses() -> Iterator[tuple[Kind, bool, float, float, bool]]:
    usual = AlarmRules().at_least
    white, drift, season = KINDS
    for share in LOSSES:
        yield white, True, usual, share, False
    for share in (0.03, 0.05, 0.10):
        yield white, True, 0.02, share, False
    for kind, is_known in ((drift, True), (season, True), (season, False)):
        for share in (0.05, 0.10, 0.20):
            yield kind, is_known, usual, share, False
    for kind, is_known in ((white, True), (drift, True), (season, False)):
        for share in (0.05, 0.10, 0.20):
            yield kind, is_known, usual, share, True


def _head(cells: list[str]) -> list[str]:
    return [f"| {' | '.join(cells)} |", f"| {' | '.join('--:' for _ in cells)} |"]


def _interval(number: int, of: int) -> tuple[float, float]:
    """Clopper's and Pearson's interval of a share."""
    low = 0.0 if number == 0 else float(beta.ppf(0.025, number, of - number + 1))
    high = 1.0 if number == of else float(beta.ppf(0.975, number + 1, of - number))
    return low, high


def _weeks(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "–"


def _sound(row: tuple[int, int], kind: Kind, is_known: bool, bridge: int) -> Sound:
    rng = np.random.default_rng([*row, bridge])
    periods = drawn(rng, kind, SOUND_WEEKS[is_known], is_known=is_known)
    usual = detect_change(periods, AlarmRules())
    # A change of which nobody wants to know: only the statistic counts.
    free = detect_change(periods, AlarmRules(at_least=0.999)) if usual.change is not None else usual
    judged = np.flatnonzero(free.judged)
    years = len(judged) / 52.0
    first = []
    for stated in STATED:
        threshold = np.sqrt(2.0 * AlarmRules(stated).threshold)
        passed = np.flatnonzero(free.statistic[judged] > threshold)
        first.append((passed[0] + 1) / 52.0 if passed.size else -years)
    if usual.change is not None:
        years = float((judged <= usual.change.raised_at).sum()) / 52.0
    return Sound(years, usual.change is not None, tuple(first))


def _delay(
    row: tuple[int, int], kind: Kind, is_known: bool, at_least: float, loss: Loss, bridge: int
) -> float:
    """Weeks from a loss to its alarm; infinite if there is none, or it names another element."""
    rng = np.random.default_rng([*row, loss.element, bridge])
    at = LOST_AT[is_known]
    periods = drawn(rng, kind, at + FOLLOWED, is_known=is_known, loss=loss, at=at)
    change = detect_change(periods, AlarmRules(at_least=at_least)).change
    return float(change.raised_at - at + 1) if _is_it(change, loss.element) else float("inf")


def _is_it(change: Change | None, element: int) -> bool:
    return change is not None and (change.element, change.direction) == (element, "weaker")


@cache
def _observations() -> list[list[Observation]]:
    """Information of three trucks, by truck and kind of crossing: covariances and loadings."""
    rng = np.random.default_rng(1)
    bridge = bridge_of(rng, "bridge-1")
    out = []
    for truck in trucks_of(rng, 3):
        some = [
            observation_of(crossing_of(rng, kind, truck, bridge, 0.0, bridge.ei_nm2))
            for kind in templates()
        ]
        of = [one for one in some if one is not None]
        # The stored likelihoods are by one truck: these are three.
        out.append(
            [
                one._replace(
                    shared=tuple(
                        s._replace(name=f"{s.name} {truck.name}" if "truck" in s.name else s.name)
                        for s in one.shared
                    )
                )
                for one in of
            ]
        )
    return out


def drawn(
    rng: np.random.Generator,
    kind: Kind,
    weeks: int,
    *,
    is_known: bool = True,
    loss: Loss = Loss(0, 0.0),  # noqa: B008
    at: int = 0,
) -> list[Period]:
    """Weeks of a bridge that loses something in week `at`, or nothing."""
    kinds = _observations()
    n = kinds[0][0].value.size
    level, slope = 23.5 + 0.1 * rng.standard_normal(n), -0.003 + 0.0005 * rng.standard_normal(n)
    z = {
        s.name: rng.standard_normal(s.loading.shape[1])
        for of in kinds
        for one in of
        for s in one.shared
    }
    drift = _drift(rng, kind, weeks, n)
    first, weather = float(rng.integers(52)), float(rng.standard_normal())
    out = []
    for week in range(weeks):
        warm = season_deg_c((first + week) * WEEK_S) + WEATHER_K * weather
        weather = WEATHER_KEPT * weather
        weather += np.sqrt(1.0 - WEATHER_KEPT**2) * float(rng.standard_normal())
        truth = level + drift[week] + (slope * (warm - 10.0) if kind.has_season else 0.0)
        share = loss.share * ((week - at) / 52.0 if loss.is_slow else 1.0) if week >= at else 0.0
        truth[loss.element] += np.log(1.0 - share)
        some = []
        for _ in range(3):
            of = kinds[int(rng.integers(3))]
            one = of[int(rng.integers(len(of)))]
            value = truth + np.linalg.cholesky(one.own) @ rng.standard_normal(n)
            value = value + CHANGE * rng.standard_normal(n)
            value = value + sum((s.loading @ z[s.name] for s in one.shared), np.zeros(n))
            some.append(one._replace(value=value))
        out.append(
            Period(
                combine_observations(some, n),
                warm if is_known else None,
                7.0 * (first + week) + 3.5,
            )
        )
    return out


def _drift(rng: np.random.Generator, kind: Kind, weeks: int, n: int) -> FloatArray:
    """(weeks, n) of ln EI; half of the variance common to all elements."""
    if kind.correlation_weeks is None:
        return np.zeros((weeks, n))
    steps = np.sqrt(0.5) * (rng.standard_normal((weeks, n)) + rng.standard_normal((weeks, 1)))
    kept = np.exp(-1.0 / kind.correlation_weeks)
    out = [steps[0]]
    for step in steps[1:]:
        out.append(kept * out[-1] + np.sqrt(1.0 - kept**2) * step)
    return WANDER * np.array(out)


if __name__ == "__main__":
    main()
