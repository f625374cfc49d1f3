"""The bridge under the truck, against beams whose deflection is known in closed form."""

import numpy as np
import pytest

from services.viewer.crossing_view import CrossingView, ParameterRow
from services.viewer.panels.deflection import deflection_frames

G = 9.80665
SPAN, RIGIDITY = 30.0, 15.6e9
TRUCK = {
    "d_1": 1.2, "m_s": 8000.0, "m_s1": 5600.0, "m_s2": 2400.0, "m_u1": 400.0, "m_u2": 600.0,
}  # fmt: skip
WHEELBASE = 1.2 * 8000.0 / 2400.0


def view(values: dict[str, float] | None = None, **changes: object) -> CrossingView:
    rows = tuple(ParameterRow(n, "", v, v, v) for n, v in (values or TRUCK).items())
    edges = np.linspace(0.0, SPAN, 7)
    fields: dict[str, object] = {
        "crossing_id": "a", "vehicle": "t", "bridge": "b", "forward": True, "entry_time_s": 0.0,
        "exit_time_s": 3.4, "speed_m_per_s": 10.0, "method": "pre", "verdict": "good",
        "reasons": (), "reason_texts": (), "chi2_per_dof": 1.0, "element_edges_m": edges,
        "nominal_nm2": np.full(6, RIGIDITY), "rigidity_nm2": np.full(6, RIGIDITY),
        "interval_nm2": None, "road": None, "parameters": rows,
    }  # fmt: skip
    return CrossingView(**{**fields, **changes})  # type: ignore[arg-type]


def simply_supported(x: np.ndarray, load_n: float, at: float) -> np.ndarray:
    """Deflection (m, down positive) of a uniform beam under one load; textbook formula."""
    if not 0.0 < at < SPAN:
        return np.zeros_like(x)
    b = SPAN - at
    left = load_n * b * x * (SPAN**2 - b**2 - x**2)
    right = load_n * at * (SPAN - x) * (SPAN**2 - at**2 - (SPAN - x) ** 2)
    return np.where(x <= at, left, right) / (6.0 * SPAN * RIGIDITY)


@pytest.mark.parametrize("forward", [True, False])
def test_a_uniform_beam_bends_as_the_textbook_says(forward: bool) -> None:
    found = deflection_frames(view(forward=forward))
    assert found is not None
    sign = 1.0 if forward else -1.0
    assert found.front_m - found.rear_m == pytest.approx(np.full(160, sign * WHEELBASE))
    for n in range(0, 160, 7):
        expected = simply_supported(found.x_m, 6000.0 * G, found.front_m[n])
        expected += simply_supported(found.x_m, 3000.0 * G, found.rear_m[n])
        # Elements with cubic shapes are exact at their nodes, and close between.
        assert -found.deflection_m[n, ::6] == pytest.approx(expected[::6], abs=1e-9)
        assert -found.deflection_m[n] == pytest.approx(expected, abs=0.01 * found.largest_m)
        axle = np.clip(found.front_m[n : n + 1], 0.0, SPAN)
        under = simply_supported(axle, 6000.0 * G, found.front_m[n])
        under += simply_supported(axle, 3000.0 * G, found.rear_m[n])
        assert -found.under_axles_m[n, 0] == pytest.approx(under[0], abs=0.01 * found.largest_m)
    assert found.largest_m == pytest.approx(-found.deflection_m.min())


def test_it_rests_while_the_truck_is_beside_it() -> None:
    found = deflection_frames(view())
    assert found is not None
    beside = (found.front_m < 0.0) | (found.rear_m > SPAN)
    assert beside.sum() >= 4
    assert np.abs(found.deflection_m[beside]).max() == 0.0


def test_interior_supports_and_bearings_that_give_are_in_it() -> None:
    held = deflection_frames(view(interior_supports_m=(15.0,)))
    assert held is not None
    middle = int(np.argmin(np.abs(held.x_m - 15.0)))
    assert np.abs(held.deflection_m[:, middle]).max() < 1e-12
    sunk = deflection_frames(view({**TRUCK, "f_start": 1e-9}))
    assert sunk is not None
    assert sunk.deflection_m[:, 0].min() == pytest.approx(-1e-9 * 9000.0 * G, rel=0.2)


def test_without_a_value_that_it_takes_there_is_none() -> None:
    for name in TRUCK:
        assert deflection_frames(view({k: v for k, v in TRUCK.items() if k != name})) is None
    assert deflection_frames(view(rigidity_nm2=None)) is None
    assert deflection_frames(view(interior_supports_m=(14.0,))) is None
