"""Check of the accelerometers' noise against its declaration."""

from typing import Final

import numpy as np

from pre_core.diagnostics.noise_floor import NoiseSegment, density
from services.inspection.finding import CheckFinding, CheckStatus, check_finding

_LOUDER, _LOUDER_DRIVING, _QUIETER = 1.15, 1.3, 0.77
"""Ratios to the declared density beyond which a fit reports a noise above or below it.

Motion of the truck above the wheels' frequencies made 10 µg/√Hz look like 11.9 in one of 18 drives.
"""
_UNEVEN: Final = 2.1
"""Ratio of powers within the band beyond which a sensor's own noise lies in one of 20 drives."""


def noise_of(name: str, still: NoiseSegment | None, declared_ug: float) -> CheckFinding:
    """Return the finding on one channel's noise."""
    found = None if still is None else density(still)
    if still is None or found is None:
        return CheckFinding(
            "noise",
            CheckStatus.OPEN,
            f"{name}: noise cannot be determined from this recording",
            "record a minute at standstill, engine off",
        )
    noise = found.ug_per_rthz
    loudest = _LOUDER if still.is_standing else _LOUDER_DRIVING
    if not still.is_standing and noise > loudest * declared_ug:
        # Wheels and frame only add: the quietest frequencies bound the noise.
        noise = min(noise, found.quietest_ug_per_rthz)
    ratio = noise / declared_ug if declared_ug > 0.0 else np.inf
    if not still.is_standing and ratio > loudest and found.unevenness > _UNEVEN:
        return CheckFinding(
            "noise",
            CheckStatus.OPEN,
            f"{name}: noise at most {noise:.3g} µg/√Hz, {declared_ug:g} declared; the truck's own "
            "motion hides it",
            "record a minute at standstill, engine off",
        )
    where = "at standstill" if still.is_standing else "while driving"
    return check_finding(
        "noise",
        f"{name}: noise {noise:.3g} µg/√Hz {where}, {declared_ug:g} declared",
        "declare the measured value, or check for a loose mount, a cable or another sensor"
        if ratio > 1.0
        else "declare the measured value; too much declared noise widens intervals and hides a "
        "misfit",
        is_wrong=not _QUIETER <= ratio <= loudest,
    )
