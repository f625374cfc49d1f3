"""Errors by short waves of the mismatch: their response, and what runs on one path share."""

from functools import cache

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.compliances import to_compliance_coordinates
from pre_core.crossing.rows import filter_adjoint, filter_rows, row_count, row_filter
from pre_core.crossing.whitening import solve, solve_transposed
from pre_core.fusion.information import BridgePriors, posterior_information
from pre_core.fusion.joint import build_joint
from pre_core.fusion.likelihood import CrossingLikelihood, likelihood
from pre_core.fusion.path_groups import FusionInput
from pre_core.fusion.short_waves import ShortWaveResponse, shared_error_roots
from pre_core.parameters import mass_powers, names
from pre_core.physics.simulate import rear_position_m
from tests.numerics.single_tyres import at_its_truth
from tests.numerics.whitened import white_rows

# They share a crossing at its truth, which takes seconds.
pytestmark = pytest.mark.xdist_group("at its truth")
ELEMENTS = 5


def test_the_adjoint_of_the_filter() -> None:
    rng = np.random.default_rng(1)
    rows = row_filter(0.002)
    x = rng.standard_normal(400)
    filtered = np.empty(row_count(rows, x.size))
    filter_rows(rows.taps, rows.every, x, filtered)
    y = rng.standard_normal(filtered.size)
    assert filter_adjoint(rows, y, x.size) @ x == pytest.approx(y @ filtered, rel=1e-12)


def test_the_transposed_factor() -> None:
    rng = np.random.default_rng(2)
    factor = rng.uniform(0.1, 0.3, (40, 6))
    factor[:, -1] += 1.0
    for i in range(5):  # nothing before the first column
        factor[i, : 5 - i] = 0.0
    dense = np.zeros((40, 45))
    for i, row in enumerate(factor):
        dense[i, i : i + 6] = row
    x, y = rng.standard_normal((2, 40))
    there, back = x.copy(), y.copy()
    solve(factor, 1.0 / factor[:, -1], there)
    solve_transposed(factor, 1.0 / factor[:, -1], back)
    assert back @ x == pytest.approx(y @ there, rel=1e-12)
    assert np.allclose(dense[:, 5:].T @ back, y)


@cache
def crossing() -> CrossingLikelihood:
    return likelihood(at_its_truth())


def test_the_response_is_the_change_of_the_estimate() -> None:
    """A wave in the residuals on and near the bridge moves the linear estimate as it says."""
    found = at_its_truth()
    problem, state = found.problem, found.state
    where = posterior.layout(problem)
    short = crossing().short_waves
    assert short is not None
    at = posterior.points(problem, state.y[None, :])
    front, wheelbase_m = at.position_m[0], float(at.wheelbase_m[0])
    rear = rear_position_m(front, wheelbase_m, problem.crossing.direction)
    rear = rear[problem.crossing.first_row :]
    near = (rear > -7.5) & (rear < problem.crossing.span_m + 7.5)
    _, jacobian = to_compliance_coordinates(problem, state.y, state.jacobian)
    data = problem.noise.reciprocal.size
    for k in (4, 60, 130):
        n = short.cycles_per_m[k]
        for wave, response in ((np.cos, short.cosine), (np.sin, short.sine)):
            residuals = np.zeros((3, rear.size))
            residuals[0, near] = wave(2.0 * np.pi * n * rear[near])
            white = white_rows(problem.rows, problem.noise, residuals)
            change = np.linalg.solve(jacobian.T @ jacobian, jacobian[:data].T @ white)
            expected = change[where.bridge]
            assert np.allclose(response[:, k], expected, atol=1e-6 * np.abs(expected).max())


def test_equal_runs_share_all_and_runs_by_other_waves_nothing() -> None:
    rng = np.random.default_rng(3)
    cosine, sine = rng.standard_normal((2, 3, 8))
    low = np.arange(8) < 4
    one = ShortWaveResponse(0.1, cosine, sine)
    density = rng.uniform(1.0, 2.0, 8)
    covariance = (cosine * density * 0.1) @ cosine.T + (sine * density * 0.1) @ sine.T
    for root in shared_error_roots([one] * 4, density):
        assert np.allclose(root @ root.T, 3.0 * covariance)
    apart = [one._replace(cosine=cosine * some, sine=sine * some) for some in (low, ~low)]
    assert all(np.allclose(root @ root.T, 0.0) for root in shared_error_roots(apart, density))


def test_four_runs_on_the_same_path_are_not_twice_as_certain() -> None:
    """One run four times: its mismatch is the same in all, and only sensor noise averages out."""

    def spread(runs: int, *, with_short_waves: bool) -> FloatArray:
        of = crossing()
        if not with_short_waves:
            of = of._replace(short_waves=None)
        power = dict(zip(names(ELEMENTS), mass_powers(ELEMENTS).tolist(), strict=True))
        powers = np.array([power[name] for name in of.bridge.names])
        priors = BridgePriors(of.bridge, powers, np.zeros(powers.size), ELEMENTS)
        tyres = at_its_truth().problem.mismatch.shapes.footprints
        parts = [FusionInput(f"run {n}", of, "truck", 1, tyres, 0.0) for n in range(runs)]
        joint = build_joint(parts, priors)
        precision, _ = posterior_information(joint, priors, joint.crossings)
        return np.sqrt(np.diag(np.linalg.inv(precision)))[joint.layout.elements]

    single = spread(1, with_short_waves=True)
    fused = spread(4, with_short_waves=True)
    as_noise = spread(4, with_short_waves=False)
    assert np.all(as_noise < fused)
    assert np.all(fused < single)
    assert np.mean(np.log(fused / as_noise)) > 0.1
