"""What there is to say of one bridge, before it becomes a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from schemas.reasons import Reason
from schemas.results import BridgeResult, Crossing, Results
from schemas.site import Bridge, Site
from services.common.errors import InputError
from services.identification.comparison import Estimate, compare, sentences
from services.viewer.baseline import named_baseline, stored_baseline
from services.viewer.bridge_view import BridgeView, view_of_bridge

_LATEST_S = 7_258_118_400.0
"""The year 2200."""
_LARGEST_DEVIATION = 4.0
"""Standard deviations; crossings that differ by more do not agree."""
_ADVICE = {
    Reason.CHANNEL_MISSING: "Look at plugs and sensors: four accelerometers are needed.",
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
    Reason.NOISE_ABOVE_DECLARED: "Measure the sensors' noise at standstill and declare it.",
    Reason.NOISE_BELOW_DECLARED: "Declare the sensors' true noise.",
    Reason.IMPLAUSIBLE_VEHICLE: "Measure the wheelbase; make sure that it was this truck.",
    Reason.POSITION_INCONSISTENT: "Check the coordinates of the bearings and the antenna's place.",
    Reason.AXLES_ALIKE: "Load one axle more than the other.",
    Reason.ACCELERATING_CG_UNKNOWN: "Keep the speed, or declare the height of the centre of mass.",
    Reason.NO_NOISE_MODEL: "Identify with method pre.",
    Reason.CONTINUOUS_BRIDGE: "Identify with method pre.",
}
"""What to do about it, as docs/verdicts.md says at more length."""


class Finding(NamedTuple):
    """The answer, and how sure it is."""

    kind: str
    """`weak`, `sound`, `doubtful` or `nothing`."""
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
                f"{low:.0f} to {high:.0f} % less stiff."
            )


def _finding(view: BridgeView, crossings: Sequence[Crossing], baseline: Estimate | None) -> Finding:
    if view.estimate is None:
        number = len(view.crossings)
        whole = "the one crossing" if number == 1 else f"any of the {number} crossings"
        return Finding(
            "nothing",
            "Nothing can be said about this bridge.",
            (f"No number of {whole} means anything; the reasons stand below.",),
        )
    said = (*sentences(view.comparison), *_one_by_one(view, baseline))
    if view.is_doubtful:
        used = [crossing for crossing in crossings if crossing.crossing_id in view.used]
        why = dict.fromkeys(text for crossing in used for text in crossing.reason_texts)
        because = ("The reasons: " + " ".join(why),) if why else ()
        headline = "Doubtful: to be looked at, not to be relied upon."
        return Finding("doubtful", headline, (*said, *because))
    if view.comparison is None:
        return Finding("sound", "The elements cannot be compared.", said)
    if view.comparison.weak:
        number = len(view.comparison.weak)
        what = "One element is" if number == 1 else f"{number} elements are"
        return Finding("weak", f"{what} clearly less stiff.", said)
    return Finding("sound", "No element is clearly less stiff.", said)


def _quality(view: BridgeView, crossings: Sequence[Crossing]) -> str:
    counts = Counter(crossing.verdict for crossing in crossings)
    parts = [f"{counts[v]} {v}" for v in ("good", "suspect", "rejected") if counts[v]]
    said = f"{len(crossings)} crossing{'s' if len(crossings) != 1 else ''}: {', '.join(parts)}."
    if view.estimate is None:
        return f"{said} None could be used."
    said += f" The numbers below are of {_used(view)}."
    others = [c for c in crossings if c.verdict == "good" and c.crossing_id not in view.used]
    deviation = _largest_deviation(view.estimate, others)
    if deviation is None:
        return f"{said} No other good crossing confirms them."
    agree = "agree with them" if deviation <= _LARGEST_DEVIATION else "do NOT agree with them"
    which = "The other good crossing" if len(others) == 1 else "The other good crossings"
    if len(others) == 1:
        agree = agree.replace("agree", "agrees").replace("do NOT agrees", "does NOT agree")
    return f"{said} {which} {agree}: at most {deviation:.1f} standard deviations apart."


def _used(view: BridgeView) -> str:
    if len(view.used) == 1:
        return "the newest usable one" if len(view.crossings) > 1 else "this one"
    return f"{len(view.used)} of them together"


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
