"""Units of columns, from a header, or from the numbers without one."""

import re
import unicodedata
from typing import Final

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2

G: Final = STANDARD_GRAVITY_M_PER_S2
ACCELERATION: Final = {
    "m/s2": 1.0, "g": G, "mg": 1e-3 * G, "ug": 1e-6 * G, "cm/s2": 0.01, "mm/s2": 0.001,
    "ft/s2": 0.3048,
}  # fmt: skip
SPEED: Final = {
    "m/s": 1.0, "km/h": 1 / 3.6, "knots": 1852 / 3600, "mph": 0.44704, "ft/s": 0.3048,
    "cm/s": 0.01, "mm/s": 0.001,
}  # fmt: skip
LENGTH: Final = {"m": 1.0, "ft": 0.3048, "cm": 0.01, "mm": 0.001}

_SPELLINGS: Final = {
    "m/s2": "m/s2", "ms2": "m/s2", "ms-2": "m/s2", "mps2": "m/s2", "m/s/s": "m/s2",
    "m/sec2": "m/s2", "m/s^2": "m/s2", "m/s**2": "m/s2", "mpersec2": "m/s2", "m/ss": "m/s2",
    "g": "g", "gn": "g", "g0": "g", "gs": "g", "mg": "mg", "milli-g": "mg", "milligal": "",
    "cm/s2": "cm/s2", "gal": "cm/s2", "mm/s2": "mm/s2", "ft/s2": "ft/s2", "fps2": "ft/s2",
    "ug": "ug", "mm/sec2": "mm/s2", "cm/sec2": "cm/s2", "mms2": "mm/s2", "cms2": "cm/s2",
    "mms-2": "mm/s2", "cms-2": "cm/s2",
    "m/s": "m/s", "mps": "m/s", "ms-1": "m/s", "m/sec": "m/s",
    "km/h": "km/h", "kmh": "km/h", "kph": "km/h", "kmph": "km/h", "km/hr": "km/h",
    "kn": "knots", "kt": "knots", "kts": "knots", "knots": "knots", "knot": "knots",
    "mph": "mph", "mi/h": "mph", "ft/s": "ft/s", "fps": "ft/s", "cm/s": "cm/s", "mm/s": "mm/s",
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "1e-7deg": "1e-7 deg",
    "dd": "deg", "grad": "deg", "rad": "rad", "radian": "rad", "radians": "rad",
    "m": "m", "meter": "m", "metre": "m", "ft": "ft", "feet": "ft", "cm": "cm", "mm": "mm",
    "s": "s", "sec": "s", "seconds": "s", "ms": "ms", "msec": "ms", "milliseconds": "ms",
    "us": "us", "microseconds": "us", "ns": "ns",
}  # fmt: skip
_BRACKETS: Final = re.compile(r"^(.*?)[\s_]*[\[({]([^\])}]*)[\])}]\s*$")
_ENDINGS: Final = ("m/s2", "ms2", "mps2", "mm/s2", "cm/s2", "ft/s2", "mms2", "cms2", "km/h", "kmh",
                   "kph", "mps", "m/s", "cm/s", "mm/s", "ft/s", "knots", "kn", "kts", "mph", "mg",
                   "ug", "gal", "deg", "rad", "ms", "us", "ns", "ft", "mm", "cm", "g", "s", "m",
                   )  # fmt: skip
_NO_UNIT: Final = frozenset((
    "v", "mv", "uv", "volt", "volts", "count", "counts", "cts", "digit", "digits", "lsb", "adc",
    "raw", "%", "fs", "ma", "n", "pa", "bar",
))  # fmt: skip
"""Units of a converter or of another quantity, which no factor of ours turns into m/s²."""


def unit_of(text: str) -> str | None:
    """Return the unit that a text is, as maps spell it; None if it is none."""
    plain = unicodedata.normalize("NFKC", text).strip().strip("[](){}").lower()
    plain = plain.replace(" ", "").replace("·", "").replace("^", "").replace("**", "")
    plain = plain.replace("µ", "u").replace("μ", "u")
    return _SPELLINGS.get(plain) or None


def is_raw(text: str) -> bool:
    """Return whether a unit is that of a converter's output, such as V or counts."""
    return unicodedata.normalize("NFKC", text).strip().strip("[](){}").lower() in _NO_UNIT


def unit_in(head: str) -> tuple[str, str | None]:
    """Return the name and the unit in a header as `Speed [km/h]`, `a_g`, `speed kmh`."""
    match = _BRACKETS.match(head)
    if match is not None:
        return match[1], match[2]
    if unit_of(head) in SPEED:
        return head, head
    name, separator, ending = re.sub(r"[\s_,.]+$", "", head).rpartition("_" if "_" in head else " ")
    if separator and unicodedata.normalize("NFKC", ending).lower() in _ENDINGS:
        return name, ending
    return head, None
