"""Remarks on bridge parameters that contradict the site file, from diagnostics of a crossing.

They change no verdict: EI is estimated together with these parameters, whose priors may be wrong.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from schemas.results import CrossingResult
from services.common.language import ENGLISH, Language

PRIOR_Z: Final = "prior_z_"
"""Prefix of the diagnostic with a parameter's deviation, in standard deviations of its prior."""
FREQUENCY_RATIO: Final = "f1_over_declared"
"""Diagnostic with the ratio of the estimated first frequency to the declared one."""


class _Remark(NamedTuple):
    """One contradiction in one crossing."""

    name: str
    unit: str
    estimate: float
    declared: float
    z: float | None
    """Standard deviations of the prior; None for the first frequency, which has no prior."""


def bridge_remarks(
    crossings: Sequence[CrossingResult], language: Language = ENGLISH
) -> Iterator[str]:
    """Yield a sentence for each bridge parameter that is far from its declared value.

    Of several crossings the values are those of the largest deviation.
    """
    found: dict[str, list[_Remark]] = {}
    for crossing in crossings:
        for remark in _remarks(crossing):
            found.setdefault(remark.name, []).append(remark)
    for name, remarks in found.items():
        worst = max(remarks, key=lambda one: abs(one.z or 0.0))
        values = {
            "quantity": language.text(f"quantity.{name}"),
            "name": name,
            "estimate": _in_unit(worst.estimate, worst.unit, language),
            "declared": _in_unit(worst.declared, worst.unit, language),
            "far": len(remarks),
        }
        if worst.z is None:
            yield language.choice("caution.far_frequency", len(crossings), **values)
        else:
            size = abs(worst.z)
            yield language.choice("caution.far_prior", len(crossings), **values, z=size)


def _in_unit(value: float, unit: str, language: Language) -> str:
    """Return a value with its unit; three digits, or whole numbers without an exponent."""
    return f"{language.number(value, ',.0f' if 1e3 <= abs(value) < 1e6 else '.3g')} {unit}"


def _remarks(crossing: CrossingResult) -> Iterator[_Remark]:
    """Yield the contradictions that the diagnostics of a crossing name."""
    known: Mapping[str, float] = crossing.diagnostics
    for name, estimate in (crossing.parameters or {}).items():
        z = known.get(f"{PRIOR_Z}{name}")
        if z is not None and estimate.prior is not None:
            yield _Remark(name, estimate.unit, estimate.mean, estimate.prior.location, z)
    if crossing.derived is not None and FREQUENCY_RATIO in known:
        f1 = crossing.derived.f1_hz
        yield _Remark("f1_hz", f1.unit, f1.mean, f1.mean / known[FREQUENCY_RATIO], None)
