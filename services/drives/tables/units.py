"""Units of columns, from a header, or from the numbers without one."""

import re
import unicodedata
from typing import Final

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2

G: Final = STANDARD_GRAVITY_M_PER_S2
ACCELERATION: Final = {"m/s2": 1.0, "g": G, "mg": 1e-3 * G, "cm/s2": 0.01}
SPEED: Final = {"m/s": 1.0, "km/h": 1 / 3.6, "knots": 1852 / 3600, "mph": 0.44704}
LENGTH: Final = {"m": 1.0, "ft": 0.3048}
ANGLE: Final = ("deg", "1e-7 deg", "ddmm")
TIME: Final = {"s": "s", "ms": "ms", "us": "us", "ns": "ns", "samples": "samples"}

_SPELLINGS: Final = {
    "m/s2": "m/s2", "ms2": "m/s2", "ms-2": "m/s2", "mps2": "m/s2", "m/s/s": "m/s2",
    "m/sec2": "m/s2", "m/s^2": "m/s2", "m/s**2": "m/s2", "mpersec2": "m/s2", "m/ss": "m/s2",
    "g": "g", "gn": "g", "g0": "g", "gs": "g", "mg": "mg", "milli-g": "mg", "milligal": "",
    "cm/s2": "cm/s2", "gal": "cm/s2",
    "m/s": "m/s", "mps": "m/s", "ms-1": "m/s", "m/sec": "m/s",
    "km/h": "km/h", "kmh": "km/h", "kph": "km/h", "kmph": "km/h", "km/hr": "km/h",
    "kn": "knots", "kt": "knots", "kts": "knots", "knots": "knots", "knot": "knots",
    "mph": "mph", "mi/h": "mph",
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "1e-7deg": "1e-7 deg",
    "dd": "deg", "grad": "deg",
    "m": "m", "meter": "m", "metre": "m", "ft": "ft", "feet": "ft",
    "s": "s", "sec": "s", "seconds": "s", "ms": "ms", "msec": "ms", "milliseconds": "ms",
    "us": "us", "µs": "us", "μs": "us", "microseconds": "us", "ns": "ns",
}  # fmt: skip
_BRACKETS: Final = re.compile(r"^(.*?)[\s_]*[\[({]([^\])}]*)[\])}]\s*$")
_ENDINGS: Final = ("m/s2", "ms2", "mps2", "km/h", "kmh", "kph", "mps", "m/s", "knots", "kn", "kts",
                   "mph", "mg", "gal", "deg", "ms", "us", "ns", "ft", "g", "s", "m")  # fmt: skip


def unit_of(text: str) -> str | None:
    """Return the unit that a text is, as maps spell it; None if it is none."""
    plain = unicodedata.normalize("NFKC", text).strip().strip("[](){}").lower()
    plain = plain.replace(" ", "").replace("·", "").replace("^", "").replace("**", "")
    plain = plain.replace("µ", "u").replace("μ", "u") if plain.endswith("s") else plain
    return _SPELLINGS.get(plain) or None


def unit_in(head: str) -> tuple[str, str | None]:
    """Return the name and the unit in a header as `Speed [km/h]`, `a_g`, `speed kmh`."""
    match = _BRACKETS.match(head)
    if match is not None:
        return match[1], match[2]
    name, separator, ending = re.sub(r"[\s_,.]+$", "", head).rpartition("_" if "_" in head else " ")
    if separator and unicodedata.normalize("NFKC", ending).lower() in _ENDINGS:
        return name, ending
    return head, None
