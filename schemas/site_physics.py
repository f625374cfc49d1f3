"""Physical bounds of a site file: values that no truck, bridge or sensor can have are refused.

The bounds are generous, for a laboratory model is a bridge too; `driveby check` reports unlikely
values. Most bounds hold for ratios of quantities, such as natural frequencies and damping ratios.
The message gives the resulting range of the key that violates one.
"""

from typing import Final

from schemas.site_errors import error_at

G_M_PER_S2: Final = 9.80665
_SLIPS: Final[dict[str, dict[str, float]]] = {
    "N/m": {"kN/m": 1e3},
    "N·s/m": {"kN·s/m": 1e3},
    "N·m²": {"kN·m²": 1e3, "MN·m²": 1e6, "GN·m²": 1e9},
    "kg": {"t": 1e3},
    "kg/m": {"t/m": 1e3},
    "m": {"cm": 1e-2, "mm": 1e-3},
}
"""Units in which values are written by mistake, with their factors, by the unit of a key."""


def check(
    path: str,
    value: float,
    limits: tuple[float, float],
    noun: str,
    unit: str = "",
    because: str = "",
) -> None:
    """Raise an error for the key at `path` unless its value is within its limits."""
    low, high = limits
    if low <= value <= high:
        return
    reach = f"from {low:.4g} to {high:.4g} {unit}".rstrip()
    reason = f": {because}" if because else ""
    meant = next((u for u, f in _SLIPS.get(unit, {}).items() if low <= value * f <= high), None)
    if meant is not None:
        reason += f"; in {meant}? then it is {value * _SLIPS[unit][meant]:g}"
    raise error_at(path, f"is {value:g}, it must be {noun} {reach}{reason}")
