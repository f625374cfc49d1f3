"""Site validation: simulated crossings of one truck on one bridge, and the rule that judges them.

Before real crossings of a pair of vehicle and bridge count, simulated ones of this very pair are
identified as a worker would identify them, and the answers compared with the truth. Truck, bridge,
sensors and receiver are those of the site file, all unknown values drawn from its priors (total
masses are the medians of the twelfths of theirs), with its own survey speed and a road of its
class; a 2-D surface where the site file describes tyres on different wheel paths. In every third
crossing the bridge is undamaged except for one element of half its rigidity, so that the trial
includes what is to be detected.

`judge_trial` is the rule of acceptance (studies/site-validation.md), whose error rates
studies/scripts/certificate_rates.py computes. It judges crossings in the order of their seeds, so
one seed gives one record.
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from pre_core.constants import NORMAL_975
from schemas.results import CrossingResult
from schemas.settings import IdentificationSettings
from schemas.site import Bridge, Site, Vehicle
from schemas.validation_records import (
    LEAST_COVERAGE,
    METHOD_EDITION,
    ValidationConditions,
    ValidationCrossing,
    ValidationFigures,
    ValidationRecord,
    VehicleBridgePair,
    pair_hash,
)
from services.common.errors import FailureError
from services.common.naming import count_of
from services.drives.runs import Run
from services.finding.placed import middle_sensor, middle_site
from services.recordings.recording import program_version
from services.simulation.drawn import CrossingTruth, drive, identify_simulated
from services.simulation.drawn_tandem import drawn_tandem
from services.simulation.trial_truth import ALL_SEEDS, CROSSINGS, drawn_truth

_log = logging.getLogger(__name__)

SEED: Final = 1
FEWEST: Final = 8
"""Fewest crossings after which a trial without objection may pass."""
FEWEST_GOOD: Final = 8
"""Fewest `good` crossings of all; below, the method is too rarely certain of its answer."""
LARGEST_RMS_Z: Final = 1.5
LARGEST_Z_GOOD: Final = 5.0
"""Largest standardised error of a `good` crossing, as in docs/validation.md."""
SURE_COVERAGE: Final = 0.93
SURE_RMS_Z: Final = 1.2
"""Largest RMS score at which `FEWEST` crossings, all good, suffice."""
MISSED_ABOVE: Final = 0.75
"""Lower end of a weak element's interval above which its loss counts as missed, as a share of its
undamaged value."""
FOUND_BELOW: Final = 0.9
_SPEED_M_PER_S: Final = 10.0
_ROAD_CLASS: Final = "B"
"""Road class where the site file has none."""
_SEEDS: Final = 1000
"""Difference of the crossings' seeds between two successive seeds of trials."""
_SHOWN_EVERY_S: Final = 10.0


class TrialOutcome(NamedTuple):
    """Result of a trial and its reason in one sentence."""

    passed: bool
    reason: str


class TrialCrossing(NamedTuple):
    """One crossing of a trial, which may be computed in another process."""

    number: int
    run: Callable[[], ValidationCrossing]


class ValidationTrial:
    """A running site validation: the crossings to compute and their results.

    Compute what `next_run` returns, anywhere, pass each result to `add`, in any order, and stop as
    soon as there is a `judgement`.
    """

    def __init__(
        self,
        site: Site,
        pair: VehicleBridgePair,
        settings: IdentificationSettings,
        seed: int = SEED,
    ) -> None:
        """Begin a trial; raise KeyError if the site has no such pair."""
        self.pair = pair
        self._site = site
        self._settings = settings
        self._seed = seed
        self._alone = single_pair_site(site, pair)
        self._started = 0
        self._tried: dict[int, ValidationCrossing] = {}
        self._judged: list[ValidationCrossing] = []
        self.judgement: TrialOutcome | None = None

    def next_run(self) -> TrialCrossing | None:
        """Return the next crossing to compute; None if all have been given."""
        if self._started == CROSSINGS:
            return None
        number = self._started
        self._started += 1
        single = self._settings.model_copy(update={"threads": 1})
        run = partial(one_crossing, self._alone, single, self._seed_of(number), number)
        return TrialCrossing(number, run)

    def _seed_of(self, number: int) -> int:
        return (self._seed * _SEEDS + number) % ALL_SEEDS

    def add(self, number: int, tried: ValidationCrossing) -> None:
        """Add the result of a crossing; ignore those after the judgement."""
        self._tried[number] = tried
        while self.judgement is None and len(self._judged) in self._tried:
            self._judged.append(self._tried[len(self._judged)])
            self.judgement = judge_trial(self._judged)

    def give_up(self, number: int) -> None:
        """Note that a crossing could not be computed."""
        self.add(number, _not_simulated(self._alone, self._seed_of(number)))

    @property
    def share(self) -> float:
        """The share of crossings that have been judged; 1 when it is over."""
        return 1.0 if self.judgement is not None else len(self._judged) / CROSSINGS

    def certificate(self, created: float) -> ValidationRecord:
        """Return the record, `created` s after 1970 UTC; raise ValueError before judgement."""
        if self.judgement is None:
            raise ValueError(f"{self.pair}: the trial is not over")
        vehicle, bridge = self._alone.vehicles[0], self._alone.bridges[0]
        return ValidationRecord(
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


def run_trial(trial: ValidationTrial, pool: ProcessPoolExecutor, processes: int) -> Iterator[float]:
    """Run a trial to its judgement, `processes` crossings at a time; yield the completed share.

    It is also yielded every `_SHOWN_EVERY_S`, as a crossing may take minutes. Raise FailureError if
    a process died.
    """
    under_way: dict[Future[ValidationCrossing], int] = {}
    while trial.judgement is None:
        while len(under_way) < processes and (one := trial.next_run()) is not None:
            under_way[pool.submit(one.run)] = one.number
        for future in wait(under_way, _SHOWN_EVERY_S, FIRST_COMPLETED).done:
            number = under_way.pop(future)
            try:
                trial.add(number, future.result())
            except BrokenExecutor as error:
                raise FailureError(
                    f"{trial.pair}: a process that simulated a crossing died, perhaps for lack of "
                    "memory"
                ) from error
            except Exception:  # any error counts against the method and does not end the trial
                _log.exception("simulated crossing %d of %s failed", number, trial.pair)
                trial.give_up(number)
        yield trial.share
    for future in under_way:
        future.cancel()


def single_pair_site(site: Site, pair: VehicleBridgePair) -> Site:
    """Return the site with this vehicle and this bridge only; raise KeyError if they are unknown.

    The vehicle's sensors are reduced to its centre readings, which are simulated.
    """
    chosen = {
        "vehicles": (site.vehicle(pair.vehicle),),
        "bridges": (site.bridge(pair.bridge),),
    }
    return middle_site(site.model_copy(update=chosen))


def conditions_of(vehicle: Vehicle, bridge: Bridge, site: Site) -> ValidationConditions:
    """Return road, speed and sensors from the site file, or the usual ones."""
    sensor = middle_sensor(site.sensor, vehicle)
    twin = vehicle.twin_tyre_distance_m is not None and vehicle.twin_tyre_distance_m[1] > 0.0
    is_surface = twin or bool(vehicle.rear_axle_offset_m) or vehicle.tandem is not None
    return ValidationConditions(
        speed_m_per_s=bridge.survey_speed_m_per_s or _SPEED_M_PER_S,
        road_class=bridge.road_class or _ROAD_CLASS,
        road="surface" if is_surface else "groove",
        # A simulated truck has one rate, the lowest of its sensors'.
        rate_hz=min(sensor.rate_hz),
        noise_density_ug_per_rthz=sensor.noise_density_ug_per_rthz,
    )


def one_crossing(
    site: Site, settings: IdentificationSettings, seed: int, number: int
) -> ValidationCrossing:
    """Draw, simulate and identify the crossing `number` of the site's only pair."""
    bridge = site.bridges[0]
    conditions = conditions_of(site.vehicles[0], bridge, site)
    truth, weak = drawn_truth(site, conditions, seed, number)
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2)
    given = {
        "seed": seed,
        "direction": "start_to_end" if truth.conditions.forward else "end_to_start",
        "weak_element": None if weak is None else weak + 1,
        "ei_ratio": tuple((truth.beam.flexural_rigidity_nm2 / nominal).tolist()),
    }
    try:
        run, declared = _driven(site, truth, conditions, seed)
    except FailureError as error:
        _log.warning("crossing %d was not simulated: %s", seed, error)
        return _not_simulated(site, seed)
    found = identify_simulated([run], declared, settings)
    if len(found) != 1:
        return ValidationCrossing.model_validate(given | {"verdict": "not_found"})
    return ValidationCrossing.model_validate(
        given | _result_fields(found[0].result, nominal.tolist())
    )


def _driven(
    site: Site, truth: CrossingTruth, conditions: ValidationConditions, seed: int
) -> tuple[Run, Site]:
    """Return the recorded run of a crossing, and the site that declares its sensors."""
    if site.vehicles[0].tandem is not None:
        return drawn_tandem(site, truth, seed, seed).recorded
    drawn = drive(site, truth, seed, noise_ug_per_rthz=conditions.noise_density_ug_per_rthz)
    return drawn.run, drawn.site


def _not_simulated(site: Site, seed: int) -> ValidationCrossing:
    """Return the result of a crossing that could not be computed."""
    elements = site.bridges[0].elements
    return ValidationCrossing(
        seed=seed, direction="start_to_end", ei_ratio=(1.0,) * elements, verdict="not_simulated"
    )


def _result_fields(result: CrossingResult, nominal: list[float]) -> dict[str, object]:
    fields: dict[str, object] = {
        "verdict": result.verdict,
        "reasons": tuple(str(reason) for reason in result.reasons),
        "evaluations": int(
            sum(result.diagnostics.get(key, 0.0) for key in ("iterations", "chain_evaluations"))
        ),
    }
    if result.parameters is None:
        return fields
    elements = [result.parameters[f"EI_{e + 1}"] for e in range(len(nominal))]
    for key in ("q025", "q50", "q975"):
        fields[f"ei_ratio_{key}"] = tuple(
            getattr(element, key) / nominal_ei
            for element, nominal_ei in zip(elements, nominal, strict=True)
        )
    return fields


class CrossingErrors(NamedTuple):
    """Errors of one crossing with an answer, element by element."""

    z: np.ndarray[tuple[int], np.dtype[np.float64]]
    std_log: np.ndarray[tuple[int], np.dtype[np.float64]]
    is_covered: np.ndarray[tuple[int], np.dtype[np.bool_]]


def errors_of(tried: ValidationCrossing) -> CrossingErrors:
    """Return the errors of a crossing with an answer."""
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
    return CrossingErrors(
        np.log(middle / truth) / np.maximum(std_log, 1e-12),
        std_log,
        (low <= truth) & (truth <= high),
    )


def figures_of(tried: Sequence[ValidationCrossing]) -> ValidationFigures:
    """Return the statistics of crossings."""
    answered = [one for one in tried if one.is_answered]
    errors = [errors_of(one) for one in answered]
    z = np.concatenate([e.z for e in errors]) if errors else np.empty(0)
    good = [
        float(np.abs(e.z).max())
        for one, e in zip(answered, errors, strict=True)
        if one.verdict == "good"
    ]
    weak = [one for one in answered if one.weak_element is not None]
    return ValidationFigures(
        crossings=len(tried),
        good=len(good),
        intervals=z.size,
        covered=sum(int(e.is_covered.sum()) for e in errors),
        rms_z=float(np.sqrt(np.mean(z * z))) if z.size else None,
        largest_z_good=max(good, default=None),
        std=float(np.median(np.concatenate([e.std_log for e in errors]))) if errors else None,
        weak=len(weak),
        weak_found=sum(_of_weak(one.ei_ratio_q975, one) < FOUND_BELOW for one in weak),
        evaluations=sum(one.evaluations or 0 for one in tried),
    )


def _of_weak(values: tuple[float, ...], tried: ValidationCrossing) -> float:
    assert tried.weak_element is not None  # noqa: S101 - asked of such only
    return values[tried.weak_element - 1]


def judge_trial(tried: Sequence[ValidationCrossing]) -> TrialOutcome | None:
    """Return whether the first crossings of a trial pass or fail; None if there are too few.

    A trial ends early where further crossings cannot save it, or where there is no objection.
    """
    figures = figures_of(tried)
    elements = len(tried[0].ei_ratio) if tried else 0
    objection = _objection(tried, figures, elements)
    if objection is not None:
        return TrialOutcome(False, objection)
    is_sure = (
        figures.good == figures.crossings >= FEWEST
        and figures.covered >= SURE_COVERAGE * figures.intervals
        and (figures.rms_z or 0.0) <= SURE_RMS_Z
    )
    if figures.crossings < CROSSINGS and not is_sure:
        return None
    return TrialOutcome(True, _passing_reason(tried, figures))


def _objection(
    tried: Sequence[ValidationCrossing], figures: ValidationFigures, elements: int
) -> str | None:
    """Return an objection that no further crossing could remove."""
    for one in tried:
        if one.verdict != "good":
            continue
        worst = float(np.abs(errors_of(one).z).max())
        if worst > LARGEST_Z_GOOD:
            element = int(np.abs(errors_of(one).z).argmax()) + 1
            return (
                f"the crossing of seed {one.seed} is good, but element {element} of it is wrong by "
                f"{worst:.1f} standard deviations; at most {LARGEST_Z_GOOD:g} are allowed"
            )
        if one.weak_element is not None and _of_weak(one.ei_ratio_q025, one) > MISSED_ABOVE:
            return (
                f"the crossing of seed {one.seed} is good, but it takes element "
                f"{one.weak_element}, which has lost half of its EI, for undamaged"
            )
    others = figures.crossings - figures.good
    if others > CROSSINGS - FEWEST_GOOD:
        return (
            f"{figures.good} of {count_of(figures.crossings, 'crossing')} are good; at least "
            f"{FEWEST_GOOD} of {CROSSINGS} must be ({_why_not(tried)})"
        )
    # All remaining intervals may contain the truth, with zero errors.
    to_come = (CROSSINGS - figures.crossings) * elements
    missed = figures.intervals - figures.covered
    if missed > (1.0 - LEAST_COVERAGE) * (figures.intervals + to_come):
        return (
            f"{missed} of {figures.intervals} intervals (95 %) of {_answered(tried)} miss the "
            f"truth; at most {100 * (1.0 - LEAST_COVERAGE):.0f} % may"
        )
    squares = figures.intervals * (figures.rms_z or 0.0) ** 2
    if squares > LARGEST_RMS_Z**2 * (figures.intervals + to_come):
        return (
            f"errors are {figures.rms_z:.2f} standard deviations (root mean square of "
            f"{count_of(figures.intervals, 'element')} in {_answered(tried)}); at most "
            f"{LARGEST_RMS_Z:g} are allowed"
        )
    return None


def _answered(tried: Sequence[ValidationCrossing]) -> str:
    """Return the number of crossings with intervals, in words."""
    return count_of(sum(one.is_answered for one in tried), "crossing")


def _why_not(tried: Sequence[ValidationCrossing]) -> str:
    """Return verdicts and reasons of crossings that are not good, the most frequent first."""
    listed = []
    others = [one for one in tried if one.verdict != "good"]
    for verdict, number in Counter(one.verdict for one in others).most_common():
        reasons = sorted(why for one in others if one.verdict == verdict for why in one.reasons)
        listed.append(f"{number} {verdict}")
        if reasons:
            listed[-1] += f" ({', '.join(why for why, _ in Counter(reasons).most_common())})"
    return ", ".join(listed)


def _passing_reason(tried: Sequence[ValidationCrossing], figures: ValidationFigures) -> str:
    """Return the figures of a trial that passed, each with its limit."""
    missed, allowed = figures.intervals - figures.covered, figures.most_missed
    others = _why_not(tried)
    of_weak = count_of(figures.weak, "crossing")
    weak = f"; a weak element is detected in {figures.weak_found} of {of_weak}"
    return (
        f"{figures.good} of {figures.crossings} crossings are good{others and f', {others}'} (at "
        f"least {FEWEST_GOOD} of {CROSSINGS} must be good); {missed} of {figures.intervals} "
        f"intervals (95 %) miss the truth (at most {allowed} may){weak if figures.weak else ''}"
    )
