"""First natural frequency of a site file's bridge, and the EI that fits a given one."""

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Any, Final

import numpy as np

from schemas.site_bridge import Bridge
from schemas.site_implied import MAX_BRIDGES, ImpliedQuantity
from schemas.toml_text import parse_toml

_PIECES: Final = 40
"""Least number of finite elements of a bridge."""
_GIVEN_OVER_IMPLIED: Final = (1.0 / 1.44, 1.44)
"""Usual ratio of the EI that follows from the given first frequency to nominal EI: a fifth in
frequency."""
_LEAST_EI: Final = 0.5
"""Ratio of the EI that follows from the given frequency to nominal EI, below which the latter is
wrong.

Restraint only raises a frequency, and a nominal EI may be off by 2.
"""
_ABOVE_CLAMPED: Final = 1.2
"""Ratio of the given frequency to that with clamped ends, above which no restraint explains it."""


def first_frequency_hz(bridge: Bridge, *, is_clamped: bool = False) -> float:
    """Return the first natural frequency of the nominal bridge, with ends hinged or clamped."""
    return _first_hz(
        bridge.lengths_m,
        bridge.nominal_flexural_rigidity_nm2,
        bridge.interior_support_nodes,
        bridge.mass_per_length_kg_per_m,
        is_clamped=is_clamped,
    )


def given_frequencies(toml_text: str) -> Iterator[ImpliedQuantity]:
    """Yield the given first frequency of each bridge of a site file, compared with that of its EI.

    Raise InputError if the text is not TOML.
    """
    tables = parse_toml(toml_text, "the site file").get("bridge", [])
    for table in (tables if isinstance(tables, list) else [tables])[:MAX_BRIDGES]:
        if "first_frequency_hz" in table:
            yield _given(table)


def _given(table: dict[str, Any]) -> ImpliedQuantity:
    bridge = Bridge.model_validate(table)
    given_hz, free_hz = float(table["first_frequency_hz"]), first_frequency_hz(bridge)
    clamped_hz = first_frequency_hz(bridge, is_clamped=True)
    ratio, of_clamped = (given_hz / free_hz) ** 2, (given_hz / clamped_hz) ** 2
    text = (
        f"{bridge.id}: first_frequency_hz is {given_hz:g}, EI, mass and spans imply {free_hz:.3g} "
        f"Hz with bearings free to turn; damping_ratio is {table['damping_ratio']:g}"
    )
    per_element = bridge.flexural_rigidity_per_element_nm2 is not None
    key = "flexural_rigidity_" + ("per_element_nm2" if per_element else "nm2")
    rigidity = sum(bridge.nominal_flexural_rigidity_nm2) / bridge.elements
    meant = (
        f"{key} is {rigidity:.3g}{' in the mean' if per_element else ''}; {given_hz:g} Hz needs "
        f"{rigidity * ratio:.3g}"
    )
    if ratio > 1.0:
        meant += f" with bearings free to turn, {rigidity * of_clamped:.3g} with clamped ends"
    meant += f", or another mass_per_length_kg_per_m, or {_other_span(bridge, ratio)}"
    low, high = _GIVEN_OVER_IMPLIED
    most = (_ABOVE_CLAMPED * clamped_hz / free_hz) ** 2
    return ImpliedQuantity(
        "given_frequency", text, ratio, low, high, "of EI by this frequency over the nominal one",
        meant, wrong_beyond=(_LEAST_EI, most),
    )  # fmt: skip


def _other_span(bridge: Bridge, ratio: float) -> str:
    """Return, in words, the span that has the given frequency at the nominal EI."""
    if bridge.interior_supports_m:
        return "other spans (span_m, interior_supports_m)"
    return f"a span_m of {bridge.span_m / ratio**0.25:.3g}"


@lru_cache(maxsize=4 * MAX_BRIDGES)
def _first_hz(
    lengths_m: tuple[float, ...],
    rigidities_nm2: tuple[float, ...],
    support_nodes: tuple[int, ...],
    mass_kg_per_m: float,
    *,
    is_clamped: bool,
) -> float:
    """Return the first natural frequency of a continuous beam by finite elements."""
    pieces = math.ceil(_PIECES / len(lengths_m))
    nodes = pieces * len(lengths_m) + 1
    stiffness, mass = np.zeros((2, 2 * nodes, 2 * nodes))
    for number in range(nodes - 1):
        length = lengths_m[number // pieces] / pieces
        scale = np.tile([1.0, length], 2)
        place = slice(2 * number, 2 * number + 4)
        bending = rigidities_nm2[number // pieces] / length**3 * _BENDING
        stiffness[place, place] += bending * np.outer(scale, scale)
        mass[place, place] += mass_kg_per_m * length * _INERTIA * np.outer(scale, scale)
    supported = [0, 2 * (nodes - 1), *(2 * pieces * node for node in support_nodes)]
    if is_clamped:
        supported += [1, 2 * nodes - 1]
    free = np.setdiff1d(np.arange(2 * nodes), supported)
    root = np.linalg.inv(np.linalg.cholesky(mass[np.ix_(free, free)]))
    squared = np.linalg.eigvalsh(root @ stiffness[np.ix_(free, free)] @ root.T)[0]
    return float(np.sqrt(squared) / (2.0 * math.pi))


_BENDING: Final = np.array(
    [
        [12.0, 6.0, -12.0, 6.0],
        [6.0, 4.0, -6.0, 2.0],
        [-12.0, -6.0, 12.0, -6.0],
        [6.0, 2.0, -6.0, 4.0],
    ]
)
_INERTIA: Final = (
    np.array(
        [[156.0, 22.0, 54.0, -13.0], [22.0, 4.0, 13.0, -3.0], [54.0, 13.0, 156.0, -22.0],
         [-13.0, -3.0, -22.0, 4.0]]
    )
    / 420.0
)  # fmt: skip
