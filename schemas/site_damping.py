"""Damping of a bridge as it is known: a damping ratio and the first natural frequency.

The Rayleigh coefficients have this ratio at the first natural frequency and at four times that,
which is the second one of a single span:
alpha = 2 zeta w1 w2 / (w1 + w2), beta = 2 zeta / (w1 + w2), with w2 = 4 w1.
"""

import math
from typing import Annotated, Any, Final

from pydantic import BaseModel, Field

from schemas.site_errors import error_at
from schemas.site_numbers import Number

DAMPING_RATIO: Final = "damping_ratio"
_KEYS: Final = (DAMPING_RATIO, "first_frequency_hz")
COEFFICIENTS: Final = ("rayleigh_alpha_per_s", "rayleigh_beta_s")
_MASS_AND_SPAN: Final = ("mass_per_length_kg_per_m", "span_m")
_SECOND: Final = 4.0
"""Ratio of the second natural frequency to the first."""
_FAR: Final = 3.0
"""Factor between the given first frequency and that of EI and mass beyond which one is wrong."""


class Damping(BaseModel):
    """Keys that take the place of the Rayleigh coefficients.

    Of these the model keeps the declared frequency, to compare results with it, and does not write
    it.
    """

    damping_ratio: Annotated[Number, Field(gt=0, le=0.5)] | None = None
    first_frequency_hz: Annotated[Number | None, Field(gt=0, le=1000, exclude=True)] = None


def rayleigh_of(ratio: float, first_hz: float) -> tuple[float, float]:
    """Return alpha in 1/s and beta in s of a damping ratio at the first natural frequency in Hz."""
    omega = 2.0 * math.pi * first_hz
    return 2.0 * ratio * omega * _SECOND / (1.0 + _SECOND), 2.0 * ratio / (omega * (1.0 + _SECOND))


def with_coefficients(table: Any) -> Any:
    """Return the table of a bridge with Rayleigh coefficients in place of ratio and frequency.

    Wrong values stay in the table, so that the model reports them. Raise FieldError if only one of
    ratio and frequency is given, if the coefficients are given as well, or if EI and mass give
    quite another frequency.
    """
    if not isinstance(table, dict) or not any(key in table for key in _KEYS):
        return table
    for key in COEFFICIENTS:
        if key in table:
            raise error_at(key, f"is given together with {_KEYS[0]}, remove one of them")
    for key, other in zip(_KEYS, reversed(_KEYS), strict=True):
        if key not in table:
            raise error_at(key, f"is missing, {other} needs it")
    values = [table[key] for key in _KEYS]
    limits = (0.5, 1000.0)
    if not all(
        isinstance(value, int | float) and not isinstance(value, bool) and 0.0 < value <= most
        for value, most in zip(values, limits, strict=True)
    ):
        return table | dict.fromkeys(COEFFICIENTS, 0.0)
    _check_frequency(table, values[1])
    rest = {key: value for key, value in table.items() if key != _KEYS[0]}
    return rest | dict(zip(COEFFICIENTS, rayleigh_of(*values), strict=True))


def _single_span_frequency_hz(table: dict[str, Any]) -> float | None:
    """Return the first natural frequency of a single span by its EI and mass; None if unknown."""
    known = [table.get(key) for key in ("flexural_rigidity_nm2", *_MASS_AND_SPAN)]
    if table.get("interior_supports_m") or not all(
        isinstance(value, int | float) and value > 0.0 for value in known
    ):
        return None
    rigidity, mass, span = (float(value) for value in known if value is not None)
    return math.pi / (2.0 * span**2) * math.sqrt(rigidity / mass)


def _check_frequency(table: dict[str, Any], first_hz: float) -> None:
    """Raise FieldError where a single span of this EI and mass has quite another frequency."""
    implied_hz = _single_span_frequency_hz(table)
    if implied_hz is None or 1.0 / _FAR < first_hz / implied_hz < _FAR:
        return
    key, rigidity = "flexural_rigidity_nm2", table["flexural_rigidity_nm2"]
    raise error_at(
        "first_frequency_hz",
        f"is {first_hz:g}, but {key}, {_MASS_AND_SPAN[0]} and span_m give {implied_hz:.3g} Hz: "
        f"check them; {key} is {rigidity * (first_hz / implied_hz) ** 2:.3g} for {first_hz:g} Hz",
    )
