"""What there is to say of one bridge, before it becomes a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from schemas.reasons import LEFT_OUT_TEXTS, Reason
from schemas.results import BridgeResult, Crossing, Results
from schemas.site import Bridge, Site
from services.common.errors import InputError
from services.execution.blas import one_blas_thread
from services.history.archive import bridges_of
from services.history.past import Past, past_of
from services.history.periods import Unit
from services.identification.comparison import Estimate, compare
from services.identification.placed import sensors_in_words
from services.viewer.baseline import named_baseline, stored_baseline
from services.viewer.bridge_view import BridgeView, told, view_of_bridge

_LATEST_S = 7_258_118_400.0
"""The year 2200."""
_LARGEST_DEVIATION = 4.0
"""Standard deviations; crossings that differ by more do not agree."""
_MOST_REASONS = 3
"""In the box; all of them stand below it."""
_ADVICE = {
    Reason.CHANNEL_MISSING: "Look at plugs and sensors: four accelerometers are needed.",
    Reason.SENSOR_SATURATED: "Use accelerometers of a larger range, or drive more slowly.",
    Reason.CHANNEL_SWAPPED: (
        "Look at the wiring of these sensors. If only their names are exchanged in the files, put "
        "them right and identify again; the drive need not be repeated."
    ),
    Reason.CHANNEL_INVERTED: (
        "Look at which way these sensors are mounted, declare it (up in [sensor] of the site "
        "file), import the files and identify again; the drive need not be repeated."
    ),
    Reason.CHANNEL_STUCK: "Look at plugs and sensors: one of them does not measure.",
    Reason.CHANNEL_BRIDGED: "Leave missing samples out, rather than bridge them before the import.",
    Reason.CHANNELS_ALIKE: "Look at the wiring: one sensor seems to be recorded twice.",
    Reason.ROLL_NOT_SEEN: (
        "Put a second sensor on the other side of the part, or this one in the middle."
    ),
    Reason.SENSORS_DISAGREE: (
        "Look at the mounts and the cables of these sensors, and have their gains calibrated."
    ),
    Reason.CHANNEL_BIASED: "Declare whether gravity is in the signals, or change the sensor.",
    Reason.SIGNAL_SPIKES: "Look at cables and plugs, and at what else is on the sensors' supply.",
    Reason.CHANNEL_SLIPPED: "Look for samples that this sensor, its buffer or the import loses.",
    Reason.GAIN_CHANGED: "Look for a loose sensor or plug.",
    Reason.NOT_FINITE: "Look at the recording: it has values that are no numbers.",
    Reason.GAP_ON_BRIDGE: "Recover the missing samples from the truck's spool, or drive again.",
    Reason.INCOMPLETE_CROSSING: "Record a few seconds before and after the bridge.",
    Reason.STOPPED_ON_BRIDGE: "Drive again without stopping.",
    Reason.SPEED_TOO_LOW: "Drive again, at 5 m/s or more.",
    Reason.POSITION_OUTAGE: "Look at the satellite receiver and its antenna.",
    Reason.VEHICLE_DIFFERS_FROM_SITE: "Mend the truck's values in the site file.",
    Reason.OTHER_TRUCK_ON_BRIDGE: "Drive again, one truck after the other.",
    Reason.MODEL_MISFIT: (
        "Look at the truck's values, the span, other traffic during the crossing; on a rough road "
        "front and rear wheel may have felt different roads. Drive again."
    ),
    Reason.RESIDUALS_COLOURED: "Look at truck, span and other traffic; drive again.",
    Reason.NOISE_ABOVE_DECLARED: (
        "Measure the sensors' noise at standstill, declare it, and identify again."
    ),
    Reason.NOISE_BELOW_DECLARED: "Declare the sensors' true noise, and identify again.",
    Reason.IMPLAUSIBLE_VEHICLE: (
        "Make sure that it was this truck without a trailer, with its sensors in the middle of "
        "axles and frame; measure the wheelbase."
    ),
    Reason.MORE_AXLES_THAN_DECLARED: (
        "Drive without a trailer, or with a truck of two axles; look at the rear body sensor."
    ),
    Reason.MISMATCH_IMPLAUSIBLE: (
        "Measure tyres and tracks of both axles and declare them; make sure that the sensors are "
        "in the middle."
    ),
    Reason.COMMON_DISTURBANCE: "Mount the sensors upright; look at their common supply.",
    Reason.IMPLAUSIBLE_BRIDGE: (
        "Look at sensors and receiver. Where the bridge is built stiffer there, declare it "
        "(flexural_rigidity_per_element_nm2)."
    ),
    Reason.POSITION_INCONSISTENT: "Check the coordinates of the bearings and the antenna's place.",
    Reason.SPEED_INCONSISTENT: "Look at the receiver, and at the unit of its speeds in the import.",
    Reason.APPROACH_TOO_SHORT: "Record from 40 m before the bridge to 25 m behind it.",
    Reason.AXLES_ALIKE: "Load one axle more than the other.",
    Reason.ACCELERATING_CG_UNKNOWN: "Keep the speed, or declare the height of the centre of mass.",
    Reason.NOT_CONVERGED: "Look whether the site file is near the truth; drive again.",
    Reason.SAMPLER_DIAGNOSTICS: "Identify again with another --seed, or drive again.",
    Reason.FAILED: "Report it to who made the program, with the recording.",
    Reason.NO_NOISE_MODEL: "Identify with method pre.",
    Reason.CONTINUOUS_BRIDGE: "Identify with method pre.",
}
"""What to do about it, as docs/verdicts.md says at more length."""


class Finding(NamedTuple):
    """The answer, and how sure it is."""

    kind: str
    """`weak`, `sound`, `open` (elements cannot be told), `doubtful` or `nothing`."""
    headline: str
    sentences: tuple[str, ...]


class BridgeReport(NamedTuple):
    """One bridge in a report."""

    bridge: Bridge
    view: BridgeView
    crossings: tuple[Crossing, ...]
    """In order of time."""
    sources: tuple[str, ...]
    """Names of the results files."""
    programs: tuple[str, ...]
    site_hashes: tuple[str, ...]
    baseline_name: str | None
    finding: Finding
    quality: str
    past: Past | None = None
    """What a history holds of it, if one was given."""
    sensors: tuple[str, ...] = ()
    """A line for each sensor of the trucks that name their own."""


def bridge_reports(
    files: Sequence[tuple[Path, Results, Site]], baseline: Path | None, beside: Path | None = None
) -> list[BridgeReport]:
    """One report for each bridge that was crossed, in the order of the site files.

    Of a crossing that several files hold the newest result counts; of a bridge's states the one
    with the newest crossing. `baseline` is a results file with which to compare; else the one that
    the site file names, whose folder is `beside` (default: that of the results). InputError if a
    baseline does not fit, or results do not fit their site file.
    """
    for path, results, site in files:
        _check(path, results, site)
    names = dict.fromkeys(
        bridge.id
        for _, results, site in files
        for bridge in site.bridges
        if any(crossing.bridge == bridge.id for crossing in results.crossings)
    )
    return [_report(name, files, baseline, beside) for name in names]


def with_pasts(
    reports: Iterable[BridgeReport], history: Path, unit: Unit, say: Callable[[str], None]
) -> list[BridgeReport]:
    """The reports with what a history holds of their bridges, in the realm of what is reported.

    `say` is told of bridges that are not in it. InputError: there is no such folder.
    """
    known = bridges_of(history)
    found = []
    for report in reports:
        bridge, realm = report.bridge.id, report.crossings[-1].realm
        if (realm, bridge) in known:
            with one_blas_thread():
                report = report._replace(past=past_of(history, realm, bridge, unit, say))
        else:
            say(f"{history}: has no bridge {bridge} in realm {realm}; the report is without it")
        found.append(report)
    return found


def _check(path: Path, results: Results, site: Site) -> None:
    for crossing in results.crossings:
        elements = site.bridge(crossing.bridge).elements
        names = {f"EI_{n}" for n in range(1, elements + 1)}
        if crossing.parameters is not None and not names <= crossing.parameters.keys():
            raise InputError(
                f"{path}: {crossing.crossing_id[:80]} has not the {elements} elements that the "
                f"site file gives {crossing.bridge}"
            )
        if not 0.0 <= crossing.entry_time < _LATEST_S:
            raise InputError(f"{path}: entry_time {crossing.entry_time:g} s is no time since 1970")


def _report(
    name: str,
    files: Sequence[tuple[Path, Results, Site]],
    baseline: Path | None,
    beside: Path | None,
) -> BridgeReport:
    about = [f for f in files if any(c.bridge == name for c in f[1].crossings)]
    about.sort(key=lambda file: file[1].created)
    newest: dict[str, Crossing] = {}
    for _, results, _ in about:
        newest.update((c.crossing_id, c) for c in results.crossings if c.bridge == name)
    path, last, site = about[-1]
    state = _latest_state(name, [results for _, results, _ in about], newest)
    crossings = tuple(sorted(newest.values(), key=lambda crossing: crossing.entry_time))
    bridges = {} if state is None else {name: state}
    merged = last.model_copy(update={"crossings": crossings, "bridges": bridges})
    bridge = site.bridge(name)
    stored, baseline_name = _baseline(bridge, baseline, path, beside)
    view = view_of_bridge(bridge, merged, stored)
    return BridgeReport(
        bridge,
        view,
        crossings,
        tuple(path.name for path, _, _ in about),
        tuple(dict.fromkeys(f"{results.program} {results.version}" for _, results, _ in about)),
        tuple(dict.fromkeys(results.site_hash for _, results, _ in about)),
        baseline_name,
        _finding(view, crossings, stored),
        _quality(view, crossings),
        sensors=_sensors(site, crossings),
    )


def _sensors(site: Site, crossings: Sequence[Crossing]) -> tuple[str, ...]:
    """Sensors of the trucks that crossed, by their places; nothing of four in the middle."""
    drove = {crossing.vehicle for crossing in crossings}
    return tuple(
        f"{vehicle.id} {line}"
        for vehicle in site.vehicles
        if vehicle.id in drove
        for line in sensors_in_words(site.sensor, vehicle)
    )


def advice(crossings: Iterable[Crossing]) -> list[str]:
    """What to do so that the next crossing can be used, the commonest reason first."""
    counted = Counter(reason for crossing in crossings for reason in crossing.reasons)
    return list(dict.fromkeys(_ADVICE[r] for r, _ in counted.most_common() if r in _ADVICE))


def _latest_state(
    name: str, files: Sequence[Results], crossings: dict[str, Crossing]
) -> BridgeResult | None:
    def moment(state: BridgeResult) -> float:
        times = [crossings[c].entry_time for c in state.crossings_used if c in crossings]
        return max(times, default=0.0)

    states = [results.bridges[name] for results in files if name in results.bridges]
    return max(states, key=moment) if states else None


def _baseline(
    bridge: Bridge, given: Path | None, results: Path, beside: Path | None
) -> tuple[Estimate | None, str | None]:
    if given is not None:
        return stored_baseline(bridge, given)
    return named_baseline(bridge, beside or results.parent, required=beside is not None)


def _one_by_one(view: BridgeView, baseline: Estimate | None) -> Iterator[str]:
    """What each good crossing says of a weak element by itself: how far they scatter."""
    good = [c for c in view.crossings if c.verdict == "good" and c.interval_nm2 is not None]
    if view.comparison is None or len(good) < 2:
        return
    found = []
    for crossing in good:
        assert crossing.rigidity_nm2 is not None  # noqa: S101 - it has an interval
        assert crossing.interval_nm2 is not None  # noqa: S101
        estimate = Estimate(crossing.rigidity_nm2, *crossing.interval_nm2.T)
        found.append(compare(estimate, view.nominal_nm2, view.edges_m, baseline))
    for weak in view.comparison.weak:
        losses = [1.0 - one.elements[weak.number - 1].ratio for one in found if one is not None]
        if len(losses) >= 2:
            low, high = 100.0 * min(losses), 100.0 * max(losses)
            yield (
                f"By each of the {len(losses)} good crossings alone, element {weak.number} is "
                f"{low:.0f} to {high:.0f} % less stiff; one alone knows less than all together."
            )


def _finding(view: BridgeView, crossings: Sequence[Crossing], baseline: Estimate | None) -> Finding:
    if view.estimate is None:
        return _no_finding(crossings)
    said = (*told(view), *_one_by_one(view, baseline))
    if view.is_doubtful:
        of_state = () if view.state is None else view.state.reason_texts
        used = [crossing for crossing in crossings if crossing.crossing_id in view.used]
        of_crossings = (text for crossing in used for text in crossing.reason_texts)
        why = dict.fromkeys((*of_state, *of_crossings))
        because = ("The reasons: " + " ".join(why),) if why else ()
        headline = "Doubtful: to be looked at, not to be relied upon."
        return Finding("doubtful", headline, (*said, *because))
    if view.comparison is None:
        return Finding("sound", "The elements cannot be compared.", said)
    weak = view.comparison.weak
    if weak and view.elsewhere:
        numbers = " and ".join(str(one.number) for one in weak)
        what = f"element {numbers}" if len(weak) == 1 else f"elements {numbers}"
        return Finding("weak", f"Less stiff about {what}; which one is not certain.", said)
    if weak:
        what = "One element is" if len(weak) == 1 else f"{len(weak)} elements are"
        return Finding("weak", f"{what} clearly less stiff.", said)
    if 2 * len(view.unresolved) > len(view.comparison.elements):
        return Finding("open", "Single elements cannot be told, only the bridge as a whole.", said)
    if view.unresolved:
        headline = "No element is clearly less stiff, of those that can be told."
        return Finding("sound", headline, said)
    return Finding("sound", "No element is clearly less stiff.", said)


def _no_finding(crossings: Sequence[Crossing]) -> Finding:
    """No crossing could be used: the commonest reasons, for who reads no further."""
    counted = Counter(text for crossing in crossings for text in crossing.reason_texts)
    why = " ".join(text for text, _ in counted.most_common(_MOST_REASONS))
    suspect = sum(crossing.verdict == "suspect" for crossing in crossings)
    which = (
        "The only crossing was" if len(crossings) == 1 else f"All {len(crossings)} crossings were"
    )
    if not suspect:
        said = f"{which} rejected, and no number of {'it' if len(crossings) == 1 else 'them'} means"
        return Finding(
            "nothing", "Nothing can be said about this bridge.", (f"{said} anything.", why)
        )
    if suspect < len(crossings):
        which = f"None of the {len(crossings)} crossings is good, {suspect} {_are(suspect)}"
    where = "What it says stands" if suspect == 1 else "What they say stands"
    where += " in the evidence, to be looked at and not to be relied upon."
    return Finding(
        "doubtful", "Nothing can be relied upon yet.", (f"{which} suspect. {where}", why)
    )


def _are(number: int) -> str:
    return "is" if number == 1 else "are"


def _quality(view: BridgeView, crossings: Sequence[Crossing]) -> str:
    counts = Counter(crossing.verdict for crossing in crossings)
    parts = [f"{counts[v]} {v}" for v in ("good", "suspect", "rejected") if counts[v]]
    said = f"{len(crossings)} crossing{'s' if len(crossings) != 1 else ''}: {', '.join(parts)}."
    if view.estimate is None:
        return f"{said} None could be used."
    if view.state is not None and len(view.used) > 1:
        return " ".join((said, *_together(view.state, len(crossings))))
    others = [c for c in crossings if c.verdict == "good" and c.crossing_id not in view.used]
    which = "this one" if len(crossings) == 1 else "the newest usable one"
    said += f" The numbers below are of {which}."
    if view.state is not None and view.state.between_crossing_std is not None:
        said += (
            " Their intervals allow for how a bridge changes from one crossing to the next, which "
            "a single one cannot tell."
        )
    deviation = _largest_deviation(view.estimate, others)
    if deviation is None:
        return f"{said} No other good crossing confirms them."
    agree = "agree with them" if deviation <= _LARGEST_DEVIATION else "do NOT agree with them"
    which = "The other good crossing" if len(others) == 1 else "The other good crossings"
    if len(others) == 1:
        agree = agree.replace("agree", "agrees").replace("do NOT agrees", "does NOT agree")
    return f"{said} {which} {agree}: at most {deviation:.1f} standard deviations apart."


def _together(state: BridgeResult, crossings: int) -> Iterator[str]:
    """What many crossings that were fused say of how good they are."""
    used = len(state.crossings_used)
    all_of = f"all {used}" if used == crossings else f"{used} of them"
    yield f"The numbers below are of {all_of} together, a measurement that is {state.verdict}."
    left = Counter(LEFT_OUT_TEXTS.get(one.reason, one.reason) for one in state.crossings_left_out)
    if left:
        yield f"Left out: {'; '.join(f'{n} {why}' for why, n in left.most_common())}."
    low, high = state.between_crossing_std_q025, state.between_crossing_std_q975
    if state.between_crossing_std is not None and low is not None and high is not None:
        yield (
            f"From crossing to crossing EI changes by {100.0 * state.between_crossing_std:.1f} % "
            f"({100.0 * low:.1f} to {100.0 * high:.1f} %), beyond what each can tell."
        )


def _largest_deviation(estimate: Estimate, others: Sequence[Crossing]) -> float | None:
    """By how many standard deviations of both an element differs most, in logarithms."""
    width = np.log(estimate.high / estimate.low) / (2.0 * 1.96)
    found = []
    for crossing in others:
        parameters = crossing.parameters or {}
        elements = [parameters.get(f"EI_{n}") for n in range(1, estimate.mean.size + 1)]
        for n, element in enumerate(elements):
            if element is None or element.mean <= 0.0 or element.std <= 0.0:
                return None
            both = np.hypot(width[n], element.std / element.mean)
            found.append(abs(np.log(element.mean / estimate.mean[n])) / both)
    return float(max(found)) if found else None
