"""Cautions on the first page: what limits a finding, or belongs next to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pre_core.constants import SLOPE_SPREAD
from schemas.results import CrossingResult
from schemas.site import Bridge
from services.common.language import Language, utc_day
from services.identification.baseline_cautions import (
    doubts_of_baseline,
    origin_caution,
    shared_crossings,
)
from services.identification.bridge_remarks import bridge_remarks
from services.identification.comparison import (
    CLEAR_LOSS,
    IMPLAUSIBLE_GAIN,
    Comparison,
    Element,
    changes_in_words,
    compare,
    describe_possibly_weak,
    describe_weak_before,
)
from services.identification.comparison import possibly_weak as possibly_less_stiff
from services.identification.comparison import weak_before as of_baseline
from services.report.earlier import CombinedSurveys, EarlierMeasurement, days_between, season_of
from services.report.place import ends_of
from services.viewer.bridge_view import BridgeView

_LIKELY = 0.9
"""Probability from which a restrained end or a compliant bearing is stated on the first page."""
_MOST = 0.99
"""Largest probability that is stated: draws cannot show certainty."""
_APART_DAYS = 30
"""Days from which the dates of two surveys are a caution."""
_WARMER_K = 20.0
"""Difference of temperature in K by which the effect of a season is illustrated."""


class CautionBasis(NamedTuple):
    """The measurement that cautions are about."""

    bridge: Bridge
    view: BridgeView
    crossings: tuple[CrossingResult, ...]
    """Crossings behind the numbers, in order of time."""
    before: EarlierMeasurement | None
    combined: CombinedSurveys | None
    validation: tuple[str, ...] = ()
    """Sentences on pairs of truck and bridge without a passed site validation."""


def cautions(measured: CautionBasis, language: Language) -> Iterator[str]:
    """Yield the cautions on a finding, the most important one first."""
    if measured.view.estimate is None:
        return
    yield from _origin(measured, language)
    yield from measured.validation
    yield from _of_baseline(measured, language)
    comparison = measured.view.comparison
    if comparison is not None:
        yield from _implausible(comparison, language)
        yield from _implausible_before(measured, language)
        yield from describe_possibly_weak(possibly_weak(measured.view), language)
        yield from _higher(comparison, language)
        if comparison.weak or 2 * len(measured.view.vague) <= len(comparison.elements):
            limit = 100.0 * CLEAR_LOSS
            yield language.text(f"caution.clearly.{comparison.reference}", limit=limit)
    yield from _earlier(measured, language)
    yield from _seasons(measured, language)
    yield from _combined(measured.combined, language)
    yield from _ends(measured, language)
    yield from bridge_remarks(measured.crossings, language)


def possibly_weak(view: BridgeView) -> tuple[Element, ...]:
    """Return the elements of a bridge that are possibly less stiff."""
    return possibly_less_stiff(view.comparison, view.unresolved)


def weak_before(view: BridgeView, before: EarlierMeasurement | None) -> tuple[Element, ...]:
    """Return the elements that were clearly less stiff than the others in the baseline."""
    return () if before is None else of_baseline(before.estimate, view.nominal_nm2, view.edges_m)


def _alone(view: BridgeView, before: EarlierMeasurement | None) -> Comparison | None:
    """Return the elements of the baseline, each compared with its others."""
    if before is None:
        return None
    return compare(before.estimate, view.nominal_nm2, view.edges_m)


def named_elements(numbers: Sequence[int], language: Language) -> str:
    """Return `element 3` or `elements 3 and 5`."""
    which = "caution.element" if len(numbers) == 1 else "caution.elements"
    return language.text(which, elements=language.listed([str(number) for number in numbers]))


def _origin(measured: CautionBasis, language: Language) -> Iterator[str]:
    """Yield that only one of the measurement and its baseline was simulated."""
    before = () if measured.before is None else measured.before.crossings
    now, then = ({one.realm for one in some} for some in (measured.crossings, before))
    caution = origin_caution(now, then, language)
    if caution is not None:
        yield caution


def _of_baseline(measured: CautionBasis, language: Language) -> Iterator[str]:
    """Yield why the baseline misleads: crossings it shares, a doubtful verdict, a later time."""
    before, used = measured.before, measured.view.used
    if before is None:
        return
    caution = shared_crossings(used, before.used, language)
    if caution is not None:
        yield caution
    yield from doubts_of_baseline(used, before.used, before.verdict, language)


def _implausible(comparison: Comparison, language: Language) -> Iterator[str]:
    numbers = [element.number for element in comparison.implausible]
    if not numbers:
        return
    adjacent = {n + side for n in numbers for side in (-1, 1)} - set(numbers)
    near = [n for n in sorted(adjacent) if 1 <= n <= len(comparison.elements)]
    yield language.text(
        f"caution.implausible.{comparison.reference}",
        elements=named_elements(numbers, language),
        limit=100.0 * IMPLAUSIBLE_GAIN,
        neighbours=named_elements(near, language),
    )


def _implausible_before(measured: CautionBasis, language: Language) -> Iterator[str]:
    """Yield that changes are not certain where the baseline itself is implausible."""
    found = _alone(measured.view, measured.before)
    numbers = [] if found is None else [element.number for element in found.implausible]
    if numbers:
        yield language.text(
            "caution.implausible_before",
            elements=named_elements(numbers, language),
            limit=100.0 * IMPLAUSIBLE_GAIN,
        )


def _higher(comparison: Comparison, language: Language) -> Iterator[str]:
    """Yield the usual causes where elements are stiffer than the baseline."""
    elements = comparison.risen
    if elements:
        listed = changes_in_words(elements, language)
        yield language.choice("caution.higher", len(elements), elements=listed)


def _earlier(measured: CautionBasis, language: Language) -> Iterator[str]:
    yield from describe_weak_before(weak_before(measured.view, measured.before), language)


def _seasons(measured: CautionBasis, language: Language) -> Iterator[str]:
    """Yield how far two compared surveys are apart, and what the temperature does."""
    before = measured.before
    if before is None or not before.crossings or not measured.crossings:
        return
    then, now = before.crossings[0].entry_time, measured.crossings[0].entry_time
    days = days_between(then, now)
    if days < _APART_DAYS:
        return
    latitude = measured.bridge.start_latitude_deg
    earlier, later = season_of(then, latitude), season_of(now, latitude)
    which = "same_season" if earlier == later else "other_season"
    yield language.text(
        f"caution.{which}",
        days=days,
        earlier=language.text(earlier),
        later=language.text(later),
        kelvin=_WARMER_K,
        change=100.0 * _WARMER_K * SLOPE_SPREAD,
    )


def _combined(combined: CombinedSurveys | None, language: Language) -> Iterator[str]:
    if combined is None:
        return
    site = "" if combined.site_file is None else f" --site {combined.site_file}"
    how = language.text("caution.no_command", site=site)
    if combined.command is not None:
        how = language.text("caution.command", command=combined.command)
    yield language.text(
        "caution.combined",
        days=days_between(combined.earlier_s, combined.later_s),
        earlier=utc_day(combined.earlier_s),
        later=utc_day(combined.later_s),
        how=how,
    )


def _ends(measured: CautionBasis, language: Language) -> Iterator[str]:
    """Yield which ends are probably restrained or compliant, unless a restraint is declared."""
    known = [crossing.derived for crossing in measured.crossings if crossing.derived is not None]
    is_declared = [bearing == "sprung" for bearing in measured.bridge.bearings]
    for name, values in (
        ("restraint", [one.probability_sprung for one in known]),
        ("compliance", [one.probability_giving for one in known]),
    ):
        given = [(one.start, one.end) for one in values if one is not None]
        if not given:
            continue
        ends = [
            language.text("caution.end", side=side, share=100.0 * min(float(share), _MOST))
            for side, share, declared in zip(
                ends_of(measured.bridge, language),
                np.median(given, axis=0),
                is_declared if name == "restraint" else (False, False),
                strict=True,
            )
            if share >= _LIKELY and not declared
        ]
        if ends:
            yield language.text(f"caution.{name}", ends=language.listed(ends))
