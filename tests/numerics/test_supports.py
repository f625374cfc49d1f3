"""Supports: bearings that give, spans that continue. Against closed forms, never against meshes."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import brentq

from pre_core.arrays import FloatArray
from pre_core.physics.bridge import (
    Beam,
    interpolation_matrix,
    natural_frequencies_hz,
    node_dofs,
    refine,
    stiffness_matrix,
    supported_nodes,
    uniform_beam,
)
from tests.numerics.statics import static_deflection_m

Agree = Callable[[str, float, float, float], None]

EI, RHO = 1.56e10, 4400.0


def spans(lengths: tuple[float, ...], per_span: int) -> Beam:
    """A uniform continuous beam with so many elements in each span."""
    n = len(lengths) * per_span
    beam = uniform_beam(sum(lengths), [EI] * n, RHO, 0.0, 0.0)
    return beam._replace(
        element_lengths_m=np.repeat(np.array(lengths) / per_span, per_span),
        interior_supports=tuple(per_span * k for k in range(1, len(lengths))),
    )


def reactions_n(beam: Beam, x_m: FloatArray, load_n: FloatArray) -> FloatArray:
    """Of all supports from start to end, up positive: what the held nodes of the unreduced matrices
    need. The ends that give carry their deflection over their compliance."""
    n = beam.element_lengths_m.size
    nodes = (0, *beam.interior_supports, n)
    # A deflection of one metre at a support, of the mesh on free ends, is what its reaction works
    # on: R = K[support, :] u - f[support].
    loose = beam._replace(interior_supports=(), support_compliance_m_per_n=(1.0, 1.0))
    stiffness = stiffness_matrix(loose)
    stiffness[0, 0] -= 1.0
    stiffness[2 * n, 2 * n] -= 1.0
    force = interpolation_matrix(loose, x_m).T @ load_n
    found = np.linalg.solve(stiffness_matrix(beam), interpolation_matrix(beam, x_m).T @ load_n)
    u = np.append(found, 0.0)[node_dofs(n, supported_nodes(beam)).ravel()]  # the last: what is held
    return np.array([(stiffness @ u - force)[2 * node] for node in nodes])


def test_ends_on_springs_under_a_point_load() -> None:
    """w(x) = -[P b x (L^2 - b^2 - x^2)/(6 EI L) + sag of the ends], the sag of each end being the
    lever's share of P times its compliance; 5 unequal elements, load at a node."""
    lengths = np.array([4.0, 7.0, 5.0, 8.0, 6.0])
    span, load = 30.0, 1.2e5
    for compliance in ((3e-10, 1.2e-9), (2e-9, 0.0), (0.0, 1e-9)):
        beam = uniform_beam(span, [EI] * 5, RHO, 0.0, 0.0)._replace(
            element_lengths_m=lengths, support_compliance_m_per_n=compliance
        )
        for at in (4.0, 11.0, 24.0):
            b = span - at
            start, end = load * b / span, load * at / span
            for x in (0.0, 4.0, 11.0, 16.0, 24.0, 30.0):
                near, far = (x, b) if x <= at else (span - x, at)
                bent = load * far * near * (span**2 - far**2 - near**2) / (6.0 * EI * span)
                sag = start * compliance[0] * (1 - x / span) + end * compliance[1] * x / span
                ours = static_deflection_m(beam, np.array([at]), np.array([-load]), np.array([x]))[
                    0
                ]
                assert -ours == pytest.approx(bent + sag, rel=1e-9, abs=1e-15)


def test_a_load_over_a_bearing_that_gives_sinks_by_its_compliance() -> None:
    beam = uniform_beam(30.0, [EI] * 5, RHO, 0.0, 0.0)._replace(
        support_compliance_m_per_n=(2e-10, 5e-10)
    )
    for x, compliance in ((0.0, 2e-10), (30.0, 5e-10)):
        y = static_deflection_m(beam, np.array([x]), np.array([-1e5]), np.array([x]))
        assert float(y[0]) == pytest.approx(-1e5 * compliance, rel=1e-9)


def ends_on_springs_hz(compliance: tuple[float, float], span: float, count: int) -> list[float]:
    """Roots of the determinant of w = a sin + b cos + c e^-bx + d e^-b(L-x) with w'' = 0 at the
    ends, EI w''' = -w/f at the start and EI w''' = w/f at the end, times f."""

    def determinant(bl: float) -> float:
        beta = bl / span
        s, c, e = np.sin(bl), np.cos(bl), np.exp(-bl)
        one, two = (f * EI * beta**3 for f in compliance)
        rows = [
            [0.0, -1.0, 1.0, e],
            [-s, -c, e, 1.0],
            # f EI w''' + w = 0 at the start, f EI w''' - w = 0 at the end
            [-one, 1.0, -one + 1.0, e * (one + 1.0)],
            [-two * c - s, two * s - c, e * (-two - 1.0), two - 1.0],
        ]
        return float(np.linalg.det(np.array(rows)))

    return _roots_hz(determinant, span, count, 0.3)


def _roots_hz(
    determinant: Callable[[float], float], span: float, count: int, first: float
) -> list[float]:
    grid = np.arange(first, (count + 3) * np.pi * 1.5, 0.01)
    values = [determinant(float(b)) for b in grid]
    roots = [
        brentq(determinant, a, b, xtol=1e-14)
        for (a, b), (u, v) in zip(pairwise(grid), pairwise(values), strict=True)
        if u * v < 0.0
    ]
    return [float((b / span) ** 2 * np.sqrt(EI / RHO) / (2.0 * np.pi)) for b in roots[:count]]


@pytest.mark.parametrize("compliance", [(2e-10, 3e-10), (1e-8, 1e-9), (1e-6, 1e-6)])
def test_frequencies_of_a_beam_on_springs(compliance: tuple[float, float], agree: Agree) -> None:
    """40 elements against the transcendental equation."""
    beam = uniform_beam(30.0, [EI] * 40, RHO, 0.0, 0.0)._replace(
        support_compliance_m_per_n=compliance
    )
    ours = natural_frequencies_hz(beam, 4)
    for i, known in enumerate(ends_on_springs_hz(compliance, 30.0, 4)):
        name = (
            f"beam on compliant bearings: {compliance[0]:g}, {compliance[1]:g} m/N, f_{i + 1}, Hz"
        )
        agree(name, known, float(ours[i]), 1e-5)


def three_moment_hz(lengths: tuple[float, ...], count: int) -> list[float]:
    """Natural frequencies of a continuous beam by the dynamic three-moment equation.

    A span with end moments M_l, M_r turns at its ends by M L/EI times
    phi = (coth b - cot b)/(2 b) and psi = (cosec b - cosech b)/(2 b), b being the span's b L: at an
    interior support the slopes of both spans agree. Where sin b is zero both are infinite:
    multiplied out.
    """
    total = sum(lengths)

    def determinant(bl: float) -> float:
        b = np.array([bl * length / total for length in lengths])
        # Multiplied by sin b of every span that touches the support.
        matrix = np.zeros((len(lengths) - 1,) * 2)
        sines = np.sin(b)
        phi = (sines / np.tanh(b) - np.cos(b)) / (2.0 * b) * lengths
        psi = (1.0 - sines / np.sinh(b)) / (2.0 * b) * lengths
        for i in range(len(lengths) - 1):
            matrix[i, i] = phi[i] * sines[i + 1] + phi[i + 1] * sines[i]
            if i > 0:
                matrix[i, i - 1] = psi[i] * sines[i + 1]
            if i + 2 < len(lengths):
                matrix[i, i + 1] = psi[i + 1] * sines[i]
        # Spans between interior supports were multiplied in twice.
        return float(np.linalg.det(matrix) / np.prod(sines[1:-1]))

    return _roots_hz(determinant, total, count, 1.0)


@pytest.mark.parametrize("lengths", [(20.0, 13.0), (12.0, 17.0, 14.0), (15.0, 11.0, 18.0, 13.5)])
def test_frequencies_of_continuous_beams(lengths: tuple[float, ...], agree: Agree) -> None:
    """40 elements a span against the three-moment equation."""
    ours = natural_frequencies_hz(spans(lengths, 40), 5)
    for i, known in enumerate(three_moment_hz(lengths, 5)):
        agree(f"continuous beam: {lengths} m, f_{i + 1}, Hz", known, float(ours[i]), 1e-5)


def test_frequencies_of_equal_spans(agree: Agree) -> None:
    """Two equal spans: the simple span's pi^2 and the propped cantilever's 3.9266^2 in turn; three:
    also the roots 3.5564 and 4.2975 of the three-moment equation."""
    unit = np.sqrt(EI / RHO) / (2.0 * np.pi) / 20.0**2
    two = natural_frequencies_hz(spans((20.0, 20.0), 40), 4)
    for i, root in enumerate((np.pi, 3.926602312, 2.0 * np.pi, 7.068582746)):
        agree(f"equal spans: two, f_{i + 1}, Hz", root**2 * unit, float(two[i]), 1e-5)
    three = natural_frequencies_hz(spans((20.0,) * 3, 40), 3)
    for i, root in enumerate((np.pi, 3.5564, 4.2975)):
        agree(f"equal spans: three, f_{i + 1}, Hz", root**2 * unit, float(three[i]), 5e-5)


def test_order_of_convergence_of_spans_and_springs(measured: Agree) -> None:
    """Fourth power of the mesh in the eigenvalues, as of a single span."""
    beam = spans((20.0, 13.0), 2)._replace(support_compliance_m_per_n=(3e-10, 0.0))
    exact = natural_frequencies_hz(refine(beam, 32), 2) ** 2
    parts = np.array([1, 2, 4, 8])
    errors = np.array([natural_frequencies_hz(refine(beam, int(p)), 2) ** 2 - exact for p in parts])
    for i in range(2):
        order = -float(np.polyfit(np.log(parts), np.log(errors[:, i]), 1)[0])
        measured(f"order of convergence, two spans on springs: f_{i + 1}^2", 4.0, order, 0.2)


def test_two_spans_under_a_point_load(agree: Agree) -> None:
    """Load P at a of the first of two equal spans (b = L - a): moment over the support
    -P a (L^2 - a^2)/(4 L^2), reactions of the middle P a (3 L^2 - a^2)/(2 L^3), of the far end
    -P a (L^2 - a^2)/(4 L^3); deflection under the load by superposition."""
    span, load = 20.0, 1e5
    beam = spans((span, span), 4)
    for a in (5.0, 10.0, 15.0):
        b = span - a
        moment = -load * a * (span**2 - a**2) / (4.0 * span**2)
        far = moment / span
        middle = load * a * (3.0 * span**2 - a**2) / (2.0 * span**3)
        near = load - middle - far
        x, force = np.array([a]), np.array([-load])
        ours = reactions_n(beam, x, force)
        for name, known, found in zip(
            ("start", "middle", "end"), (near, middle, far), ours, strict=True
        ):
            agree(
                f"two spans under a load: at {a:g} m, reaction of the {name}, N", known, found, 1e-9
            )
        simple = load * a**2 * b**2 / (3.0 * EI * span)
        lifted = moment * a * (span**2 - a**2) / (6.0 * EI * span)
        sag = -float(static_deflection_m(beam, x, force, x)[0])
        agree(f"two spans under a load: at {a:g} m, deflection, m", simple + lifted, sag, 1e-9)
        np.testing.assert_allclose(
            static_deflection_m(beam, x, force, np.array([0.0, span, 2 * span])), 0.0, atol=1e-15
        )


def test_reactions_carry_the_loads() -> None:
    """Three spans, one end that gives, two loads between nodes: forces and moments balance, and
    the end's reaction is its sag over its compliance."""
    lengths = (12.0, 17.0, 14.0)
    beam = spans(lengths, 6)._replace(support_compliance_m_per_n=(4e-10, 0.0))
    x, load = np.array([3.3, 21.7]), np.array([-8e4, -6e4])
    reactions = reactions_n(beam, x, load)
    at = np.array([0.0, 12.0, 29.0, 43.0])
    assert reactions.sum() == pytest.approx(1.4e5, rel=1e-9)
    assert reactions @ at == pytest.approx(-(load @ x), rel=1e-9)
    sag = -static_deflection_m(beam, x, load, np.array([0.0]))[0]
    assert reactions[0] == pytest.approx(sag / 4e-10, rel=1e-9)
