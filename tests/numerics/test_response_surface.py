"""Response surfaces of a crossing: true to its residuals where the posterior is."""

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import compliances, posterior
from pre_core.crossing.expected_squares import expected_squares
from pre_core.crossing.fit import Optimum
from pre_core.crossing.nuisances import index_of_offset, integrated_residuals
from pre_core.crossing.response_surface import (
    ResponseSurface,
    _fit_parabolas,
    _root_of_squares,
    residuals_of,
)
from pre_core.crossing.surface_posterior import (
    curved_coordinates,
    draw_curved,
    drawn_by_residuals,
    nuisances_on,
    surface_posterior,
)
from pre_core.fusion.curvature import to_surface_coordinates
from pre_core.fusion.linearised import of_surface
from pre_core.search.levenberg_marquardt import minimise
from tests.numerics.single_tyres import at_its_truth

TWIN, SINGLE = "five-elements", "single-5"
DRAWS = 40


def vibration(found: Optimum, bridges: FloatArray, curved: NDArray[np.int64]) -> FloatArray:
    """Return a root (m, 6 k) of the mean covariance of all modes' waves on bridges (k, n)."""
    swing = posterior.layout(found.problem).swing
    y = np.repeat(found.state.y[None, :], bridges.shape[0], axis=0)
    y[:, curved] = bridges
    apart = []
    for place in range(swing.start, swing.stop):
        up, down = y.copy(), y.copy()
        up[:, place], down[:, place] = 0.5, -0.5
        apart.append(
            posterior.all_rows(found.problem, up) - posterior.all_rows(found.problem, down)
        )
    return np.asarray(np.concatenate(apart).T / np.sqrt(bridges.shape[0]))


def least_squares(found: Optimum, curved: FloatArray, waves: FloatArray) -> float:
    """Return the least sum of squares at curved coordinates and offset, over all others in y.

    The residuals themselves are fitted again, without the priors of the curved coordinates; the
    vibration before the crossing is noise of the root `waves`. The squares that noise is expected
    to have there are subtracted, beyond their tangent in the priors.
    """
    where = posterior.layout(found.problem)
    places = curved_coordinates(found)
    rows = compliances.without_priors(found.problem, found.state.residual.size, places)
    place, swing = index_of_offset(found.problem), np.arange(where.swing.start, where.swing.stop)
    y = found.state.y.copy()
    y[places] = curved[:-1]
    y[where.trajectory] += curved[-1] - y[place]
    y[swing] = 0.0
    free = np.setdiff1d(np.arange(y.size), np.concatenate([places, [place], swing]))
    along, size, _ = np.linalg.svd(waves[rows], full_matrices=False)

    def moved(x: FloatArray) -> FloatArray:
        points = np.repeat(y[None, :], x.shape[0], axis=0)
        points[:, free] = x
        out = posterior.all_rows(found.problem, points)[:, rows]
        return np.asarray(out - (out @ along) * (1.0 - 1.0 / np.sqrt(1.0 + size**2)) @ along.T)

    state = minimise(moved, y[free], 40, 1e-3).state
    y[free] = state.y
    of = expected_squares(found.problem, found.state.y)
    return state.objective - 2.0 * float(of.beyond_tangent(y[None, :])[0])


@pytest.mark.slow
def test_the_surface_has_the_least_squares_of_the_residuals() -> None:
    """At draws of the posterior that it was not fitted to, with all other coordinates free."""
    found = at_its_truth(TWIN)
    of = surface_posterior(found, 1.0, seed=1)
    weighted = draw_curved(found, of.squares, 1000, 7, 1.0)
    rng = np.random.default_rng(3)
    drawn = weighted.y[rng.choice(weighted.y.shape[0], DRAWS, p=weighted.weights.weight)]
    bridges = of.points[rng.choice(of.points.shape[0], 60, replace=False), :-1]
    waves = vibration(found, bridges, of.curved)
    true = np.array([least_squares(found, one, waves) for one in drawn])
    seen = of.squares(drawn)
    assert np.std(seen - true) < 0.5 * np.std(true)
    assert np.corrcoef(seen, true)[0, 1] > 0.7


@pytest.mark.slow
def test_integrated_residuals_have_the_least_squares_of_all_residuals() -> None:
    """With alike tyres, whose draws they weight; over others single draws are 3 off."""
    found = at_its_truth(SINGLE)
    weighted = drawn_by_residuals(found, 300, 7, 1.0, lambda stage, fraction: None).weighted
    rng = np.random.default_rng(3)
    drawn = weighted.y[rng.choice(weighted.y.shape[0], DRAWS, p=weighted.weights.weight)]
    others = weighted.y[rng.choice(weighted.y.shape[0], 40, p=weighted.weights.weight)]
    waves = vibration(found, others[:, :-1], curved_coordinates(found))
    true = np.array([least_squares(found, one, waves) for one in drawn])
    residuals = integrated_residuals(nuisances_on(found, others), drawn, has_step=True)
    seen = np.sum(residuals**2, axis=0)
    assert np.std(seen - true) < 0.1 * np.std(true)


def _some_columns(values: FloatArray, some: slice) -> FloatArray:
    return values[:, some]


def test_parabolas_are_found_again() -> None:
    rng = np.random.default_rng(2)
    u = rng.standard_normal((200, 4))
    first, second = np.triu_indices(4)
    true = rng.standard_normal((5, 1 + 4 + first.size))
    values = true @ np.column_stack([np.ones(200), u, u[:, first] * u[:, second]]).T
    fitted, error, remainder = _fit_parabolas(u, partial(_some_columns, values))
    assert np.allclose(fitted, true, atol=2e-3)
    assert np.abs(error).max() < 1e-3
    assert np.abs(remainder).max() < 1e-2


def test_remainder_has_the_covariance_of_what_parabolas_leave() -> None:
    rng = np.random.default_rng(4)
    u = rng.standard_normal((16_000, 2))
    # Hermite polynomials of third order are uncorrelated with parabolas of normal points.
    third = u[:, 0] ** 3 - 3.0 * u[:, 0]
    true = rng.standard_normal((6, 6))
    values = true @ np.column_stack([np.ones(16_000), u, u**2, u[:, 0] * u[:, 1]]).T
    along = np.array([2.0, 0.0, 1.0, 0.0, 0.0, 0.5])
    _, _, remainder = _fit_parabolas(u, partial(_some_columns, values + np.outer(along, third)))
    expected = 6.0 * np.outer(along, along)  # the variance of that polynomial is 3!
    assert remainder @ remainder.T == pytest.approx(expected, rel=0.3, abs=0.3)


def test_remainder_is_noise() -> None:
    """R'R is the information of the columns with white noise and the remainder's together."""
    rng = np.random.default_rng(6)
    columns, noise = rng.standard_normal((30, 5)), rng.standard_normal((30, 7))
    root = _root_of_squares(columns, np.zeros((2, 2)), noise)
    covariance = np.eye(30) + noise @ noise.T
    expected = columns.T @ np.linalg.solve(covariance, columns)
    np.testing.assert_allclose(root.T @ root, expected, rtol=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_without_residuals_do_not_count(value: float) -> None:
    """One of 1,920 points, far in a tail, cost a crossing its result."""
    rng = np.random.default_rng(5)
    u, values = rng.standard_normal((400, 3)), rng.standard_normal((20, 400))
    impossible = values.copy()
    impossible[7, [3, 170]] = value
    *found, remainder = _fit_parabolas(u, partial(_some_columns, impossible))
    assert np.isfinite(remainder).all()
    rest = np.delete(np.arange(400), [3, 170])
    *expected, _ = _fit_parabolas(u[rest], partial(_some_columns, values[:, rest]))
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, rel=1e-9, abs=1e-12)


def test_what_parabolas_do_not_follow_counts_as_no_knowledge() -> None:
    """Of a remainder without parabolas the squares are zero on average, not those of a fit."""
    rng = np.random.default_rng(8)
    of_fits, corrected = [], []
    for _ in range(40):
        u = rng.standard_normal((100, 3))
        values = rng.standard_normal((30, 100))
        fitted, error, _ = _fit_parabolas(u, partial(_some_columns, values))
        of_fits.append(np.trace(fitted.T @ fitted))
        corrected.append(of_fits[-1] - np.trace(error))
    assert np.mean(of_fits) > 2.0
    assert abs(np.mean(corrected)) < 0.05 * np.mean(of_fits)


def test_squares_of_few_rows_are_those_of_all_less_their_error() -> None:
    rng = np.random.default_rng(9)
    columns, error = rng.standard_normal((40, 6)), np.diag([0.5, 1.0, 0.1])
    few = _root_of_squares(columns, error, np.zeros((40, 0)))
    squares = columns.T @ columns
    squares[:3, :3] -= error
    assert few.shape == (6, 6)
    assert np.allclose(few.T @ few, squares)


def drawn_surface(rng: np.random.Generator, moves: int) -> ResponseSurface:
    """Return a surface of random numbers, of two linear coordinates and two waves."""
    m = 9
    some = rng.standard_normal
    return ResponseSurface(
        some(moves),
        np.exp(some(moves)),
        some(m),
        some((m, moves)),
        some((m, moves * (moves + 1) // 2)),
        some((m, 2)),
        some(2),
        some((2, moves)),
        some((m, 2)),
        0,
    )


def test_a_likelihood_has_the_residuals_of_its_surface() -> None:
    """In ln c, with the offset from its centre, and a truck that does not follow the bridge."""
    rng = np.random.default_rng(4)
    sigma = np.array([0.3, 0.6])
    surface = drawn_surface(rng, 4)
    terms, linearised = of_surface(surface, sigma)
    for _ in range(5):
        y = surface.centre + surface.size * rng.standard_normal(4)
        truck, waves = rng.standard_normal(2), rng.standard_normal(2)
        u = (y - surface.centre) / surface.size
        apart = surface.linear @ (truck - surface.at - surface.follow @ u) + surface.waves @ waves
        bridge = np.append(y[0], np.exp(-sigma * y[1:3]))
        v = to_surface_coordinates(terms, bridge)
        place = y[3] - surface.centre[3]
        about = to_surface_coordinates(terms, terms.about)
        size = np.linalg.solve(terms.directions, np.append(v - about, place))
        first, second = np.triu_indices(4)
        bends = terms.shapes @ (size[first] * size[second])
        x = np.concatenate([v, truck, waves, [place], bends])
        found = linearised.residual + linearised.jacobian @ (x - linearised.centre)
        assert np.allclose(found, residuals_of(surface, y[None, :])[0] + apart)
