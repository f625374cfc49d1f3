"""The table of unknowns: what is estimated of a truck and a bridge, one row each.

A vector of parameters theta has the rows of the truck first, then those of the bridge, then EI of
every element. To add an unknown, add a row here and its effect in `physics` (and what sensor noise
it passes on, `crossing/whitening`); priors, search, results and validation follow from the row.
"""

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

TRUCK, BRIDGE = "truck", "bridge"


class Unknown(NamedTuple):
    """One row. Its prior is log-normal about the nominal value, unless that is zero."""

    name: str
    """As in results (docs/contract.md, "Parameter names")."""
    unit: str
    part: str
    """TRUCK or BRIDGE."""
    key: str
    """Name of the quantity in `HalfCar`, `Beam` and the site file."""
    which: int = 0
    """Which of a pair (front, rear) or (start, end)."""
    mass_power: int = 0
    """The power of the total mass to which it is proportional where all accelerations are given: a
    truck that is twice as heavy has twice as stiff springs, and so has the bridge that it bends
    alike."""
    may_be_zero: bool = False
    """Nominally zero it is estimated all the same, with a half-normal prior at zero; any other
    unknown whose nominal value is zero is taken for known."""
    may_be_absent: bool = False
    """Then part of its prior lies on exactly zero: there is no such spring, or the bearing does
    not give."""
    in_paper: bool = True


SCALARS: Final = (
    Unknown("d_1", "m", TRUCK, "front_axle_to_cg_m"),
    Unknown("c_s1", "N·s/m", TRUCK, "suspension_damping_ns_per_m", 0, 1),
    Unknown("c_s2", "N·s/m", TRUCK, "suspension_damping_ns_per_m", 1, 1),
    Unknown("k_s1", "N/m", TRUCK, "suspension_stiffness_n_per_m", 0, 1),
    Unknown("k_s2", "N/m", TRUCK, "suspension_stiffness_n_per_m", 1, 1),
    Unknown("m_u1", "kg", TRUCK, "unsprung_mass_kg", 0, 1),
    Unknown("m_u2", "kg", TRUCK, "unsprung_mass_kg", 1, 1),
    Unknown("k_u1", "N/m", TRUCK, "tyre_stiffness_n_per_m", 0, 1),
    Unknown("k_u2", "N/m", TRUCK, "tyre_stiffness_n_per_m", 1, 1),
    Unknown(
        "c_u1", "N·s/m", TRUCK, "tyre_damping_ns_per_m", 0, 1, may_be_zero=True, in_paper=False
    ),
    Unknown(
        "c_u2", "N·s/m", TRUCK, "tyre_damping_ns_per_m", 1, 1, may_be_zero=True, in_paper=False
    ),
    Unknown("kappa", "1", TRUCK, "pitch_inertia_ratio", in_paper=False),
    Unknown("rhoA", "kg/m", BRIDGE, "mass_per_length_kg_per_m", 0, 1),
    Unknown("alpha", "1/s", BRIDGE, "rayleigh_alpha_per_s"),
    Unknown("beta", "s", BRIDGE, "rayleigh_beta_s"),
    Unknown(
        "k_rot_start",
        "N·m/rad",
        BRIDGE,
        "support_rotational_stiffness_nm_per_rad",
        0,
        1,
        may_be_zero=True,
        may_be_absent=True,
        in_paper=False,
    ),
    Unknown(
        "k_rot_end",
        "N·m/rad",
        BRIDGE,
        "support_rotational_stiffness_nm_per_rad",
        1,
        1,
        may_be_zero=True,
        may_be_absent=True,
        in_paper=False,
    ),
    Unknown(
        "f_start",
        "m/N",
        BRIDGE,
        "support_compliance_m_per_n",
        0,
        -1,
        may_be_zero=True,
        may_be_absent=True,
        in_paper=False,
    ),
    Unknown(
        "f_end",
        "m/N",
        BRIDGE,
        "support_compliance_m_per_n",
        1,
        -1,
        may_be_zero=True,
        may_be_absent=True,
        in_paper=False,
    ),
    Unknown(
        "torsion",
        "1/N",
        BRIDGE,
        "torsional_flexibility_per_n",
        0,
        -1,
        may_be_zero=True,
        may_be_absent=True,
        in_paper=False,
    ),
)
"""All but EI, in the order of theta."""
ELEMENT: Final = Unknown("EI", "N·m²", BRIDGE, "flexural_rigidity_nm2", 0, 1)
"""The row that every element has; in results its name is EI_1, EI_2, …"""
DERIVED_UNITS: Final = {"m_s": "kg", "m_s1": "kg", "m_s2": "kg"}


def place(name: str) -> int:
    """Place in theta of any unknown but EI; KeyError if the table has none of this name."""
    for i, row in enumerate(SCALARS):
        if row.name == name:
            return i
    raise KeyError(name)


# Places as constants, for kernels. Pairs stand beside each other.
D_1: Final = place("d_1")
C_S1: Final = place("c_s1")
K_S1: Final = place("k_s1")
M_U1: Final = place("m_u1")
K_U1: Final = place("k_u1")
C_U1: Final = place("c_u1")
KAPPA: Final = place("kappa")
RHO_A: Final = place("rhoA")
ALPHA: Final = place("alpha")
BETA: Final = place("beta")
K_ROT: Final = place("k_rot_start")
F: Final = place("f_start")
TORSION: Final = place("torsion")
FIRST_OF_BRIDGE: Final = RHO_A
EI_1: Final = len(SCALARS)


@cache
def table(elements: int) -> tuple[Unknown, ...]:
    """The rows of theta for a bridge of so many elements."""
    rigidities = (ELEMENT._replace(name=f"EI_{e + 1}", which=e) for e in range(elements))
    return (*SCALARS, *rigidities)


def names(elements: int) -> tuple[str, ...]:
    """Names of the entries of theta."""
    return tuple(row.name for row in table(elements))


def unit(name: str) -> str:
    """SI unit of an unknown, or of a mass that is derived; KeyError if there is none."""
    if name in DERIVED_UNITS:
        return DERIVED_UNITS[name]
    return ELEMENT.unit if name.startswith(f"{ELEMENT.name}_") else SCALARS[place(name)].unit


def element_count(theta: FloatArray) -> int:
    """Elements of the bridge that theta (…, p) describes."""
    return int(theta.shape[-1]) - EI_1


def of_part(part: str, elements: int) -> NDArray[np.bool_]:
    """Which entries of theta (p,) are of the truck, or of the bridge."""
    return np.array([row.part == part for row in table(elements)])


def mass_powers(elements: int) -> FloatArray:
    """Powers (p,) of the total mass to which the entries of theta are proportional."""
    return np.array([row.mass_power for row in table(elements)], dtype=np.float64)


def paper_subset(elements: int) -> NDArray[np.int64]:
    """Places of the paper's n + 12 unknowns."""
    return np.flatnonzero([row.in_paper for row in table(elements)])
