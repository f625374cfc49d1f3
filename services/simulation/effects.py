"""Names of the out-of-model effects of `driveby validate`; the command's help lists them."""

from typing import Final

EVERYTHING: Final = "everything"
SURFACE: Final = "surface"
PAVEMENT: Final = "pavement"
AMONG_ALL: Final = (
    "free",
    "sprung",
    "sinking",
    "swing",
    "tyres",
    "friction",
    "bilinear",
    "air",
    "spans",
)
TORSION: Final = "torsion"
LEFT_AND_RIGHT: Final = "left-and-right"
ON_SURFACES: Final = (SURFACE, TORSION, LEFT_AND_RIGHT, PAVEMENT)
"""Effects that `everything` leaves out: such a road would hide most of the others."""
ALONE: Final = (*AMONG_ALL, *ON_SURFACES)
EFFECTS: Final = (*ALONE, EVERYTHING)
