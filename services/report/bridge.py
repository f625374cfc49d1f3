"""Contents of the report on one bridge, before the page is laid out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence, Set
from pathlib import Path
from typing import NamedTuple

from schemas.results import RESOLVED, BridgeResult, CrossingResult, Results
from schemas.site import Bridge, Site
from services.common.errors import InputError
from services.common.extras import check_extras
from services.common.language import ENGLISH, Language
from services.common.options import CERTIFICATES
from services.execution.blas import one_blas_thread
from services.history.bridge_history import BridgeHistory
from services.history.validation_files import (
    has_failed_validation,
    pairs_with_intervals,
    pairs_without_validation,
    records_of,
    validation_notes,
    validations_passed,
)
from services.identification.baseline_cautions import simulated_alone
from services.identification.comparison import (
    Comparison,
    Estimate,
    Stated,
    compare,
    smallest_detectable,
    weak_before,
)
from services.report.cautions import CautionBasis, cautions
from services.report.earlier import (
    EarlierMeasurement,
    NamedResults,
    SurveyFile,
    before_of,
    combined_surveys,
)
from services.report.quality import MAX_REASONS, quality, realm_of, reasons_of
from services.report.repeats import newest_of_each, repeated
from services.viewer.bridge_view import BridgeView, describe_bridge, view_of_bridge
from services.viewer.crossing_view import CrossingView

_LATEST_S = 7_258_118_400.0
"""The year 2200, as a Unix time in s."""
LARGEST_MISSED_LOSS = 0.25
"""Detectable loss of an element above which no finding is `sound`."""


class BridgeFinding(NamedTuple):
    """The conclusion, with its certainty."""

    kind: str
    """One of `weak`, `known` (weak before and unchanged), `sound`, `open` (a loss may have been
    missed), `doubtful` and `nothing`."""
    headline: str
    sentences: tuple[str, ...]


class BridgeReport(NamedTuple):
    """One bridge in a report."""

    bridge: Bridge
    view: BridgeView
    crossings: tuple[CrossingResult, ...]
    """Crossings in order of time."""
    sources: tuple[str, ...]
    """Names of the results files."""
    programs: tuple[str, ...]
    computed_s: float
    """Time at which the computation of the newest results started, s since 1970 UTC."""
    site: Site
    before: EarlierMeasurement | None
    finding: BridgeFinding
    quality: str
    cautions: tuple[str, ...] = ()
    """Sentences on what limits the finding, or belongs next to it."""
    is_validated: bool = True
    """Whether site validation of each of its trucks has passed on this bridge."""
    past: BridgeHistory | None = None
    """History of the bridge, if one was given."""

    @property
    def used(self) -> list[CrossingResult]:
        """Crossings behind the numbers."""
        return [one for one in self.crossings if one.crossing_id in self.view.used]


def bridge_reports(
    files: Sequence[tuple[Path, Results, Site]],
    baseline: Path | NamedResults | None,
    site_file: Path | None = None,
    language: Language = ENGLISH,
    validations: Path = CERTIFICATES,
) -> list[BridgeReport]:
    """Return one report for each bridge that was crossed, in the order of the site files.

    Of a crossing in several files the newest result counts (see `newest_of_each`). The numbers of a
    bridge are those of the state with the newest crossing; if other files have good crossings of
    its realm that are not in it, all are fused. `baseline` is the results file to compare with, as
    a path or already read; by default the site file names it, relative to the folder of `site_file`
    if one was given, else to that of the results. `validations` is the folder of validation
    records. Raise InputError if a baseline does not fit, or results do not fit their site file.
    """
    for path, results, site in files:
        _check(path, results, site)
    names = dict.fromkeys(
        bridge.id
        for _, results, site in files
        for bridge in site.bridges
        if any(crossing.bridge == bridge.id for crossing in results.crossings)
    )
    return [_report(name, files, baseline, site_file, language, validations) for name in names]


def _check(path: Path, results: Results, site: Site) -> None:
    for crossing in results.crossings:
        elements = site.bridge(crossing.bridge).elements
        names = {f"EI_{n}" for n in range(1, elements + 1)}
        if crossing.parameters is not None and not names <= crossing.parameters.keys():
            raise InputError(
                f"{path}: {crossing.crossing_id[:80]} does not have the {elements} elements that "
                f"the site file gives {crossing.bridge}"
            )
        if not 0.0 <= crossing.entry_time < _LATEST_S:
            raise InputError(
                f"{path}: entry_time {crossing.entry_time:g} s is not a time in s since 1970"
            )


def _report(
    name: str,
    files: Sequence[tuple[Path, Results, Site]],
    baseline: Path | NamedResults | None,
    site_file: Path | None,
    language: Language,
    validations: Path,
) -> BridgeReport:
    about = [f for f in files if any(c.bridge == name for c in f[1].crossings)]
    about.sort(key=lambda file: file[1].created)
    newest, repeats = newest_of_each(name, [results for _, results, _ in about])
    path, last, site = about[-1]
    crossings = tuple(sorted(newest.values(), key=lambda crossing: crossing.entry_time))
    state = _latest_state(name, [results for _, results, _ in about], newest)
    if len(about) > 1:
        state = _state_of_all(name, state, crossings)
    bridges = {} if state is None else {name: state}
    merged = last.model_copy(update={"crossings": crossings, "bridges": bridges})
    bridge = site.bridge(name)
    site_folder = None if site_file is None else site_file.parent
    before = before_of(bridge, baseline, path, site_folder)
    stored = None if before is None else before.estimate
    view = view_of_bridge(bridge, merged, stored)
    used = tuple(crossing for crossing in crossings if crossing.crossing_id in view.used)
    combined = None
    if before is None:
        combined = combined_surveys(_survey_files(name, about), used, site_file)
    records = records_of(validations, site, pairs_with_intervals(used))
    unvalidated = {pair: records[pair] for pair in pairs_without_validation(used)}
    notes = tuple(validation_notes(validations, site, unvalidated, language))
    passed = validations_passed(records, language)
    basis = CautionBasis(bridge, view, used, before, combined, notes)
    failed = ["validation_failed"] if has_failed_validation(unvalidated) else []
    limits = [language.text(f"finding.{key}") for key in (*failed, *_other_origin(used, before))]
    return BridgeReport(
        bridge,
        view,
        crossings,
        tuple(path.name for path, _, _ in about),
        tuple(dict.fromkeys(f"{results.program} {results.version}" for _, results, _ in about)),
        last.created,
        site,
        before,
        _finding(view, crossings, stored, language, limits),
        " ".join((quality(view, crossings, language), *repeated(repeats, language), *passed)),
        tuple(cautions(basis, language)),
        not notes,
    )


def _survey_files(name: str, files: Sequence[tuple[Path, Results, Site]]) -> list[SurveyFile]:
    """Return the files of a bridge with the times of its crossings."""
    found = []
    for path, results, _ in files:
        times = [c.entry_time for c in results.crossings if c.bridge == name]
        found.append(SurveyFile(path.name, min(times), max(times)))
    return found


def _latest_state(
    name: str, files: Sequence[Results], crossings: dict[str, CrossingResult]
) -> BridgeResult | None:
    def moment(state: BridgeResult) -> float:
        times = [crossings[c].entry_time for c in state.crossings_used if c in crossings]
        return max(times, default=0.0)

    states = [results.bridges[name] for results in files if name in results.bridges]
    return max(states, key=moment) if states else None


def _state_of_all(
    name: str, state: BridgeResult | None, crossings: Sequence[CrossingResult]
) -> BridgeResult | None:
    """Return a state with all good crossings of the newest realm, fused again if it lacks any."""
    realm = crossings[-1].realm
    good = [c for c in crossings if c.realm == realm and c.verdict == "good"]
    fusable = {c.crossing_id for c in good if c.fusion_likelihood is not None}
    known = set[str]()
    if state is not None:
        known = {*state.crossings_used, *(one.crossing_id for one in state.crossings_left_out)}
    if fusable <= known:
        return state
    check_extras("a report of several results files", ("identify",))
    # Kernels are slow to import, and most reports are of one file.
    from services.execution.fuse_results import fuse_bridge

    with one_blas_thread():
        return fuse_bridge(name, [c for c in crossings if c.realm == realm])


def _one_by_one(
    view: BridgeView,
    crossings: Sequence[CrossingResult],
    baseline: Estimate | None,
    language: Language,
) -> Iterator[str]:
    """Yield a sentence on the scatter of the good crossings of the campaign at weak elements.

    Those that fusion left out are not among them.
    """
    state = view.state
    left_out = set() if state is None else {one.crossing_id for one in state.crossings_left_out}
    realm = realm_of(state, crossings)
    own = {one.crossing_id for one in crossings if one.realm == realm}
    good = [
        one
        for one in view.crossings
        if one.verdict == "good"
        and one.interval_nm2 is not None
        and one.crossing_id in own
        and one.crossing_id not in left_out
    ]
    if view.comparison is None or len(good) < 2:
        return
    found = []
    for crossing in good:
        assert crossing.rigidity_nm2 is not None  # noqa: S101 - it has an interval
        assert crossing.interval_nm2 is not None  # noqa: S101
        estimate = Estimate(crossing.rigidity_nm2, *crossing.interval_nm2.T)
        found.append(compare(estimate, view.nominal_nm2, view.edges_m, baseline))
    number, elements, is_narrower, is_outside = 0, list[str](), list[bool](), False
    for weak in view.comparison.weak:
        losses = [1.0 - one.elements[weak.number - 1].ratio for one in found if one is not None]
        if len(losses) >= 2:
            number, text = len(losses), _range_of(losses, language)
            elements.append(language.text("losses.element", element=weak.number, losses=text))
            is_narrower.append(_is_narrower(view, good, weak.number - 1))
            low, high = (round(100.0 * end) for end in (min(losses), max(losses)))
            is_outside |= not low <= round(100.0 * (1.0 - weak.ratio)) <= high
    if elements:
        key = "single" if len(view.used) < 2 else "narrower" if all(is_narrower) else "wider"
        listed = language.listed(elements)
        yield language.text(f"finding.scatter.{key}", number=number, elements=listed)
        if is_outside and len(view.used) > 1:
            yield language.text("finding.scatter.outside")


def _is_narrower(view: BridgeView, crossings: Sequence[CrossingView], n: int) -> bool:
    """Return whether the state's interval of element `n`, from 0, is narrower than each alone."""
    assert view.estimate is not None  # noqa: S101 - its elements were compared
    whole = view.estimate.high[n] / view.estimate.low[n]
    alone = (one.interval_nm2[n] for one in crossings if one.interval_nm2 is not None)
    return bool(whole < min(high / low for low, high in alone))


def _range_of(losses: Sequence[float], language: Language) -> str:
    """Return the losses of an element in words; a negative one is a gain."""
    low, high = 100.0 * min(losses), 100.0 * max(losses)
    if round(high) < 0:
        return language.text("losses.gain", loss=-high, gain=-low)
    if round(low) < 0:
        return language.text("losses.mixed", gain=-low, high=high)
    key = "losses.same" if round(low) == round(high) else "losses.range"
    return language.text(key, low=low, high=high)


def _other_origin(used: Sequence[CrossingResult], before: EarlierMeasurement | None) -> list[str]:
    """Return the key of the limit where only the measurement or its baseline was simulated."""
    realms = [{one.realm for one in some} for some in (used, before.crossings if before else ())]
    which = simulated_alone(*realms)
    return [] if which is None else [f"simulated_{which}"]


def _finding(
    view: BridgeView,
    crossings: Sequence[CrossingResult],
    baseline: Estimate | None,
    language: Language,
    limits: Sequence[str] = (),
) -> BridgeFinding:
    """Return the finding; `limits` are the sentences that a headline must not go without."""
    if view.estimate is None:
        return _no_finding(crossings, language)
    single = tuple(_one_by_one(view, crossings, baseline, language))
    wording = (*describe_bridge(view, language), *single)
    if view.is_doubtful:
        why = dict.fromkeys(_reasons_of_state(view, crossings, language))
        because = (language.text("finding.reasons", reasons=" ".join(why)),) if why else ()
        headline = language.text("finding.doubtful")
        return BridgeFinding("doubtful", headline, (*wording, *because))
    if view.comparison is None:
        return BridgeFinding("open", language.text("finding.incomparable"), wording)
    weak = view.comparison.weak
    but = _but_implausible(view.comparison, language) + "".join(f" {one}" for one in limits)
    if weak and view.ambiguous_neighbours:
        numbers = language.listed([str(one.number) for one in weak])
        headline = language.choice("finding.near", len(weak), elements=numbers)
        return BridgeFinding("weak", headline + but, wording)
    if weak:
        key = "finding.appears" if but else "finding.weak"
        return BridgeFinding("weak", language.choice(key, len(weak)) + but, wording)
    missed = _why_open(view, view.comparison, language)
    known = still_weak(view, baseline)
    if known:
        headline = language.choice("finding.known", len(known), elements=language.listed(known))
        seen = () if missed is None else tuple(_seen(view.comparison, view.vague, language))
        kind = "known" if missed is None and not but else "open"
        without: tuple[Stated, ...] = ("detectable",) if seen else ()
        described = describe_bridge(view, language, without)
        return BridgeFinding(kind, headline + but, (*described, *single, *seen))
    if missed is None:
        kind = "open" if but else "sound"
        return BridgeFinding(kind, language.text("finding.none") + but, wording)
    # The headline names the unresolved elements unless they are most of them.
    are_named = 2 * len(view.vague) <= len(view.comparison.elements)
    without = ("detectable", "unresolved") if are_named else ("detectable",)
    described = describe_bridge(view, language, without)
    sentences = (*described, *single, *_seen(view.comparison, view.vague, language))
    return BridgeFinding("open", missed + but, sentences)


def still_weak(view: BridgeView, baseline: Estimate | None) -> list[str]:
    """Return the numbers of the elements that are as weak as in the baseline."""
    if baseline is None or view.estimate is None:
        return []
    now = compare(view.estimate, view.nominal_nm2, view.edges_m)
    before = weak_before(baseline, view.nominal_nm2, view.edges_m)
    numbers = {one.number for one in before} & {one.number for one in (now.weak if now else ())}
    return [str(number) for number in sorted(numbers)]


def _but_implausible(found: Comparison, language: Language) -> str:
    """Return what a headline adds if elements are implausibly stiff; empty if none is."""
    numbers = [str(element.number) for element in found.implausible]
    if not numbers:
        return ""
    listed = language.listed(numbers)
    return " " + language.choice("finding.implausible", len(numbers), elements=listed)


def _why_open(view: BridgeView, found: Comparison, language: Language) -> str | None:
    """Return why a loss may have been missed; None where a loss of any element would be clear."""
    vague, before = sorted(view.vague), "_before" if found.unresolved_before else ""
    if 2 * len(vague) > len(found.elements):
        return language.text(f"finding.open{before}")
    if vague:
        numbers = language.listed([str(number) for number in vague])
        limit = 100.0 * RESOLVED
        key = f"finding.partly{before}"
        return language.choice(key, len(vague), elements=numbers, limit=limit)
    if max(one.detectable_loss for one in found.elements) > LARGEST_MISSED_LOSS:
        return language.text("finding.coarse", limit=100.0 * LARGEST_MISSED_LOSS)
    return None


def _seen(found: Comparison, vague: Set[int], language: Language) -> Iterator[str]:
    """Yield from which loss on resolved elements are reliably called weak; nothing without any."""
    elements = [one for one in found.elements if one.is_comparable and one.number not in vague]
    if elements:
        key = "rest.detectable" if len(elements) == len(found.elements) else "rest.resolved"
        yield smallest_detectable(key, elements, language)


def _reasons_of_state(
    view: BridgeView, crossings: Sequence[CrossingResult], language: Language
) -> Iterator[str]:
    """Yield the reasons of the state, then those of the crossings in it."""
    if view.state is not None:
        pairs = zip(view.state.reasons, view.state.reason_texts, strict=True)
        yield from (language.bridge_reason(code, text) for code, text in pairs)
    for crossing in crossings:
        if crossing.crossing_id in view.used:
            yield from reasons_of(crossing, language)


def _no_finding(crossings: Sequence[CrossingResult], language: Language) -> BridgeFinding:
    """Return the finding without a usable crossing: the most frequent reasons."""
    counted = Counter(text for crossing in crossings for text in reasons_of(crossing, language))
    why = " ".join(text for text, _ in counted.most_common(MAX_REASONS))
    suspect = sum(crossing.verdict == "suspect" for crossing in crossings)
    total = len(crossings)
    if not suspect:
        which = language.choice("nothing.rejected", total)
        return BridgeFinding("nothing", language.text("finding.nothing"), (which, why))
    which = language.choice("nothing.suspect", total)
    if suspect < total:
        which = language.choice("nothing.mixed", suspect, total=total)
    which += " " + language.choice("nothing.drawn", suspect)
    return BridgeFinding("doubtful", language.text("finding.nothing_yet"), (which, why))
