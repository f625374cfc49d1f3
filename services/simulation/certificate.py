"""Does a method recover what was put in, for this truck on this bridge? Crossings that ask, a rule.

Before real crossings of a pair of vehicle and bridge count, simulated ones of this very pair are
identified as a worker would identify them, and their answers compared with the truth: the truck,
bridge, sensors and receiver of the site file, all that it leaves open drawn from its priors, its
own survey speed, a road of its class; a surface where the site file tells of tyres that feel
different strips of it. In every third crossing the bridge is sound but for one element of half its
rigidity, so that what is looked for is among what is tried.

`judged` is the rule; docs/certificates.md argues it, docs/scripts/certificate_rates.py computes how
often it errs. It looks at crossings in the order of their seeds, however they were computed, so one
seed gives one certificate.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from pre_core.constants import NORMAL_975
from pre_core.diagnostics.calibration import root_mean_square
from schemas.certificates import (
    METHOD_EDITION,
    Certificate,
    Conditions,
    Figures,
    Pair,
    Tried,
    pair_hash,
)
from schemas.results import Crossing
from schemas.settings import IdentificationSettings
from schemas.site import Bridge, Site, Vehicle
from services.common.errors import FailureError
from services.identification.placed import middle_sensor, middle_site
from services.recordings.recording import program_version
from services.simulation.drawn import Truth, draw_truth, drive, see
from services.simulation.drive import beam_of
from services.simulation.wheel_paths import OnSurface, wheel_paths_of
from services.simulation.worlds import WANDER_M

_log = logging.getLogger(__name__)

SEED: Final = 1
CROSSINGS: Final = 12
FEWEST: Final = 8
"""After so many it may be over, where nothing speaks against the method."""
FEWEST_GOOD: Final = 8
"""Of all. A method that knows too rarely what its answer is worth is none for this pair."""
LEAST_COVERAGE: Final = 0.85
"""Of all 95 % intervals. Those of one crossing are not independent: see docs/certificates.md."""
LARGEST_RMS_Z: Final = 1.5
LARGEST_Z_GOOD: Final = 5.0
"""As everywhere where a `good` crossing is judged (docs/validation.md)."""
SURE_COVERAGE: Final = 0.93
SURE_RMS_Z: Final = 1.2
"""With these, and all of them good, `FEWEST` are enough."""
WEAK_RATIO: Final = 0.5
TAKEN_FOR_SOUND: Final = 0.75
"""A weak element whose interval begins above it is taken for a sound one."""
FOUND_BELOW: Final = 0.9
_SPEED_M_PER_S: Final = 10.0
_ROAD_CLASS: Final = "B"
"""Where the site file does not say."""
_STEADY_M_PER_S2: Final = 0.1
"""A survey is driven at an even speed."""
_SEEDS: Final = 1000
"""So far apart are the crossings' seeds of one certificate from those of the next seed."""
_ALL_SEEDS: Final = 1 << 63


class Judgement(NamedTuple):
    """How it ended, and why in one sentence."""

    passed: bool
    reason: str


class Run(NamedTuple):
    """One crossing of a trial, which may be computed in another process."""

    number: int
    run: Callable[[], Tried]


class Trial:
    """The crossings of a certificate that is being made: which to compute next, and what they say.

    Who makes it computes what `next_run` gives, anywhere, gives each outcome to `add`, in any
    order, and stops as soon as there is a `judgement`.
    """

    def __init__(
        self, site: Site, pair: Pair, settings: IdentificationSettings, seed: int = SEED
    ) -> None:
        """KeyError if the site has no such pair."""
        self.pair = pair
        self._site = site
        self._settings = settings
        self._seed = seed
        self._alone = alone_on(site, pair)
        self._started = 0
        self._tried: dict[int, Tried] = {}
        self._judged: list[Tried] = []
        self.judgement: Judgement | None = None

    def next_run(self) -> Run | None:
        """The next crossing to compute; None if all have been given."""
        if self._started == CROSSINGS:
            return None
        number = self._started
        self._started += 1
        single = self._settings.model_copy(update={"threads": 1})
        run = partial(one_crossing, self._alone, single, self._seed_of(number), number)
        return Run(number, run)

    def _seed_of(self, number: int) -> int:
        return (self._seed * _SEEDS + number) % _ALL_SEEDS

    def add(self, number: int, tried: Tried) -> None:
        """Take the outcome of a crossing; what comes after the judgement is left out."""
        self._tried[number] = tried
        while self.judgement is None and len(self._judged) in self._tried:
            self._judged.append(self._tried[len(self._judged)])
            self.judgement = judged(self._judged)

    def give_up(self, number: int) -> None:
        """Take note that a crossing could not be computed."""
        self.add(number, _not_simulated(self._alone, self._seed_of(number)))

    @property
    def share(self) -> float:
        """How much of all crossings has been judged, or 1 when it is over."""
        return 1.0 if self.judgement is not None else len(self._judged) / CROSSINGS

    def certificate(self, created: float) -> Certificate:
        """What is to be written, `created` seconds after 1970 UTC. ValueError: not judged yet."""
        if self.judgement is None:
            raise ValueError(f"{self.pair}: the trial is not over")
        vehicle, bridge = self._alone.vehicles[0], self._alone.bridges[0]
        return Certificate(
            version=program_version(),
            created=created,
            hash=pair_hash(self._site, self.pair, self._settings),
            method_edition=METHOD_EDITION,
            vehicle=vehicle.id,
            bridge=bridge.id,
            settings=self._settings.model_dump(mode="json"),
            seed=self._seed,
            conditions=conditions_of(vehicle, bridge, self._site),
            planned=CROSSINGS,
            crossings=tuple(self._judged),
            figures=figures_of(self._judged),
            passed=self.judgement.passed,
            reason=self.judgement.reason,
        )


def tried_in_processes(trial: Trial, pool: ProcessPoolExecutor, processes: int) -> Iterator[float]:
    """Bring a trial to its judgement, `processes` crossings at a time; yield the share done.

    FailureError: a process died.
    """
    under_way: dict[Future[Tried], int] = {}
    while trial.judgement is None:
        while len(under_way) < processes and (one := trial.next_run()) is not None:
            under_way[pool.submit(one.run)] = one.number
        for future in wait(under_way, return_when=FIRST_COMPLETED).done:
            number = under_way.pop(future)
            try:
                trial.add(number, future.result())
            except BrokenExecutor as error:
                raise FailureError(
                    f"{trial.pair}: a process that simulated a crossing died, perhaps for want of "
                    "memory"
                ) from error
            except Exception:  # whatever it is, it speaks against the method and ends nothing
                _log.exception("simulated crossing %d of %s failed", number, trial.pair)
                trial.give_up(number)
        yield trial.share
    for future in under_way:
        future.cancel()


def alone_on(site: Site, pair: Pair) -> Site:
    """The site with this vehicle and this bridge only; KeyError if it has no such pair.

    Sensors of the vehicle are reduced to its middle readings: that is what is simulated.
    """
    chosen = {
        "vehicles": (site.vehicle(pair.vehicle),),
        "bridges": (site.bridge(pair.bridge),),
    }
    return middle_site(site.model_copy(update=chosen))


def conditions_of(vehicle: Vehicle, bridge: Bridge, site: Site) -> Conditions:
    """What the site file says of road, speed and sensors, or what is usual."""
    sensor = middle_sensor(site.sensor, vehicle)
    twin = vehicle.twin_tyre_distance_m is not None and vehicle.twin_tyre_distance_m[1] > 0.0
    return Conditions(
        speed_m_per_s=bridge.survey_speed_m_per_s or _SPEED_M_PER_S,
        road_class=bridge.road_class or _ROAD_CLASS,
        road="surface" if twin or vehicle.rear_axle_offset_m else "groove",
        # A simulated truck has one rate: the poorest of its sensors'.
        rate_hz=min(sensor.rate_hz),
        noise_density_ug_per_rthz=sensor.noise_density_ug_per_rthz,
    )


def one_crossing(site: Site, settings: IdentificationSettings, seed: int, number: int) -> Tried:
    """Draw, drive and identify the crossing `number` of the site's only pair."""
    bridge = site.bridges[0]
    conditions = conditions_of(site.vehicles[0], bridge, site)
    truth, weak = _truth(site, conditions, seed, number)
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2)
    went_in = {
        "seed": seed,
        "direction": "start_to_end" if truth.conditions.forward else "end_to_start",
        "weak_element": None if weak is None else weak + 1,
        "ei_ratio": tuple((truth.beam.flexural_rigidity_nm2 / nominal).tolist()),
    }
    try:
        drawn = drive(site, truth, seed, noise_ug_per_rthz=conditions.noise_density_ug_per_rthz)
    except FailureError as error:
        _log.warning("crossing %d was not simulated: %s", seed, error)
        return _not_simulated(site, seed)
    found = see([drawn.run], drawn.site, settings)
    if len(found) != 1:
        return Tried.model_validate(went_in | {"verdict": "not_found"})
    return Tried.model_validate(went_in | _came_out(found[0].result, nominal.tolist()))


def _not_simulated(site: Site, seed: int) -> Tried:
    """What is left of a crossing that could not be computed."""
    elements = site.bridges[0].elements
    return Tried(
        seed=seed, direction="start_to_end", ei_ratio=(1.0,) * elements, verdict="not_simulated"
    )


def _truth(site: Site, conditions: Conditions, seed: int, number: int) -> tuple[Truth, int | None]:
    """What is behind a crossing, and which element is weak, if any, counted from 0."""
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    truth = draw_truth(site, seed)
    how = truth.conditions
    truth = truth._replace(
        conditions=how._replace(
            road_class=conditions.road_class,
            speed_m_per_s=conditions.speed_m_per_s,
            change_m_per_s=min(how.change_m_per_s, _STEADY_M_PER_S2 * how.period_s / (2.0 * np.pi)),
            rate_hz=conditions.rate_hz,
        ),
        paths=wheel_paths_of(vehicle, OnSurface(None, None, WANDER_M))
        if conditions.road == "surface"
        else None,
    )
    if number % 3 != 1:
        return truth, None
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x5EA4]))
    weak = int(rng.integers(bridge.elements))
    ratios = np.ones(bridge.elements)
    ratios[weak] = WEAK_RATIO
    sound = beam_of(bridge, ratios).flexural_rigidity_nm2
    return truth._replace(beam=truth.beam._replace(flexural_rigidity_nm2=sound)), weak


def _came_out(result: Crossing, nominal: list[float]) -> dict[str, object]:
    came: dict[str, object] = {
        "verdict": result.verdict,
        "reasons": tuple(str(reason) for reason in result.reasons),
        "evaluations": int(
            sum(result.diagnostics.get(key, 0.0) for key in ("iterations", "chain_evaluations"))
        ),
    }
    if result.parameters is None:
        return came
    elements = [result.parameters[f"EI_{e + 1}"] for e in range(len(nominal))]
    for key in ("q025", "q50", "q975"):
        came[f"ei_ratio_{key}"] = tuple(
            getattr(element, key) / sound for element, sound in zip(elements, nominal, strict=True)
        )
    return came


class Errors(NamedTuple):
    """Of one crossing with an answer, element by element."""

    z: np.ndarray[tuple[int], np.dtype[np.float64]]
    std_log: np.ndarray[tuple[int], np.dtype[np.float64]]
    is_covered: np.ndarray[tuple[int], np.dtype[np.bool_]]


def errors_of(tried: Tried) -> Errors:
    """How far a crossing with an answer is from the truth."""
    truth, low, middle, high = (
        np.array(values)
        for values in (
            tried.ei_ratio,
            tried.ei_ratio_q025,
            tried.ei_ratio_q50,
            tried.ei_ratio_q975,
        )
    )
    std_log = np.log(high / low) / (2.0 * NORMAL_975)
    return Errors(
        np.log(middle / truth) / np.maximum(std_log, 1e-12),
        std_log,
        (low <= truth) & (truth <= high),
    )


def figures_of(tried: Sequence[Tried]) -> Figures:
    """What crossings say together."""
    answered = [one for one in tried if one.is_answered]
    errors = [errors_of(one) for one in answered]
    z = np.concatenate([e.z for e in errors]) if errors else np.empty(0)
    good = [
        float(np.abs(e.z).max())
        for one, e in zip(answered, errors, strict=True)
        if one.verdict == "good"
    ]
    weak = [one for one in answered if one.weak_element is not None]
    return Figures(
        crossings=len(tried),
        good=len(good),
        intervals=z.size,
        covered=sum(int(e.is_covered.sum()) for e in errors),
        rms_z=root_mean_square(z) if z.size else None,
        largest_z_good=max(good, default=None),
        std=float(np.median(np.concatenate([e.std_log for e in errors]))) if errors else None,
        weak=len(weak),
        weak_found=sum(_of_weak(one.ei_ratio_q975, one) < FOUND_BELOW for one in weak),
        evaluations=sum(one.evaluations or 0 for one in tried),
    )


def _of_weak(values: tuple[float, ...], tried: Tried) -> float:
    assert tried.weak_element is not None  # noqa: S101 - asked of such only
    return values[tried.weak_element - 1]


def judged(tried: Sequence[Tried], planned: int = CROSSINGS) -> Judgement | None:
    """Whether the first crossings of a certificate are enough, and for what; None: not yet.

    Over before all are there where no others could save it, or where nothing speaks against it.
    """
    figures = figures_of(tried)
    elements = len(tried[0].ei_ratio) if tried else 0
    against = _against(tried, figures, planned, elements)
    if against is not None:
        return Judgement(False, against)
    is_sure = (
        figures.good == figures.crossings >= FEWEST
        and figures.covered >= SURE_COVERAGE * figures.intervals
        and (figures.rms_z or 0.0) <= SURE_RMS_Z
    )
    if figures.crossings < planned and not is_sure:
        return None
    return Judgement(True, _for(figures))


def _against(tried: Sequence[Tried], figures: Figures, planned: int, elements: int) -> str | None:
    """What no further crossing could mend."""
    for one in tried:
        if one.verdict != "good":
            continue
        worst = float(np.abs(errors_of(one).z).max())
        if worst > LARGEST_Z_GOOD:
            return (
                f"crossing {one.seed} is called good and is wrong by {worst:.1f} standard "
                f"deviations, at most {LARGEST_Z_GOOD:g} are allowed"
            )
        if one.weak_element is not None and _of_weak(one.ei_ratio_q025, one) > TAKEN_FOR_SOUND:
            return (
                f"crossing {one.seed} is called good and takes element {one.weak_element}, of "
                "half its rigidity, for a sound one"
            )
    others = figures.crossings - figures.good
    if others > planned - FEWEST_GOOD:
        return (
            f"{figures.good} of {figures.crossings} crossings are good, at least {FEWEST_GOOD} of "
            f"{planned} must be ({_why_not(tried)})"
        )
    # Intervals that are still to come may all hold the truth, and errors be zero.
    to_come = (planned - figures.crossings) * elements
    missed = figures.intervals - figures.covered
    if missed > (1.0 - LEAST_COVERAGE) * (figures.intervals + to_come):
        return (
            f"{missed} of {figures.intervals} intervals of 95 % miss the truth, at most "
            f"{100 * (1.0 - LEAST_COVERAGE):.0f} % may"
        )
    squares = figures.intervals * (figures.rms_z or 0.0) ** 2
    if squares > LARGEST_RMS_Z**2 * (figures.intervals + to_come):
        return (
            f"errors are {figures.rms_z:.2f} standard deviations (root mean square), at most "
            f"{LARGEST_RMS_Z:g} are allowed"
        )
    return None


def _why_not(tried: Sequence[Tried]) -> str:
    """Reasons of crossings that are not good, the most frequent first."""
    found = [
        reason for one in tried if one.verdict != "good" for reason in one.reasons or (one.verdict,)
    ]
    return ", ".join(sorted(set(found), key=lambda reason: (-found.count(reason), reason)))


def _for(figures: Figures) -> str:
    weak = f", a weak element stands out in {figures.weak_found} of {figures.weak}"
    return (
        f"{figures.good} of {figures.crossings} crossings are good, {figures.covered} of "
        f"{figures.intervals} intervals of 95 % hold the truth{weak if figures.weak else ''}"
    )
