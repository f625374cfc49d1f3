"""Table of the estimated parameters of truck and bridge, one row each.

A parameter vector theta has the rows of the truck first, then those of the bridge, then EI of every
element. To add a parameter, add a row here and its effect in `physics` (and the sensor noise that
it transmits, `crossing/noise`); priors, search, results and validation follow from the row.
"""

from functools import cache, partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray

TRUCK, BRIDGE = "truck", "bridge"


class ParameterSpec(NamedTuple):
    """A row of the table. The prior is log-normal about the nominal value unless that is zero."""

    name: str
    """Name in results (docs/contract.md, "Parameters")."""
    unit: str
    part: str
    """Owner of the parameter: TRUCK or BRIDGE."""
    key: str
    """Name of the quantity in `HalfCar`, `Beam` and the site file."""
    pair_index: int = 0
    """Index in a pair (front, rear) or (start, end)."""
    mass_power: int = 0
    """Power of the total mass to which the parameter is proportional for given accelerations: a
    truck twice as heavy has springs twice as stiff, and a bridge that deflects equally is twice as
    stiff.
    """
    may_be_zero: bool = False
    """Whether it is estimated with a half-normal prior at zero if its nominal value is zero; any
    other parameter with a nominal value of zero is fixed."""
    may_be_absent: bool = False
    """Whether its prior then has a point mass at zero: no such spring, or a rigid bearing."""
    in_paper: bool = True


_possible = partial(ParameterSpec, may_be_zero=True, may_be_absent=True, in_paper=False)

SCALARS: Final = (
    ParameterSpec("d_1", "m", TRUCK, "front_axle_to_cg_m"),
    ParameterSpec("c_s1", "N·s/m", TRUCK, "suspension_damping_ns_per_m", 0, 1),
    ParameterSpec("c_s2", "N·s/m", TRUCK, "suspension_damping_ns_per_m", 1, 1),
    ParameterSpec("k_s1", "N/m", TRUCK, "suspension_stiffness_n_per_m", 0, 1),
    ParameterSpec("k_s2", "N/m", TRUCK, "suspension_stiffness_n_per_m", 1, 1),
    ParameterSpec("m_u1", "kg", TRUCK, "unsprung_mass_kg", 0, 1),
    ParameterSpec("m_u2", "kg", TRUCK, "unsprung_mass_kg", 1, 1),
    ParameterSpec("k_u1", "N/m", TRUCK, "tyre_stiffness_n_per_m", 0, 1),
    ParameterSpec("k_u2", "N/m", TRUCK, "tyre_stiffness_n_per_m", 1, 1),
    ParameterSpec(
        "c_u1", "N·s/m", TRUCK, "tyre_damping_ns_per_m", 0, 1, may_be_zero=True, in_paper=False
    ),
    ParameterSpec(
        "c_u2", "N·s/m", TRUCK, "tyre_damping_ns_per_m", 1, 1, may_be_zero=True, in_paper=False
    ),
    ParameterSpec("kappa", "1", TRUCK, "pitch_inertia_ratio", in_paper=False),
    ParameterSpec("share", "1", TRUCK, "tandem_share", in_paper=False),
    ParameterSpec("rhoA", "kg/m", BRIDGE, "mass_per_length_kg_per_m", 0, 1),
    ParameterSpec("alpha", "1/s", BRIDGE, "rayleigh_alpha_per_s"),
    ParameterSpec("beta", "s", BRIDGE, "rayleigh_beta_s"),
    _possible("k_rot_start", "N·m/rad", BRIDGE, "support_rotational_stiffness_nm_per_rad", 0, 1),
    _possible("k_rot_end", "N·m/rad", BRIDGE, "support_rotational_stiffness_nm_per_rad", 1, 1),
    _possible("f_start", "m/N", BRIDGE, "support_compliance_m_per_n", 0, -1),
    _possible("f_end", "m/N", BRIDGE, "support_compliance_m_per_n", 1, -1),
    _possible("torsion", "1/N", BRIDGE, "torsional_flexibility_per_n", 0, -1),
)
"""All rows except EI, in the order of theta."""
ELEMENT: Final = ParameterSpec("EI", "N·m²", BRIDGE, "flexural_rigidity_nm2", 0, 1)
"""The row of every element; in results its name is EI_1, EI_2, …"""
PAIRS: Final = ("unsprung_mass_kg", "tyre_stiffness_n_per_m", "tyre_damping_ns_per_m")
"""Keys of the rows that always belong to the two compared axles."""
SPRINGS: Final = ("suspension_stiffness_n_per_m", "suspension_damping_ns_per_m")
"""Keys of springs and dampers. For an equalised tandem they are not estimated; their pair is that
of the front axle and of the tandem's axles together."""
DERIVED_UNITS: Final = {"m_s": "kg", "m_s1": "kg", "m_s2": "kg"}
"""Units of the masses that are derived from parameters (`physics.models.body_masses`)."""
PLACEMENT_UNITS: Final = {"wheelbase_m": "m", "position_offset_m": "m"}
"""Units of the results of method `pre` beyond theta: wheelbase, and the receiver's slow error."""


def index_of(name: str) -> int:
    """Return the index in theta of a parameter other than EI; raise KeyError for unknown names."""
    for i, row in enumerate(SCALARS):
        if row.name == name:
            return i
    raise KeyError(name)


# Indices as constants, for kernels. Pairs are adjacent.
D_1: Final = index_of("d_1")
C_S1: Final = index_of("c_s1")
K_S1: Final = index_of("k_s1")
M_U1: Final = index_of("m_u1")
K_U1: Final = index_of("k_u1")
C_U1: Final = index_of("c_u1")
KAPPA: Final = index_of("kappa")
SHARE: Final = index_of("share")
RHO_A: Final = index_of("rhoA")
ALPHA: Final = index_of("alpha")
BETA: Final = index_of("beta")
K_ROT: Final = index_of("k_rot_start")
F: Final = index_of("f_start")
TORSION: Final = index_of("torsion")
FIRST_OF_BRIDGE: Final = RHO_A
EI_1: Final = len(SCALARS)


@cache
def table(elements: int, first_axle: int = 1) -> tuple[ParameterSpec, ...]:
    """Return the rows of theta for a bridge of `elements` elements.

    `first_axle` is the number of the first of the two axles whose profiles are compared; for a
    truck with a tandem rows of springs, axles and tyres are those of this axle and the next one.
    """
    scalars = (
        row._replace(name=f"{row.name[:-1]}{row.pair_index + first_axle}")
        if row.key in (*PAIRS, *SPRINGS)
        else row
        for row in SCALARS
    )
    rigidities = (ELEMENT._replace(name=f"EI_{e + 1}", pair_index=e) for e in range(elements))
    return (*scalars, *rigidities)


def names(elements: int, first_axle: int = 1) -> tuple[str, ...]:
    """Return the names of the entries of theta; `first_axle` as in `table`."""
    return tuple(row.name for row in table(elements, first_axle))


def unit(name: str) -> str:
    """Return the SI unit of a value of a result; raise KeyError for unknown names."""
    beyond = DERIVED_UNITS | PLACEMENT_UNITS
    if name in beyond:
        return beyond[name]
    if name.startswith(f"{ELEMENT.name}_"):
        return ELEMENT.unit
    stem = name.rstrip("0123456789")
    of_axles = {row.name[:-1]: row.unit for row in SCALARS if row.key in (*PAIRS, *SPRINGS)}
    return of_axles[stem] if stem in of_axles and stem != name else SCALARS[index_of(name)].unit


def element_count(theta: FloatArray) -> int:
    """Return the number of elements of the bridge that theta (…, p) describes."""
    return int(theta.shape[-1]) - EI_1


def mass_powers(elements: int) -> FloatArray:
    """Return the powers (p,) of the total mass to which the entries of theta are proportional."""
    return np.array([row.mass_power for row in table(elements)], dtype=np.float64)


def paper_subset(elements: int) -> NDArray[np.int64]:
    """Return the indices (n + 12,) of the paper's parameters for n elements."""
    return np.flatnonzero([row.in_paper for row in table(elements)])
