"""Quality of a measurement in words: its crossings, those excluded, and their agreement."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from schemas.results import BridgeResult, CrossingResult
from schemas.topics import is_simulated
from services.common.language import Language
from services.identification.comparison import Estimate
from services.viewer.bridge_view import BridgeView

_LARGEST_DEVIATION = 4.0
"""Standard deviations beyond which crossings do not agree."""
MAX_REASONS = 3
"""Maximum number of reasons in the box; all of them are listed below it."""


def quality(view: BridgeView, crossings: Sequence[CrossingResult], language: Language) -> str:
    """Return the numbers of crossings by verdict, and how far their values can be relied upon."""
    counts = Counter(crossing.verdict for crossing in crossings)
    verdicts = ", ".join(
        f"{counts[v]} {language.text(v)}" for v in ("good", "suspect", "rejected") if counts[v]
    )
    parts = [language.choice("quality.count", len(crossings), verdicts=verdicts)]
    campaigns = sorted({one.realm for one in crossings} - {realm_of(view.state, crossings)})
    if campaigns:
        number = sum(one.realm in campaigns for one in crossings)
        realms = ", ".join(campaigns)
        parts.append(language.choice("quality.other_realm", number, realms=realms))
    if all(is_simulated(one.realm) for one in crossings):
        parts.append(language.choice("quality.simulated", len(crossings)))
    if view.estimate is None:
        return " ".join((*parts, language.text("quality.none")))
    last = list(_excluded(view, crossings, language))
    if view.comparison is not None and view.comparison.implausible and not view.is_doubtful:
        last.append(language.text("quality.implausible"))
    if view.state is not None and len(view.used) > 1:
        together = _together(view.state, len(crossings), language)
        return " ".join((*parts, *together, *last))
    others = [c for c in crossings if c.verdict == "good" and c.crossing_id not in view.used]
    parts.append(language.text("quality.this" if len(crossings) == 1 else "quality.newest"))
    if view.state is not None and view.state.between_crossing_std is not None:
        parts.append(language.text("quality.with_variability"))
    deviation = _largest_deviation(view.estimate, others)
    if deviation is None:
        parts.append(language.text("quality.unconfirmed"))
    else:
        which = "agree" if deviation <= _LARGEST_DEVIATION else "disagree"
        parts.append(language.choice(f"quality.{which}", len(others), deviation=deviation))
    return " ".join((*parts, *last))


def reasons_of(crossing: CrossingResult, language: Language) -> list[str]:
    """Return the sentence of each reason of a crossing."""
    pairs = zip(crossing.reasons, crossing.reason_texts, strict=True)
    return [language.reason(code.value, text) for code, text in pairs]


def realm_of(state: BridgeResult | None, crossings: Sequence[CrossingResult]) -> str:
    """Return the realm of the last crossing in the state, or of the last one; "" without any."""
    used = () if state is None else state.crossings_used
    own = [one for one in crossings if one.crossing_id in used] or crossings
    return own[-1].realm if own else ""


def _together(state: BridgeResult, crossings: int, language: Language) -> Iterator[str]:
    """Yield sentences on the quality of fused crossings."""
    used = len(state.crossings_used)
    which = "quality.all_together" if used == crossings else "quality.some_together"
    yield language.text(which, number=used, verdict=language.text(state.verdict or "good"))
    low, high = state.between_crossing_std_q025, state.between_crossing_std_q975
    if state.between_crossing_std is not None and low is not None and high is not None:
        yield language.text(
            "quality.variability",
            std=100.0 * state.between_crossing_std,
            low=100.0 * low,
            high=100.0 * high,
        )


def _excluded(
    view: BridgeView, crossings: Sequence[CrossingResult], language: Language
) -> Iterator[str]:
    """Yield how many crossings of the campaign are not in the numbers, and why."""
    realm = realm_of(view.state, crossings)
    own = [one for one in crossings if one.realm == realm]
    left_out = () if view.state is None else view.state.crossings_left_out
    verdicts = {one.crossing_id: one.verdict for one in own if one.crossing_id not in view.used}
    reasons = []
    for verdict in ("rejected", "suspect"):
        some = [one for one in own if verdicts.get(one.crossing_id) == verdict]
        why = Counter(text for crossing in some for text in reasons_of(crossing, language))
        listed = " ".join(text for text, _ in why.most_common(MAX_REASONS))
        why_text = listed.removesuffix(".")
        values = {"number": len(some), "verdict": language.text(verdict), "why": why_text}
        if some:
            reasons.append(language.text("quality.left_out_because", **values))
    counted = Counter(
        language.left_out.get(one.reason, one.reason)
        for one in left_out
        if verdicts.get(one.crossing_id, "good") == "good"
    )
    reasons += [f"{number} {why}" for why, number in counted.most_common()]
    if reasons:
        yield language.text("quality.left_out", reasons="; ".join(reasons))


def _largest_deviation(estimate: Estimate, others: Sequence[CrossingResult]) -> float | None:
    """Return the largest difference of an element in standard deviations, in logarithms."""
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
