"""Watching a bridge: what crossings say and share, innovations, sums, thresholds, delays."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pre_core.monitoring.baseline import (
    SLOPE_SPREAD,
    Period,
    begin,
    changed_since,
    innovation,
    usual_change,
)
from pre_core.monitoring.cusum import ALLOWANCE, LARGEST, moved, nothing, run_length, threshold_for
from pre_core.monitoring.observation import Observation, Shared, fused
from pre_core.monitoring.watch import Rules, watch
from services.identification.observed import observation_of
from tests.fleet import bridge_of, crossing_of, templates, trucks_of

FloatArray = NDArray[np.float64]
N = 5
WEEKS = 60


def series(
    rng: np.random.Generator,
    *,
    weeks: int = WEEKS,
    loss: float = 0.0,
    at: int = 35,
    element: int = 2,
    common: float = 0.02,
    second_truck: int | None = None,
    slope: float = -0.003,
    own: float = 0.03,
    knows_temperature: bool = True,
) -> list[Period]:
    """Weeks of a bridge: a truck with an error of its level, of a standard deviation `common`."""
    level = 23.0 + 0.2 * rng.standard_normal(N)
    of_truck = {name: rng.standard_normal(2) for name in ("first", "second")}
    loading = common * np.column_stack([np.ones(N), 0.3 * rng.standard_normal(N)])
    spread = own**2 * (np.eye(N) + 0.4 * np.eye(N, k=1) + 0.4 * np.eye(N, k=-1))
    out = []
    for week in range(weeks):
        warm = 10.0 - 10.0 * np.cos(2.0 * np.pi * week / 52.0)
        truck = "second" if second_truck is not None and week >= second_truck else "first"
        value = level + slope * (warm - 10.0) + loading @ of_truck[truck]
        value = value + np.linalg.cholesky(spread) @ rng.standard_normal(N)
        if week >= at:
            value[element] += np.log(1.0 - loss)
        of = Observation(value, spread, (Shared(truck, loading),))
        out.append(Period(of, float(warm) if knows_temperature else None))
    return out


def test_what_a_crossing_says_and_shares() -> None:
    """Drawn from the likelihood's model: own errors are own, shared ones are the truck's."""
    rng = np.random.default_rng(4)
    kind = templates()[0]
    own, shared = [], []
    for _ in range(40):
        (truck,) = trucks_of(rng, 1)
        bridge = bridge_of(rng, "bridge-1")
        truth = np.log(bridge.ei_nm2)
        some = [
            observation_of(crossing_of(rng, kind, truck, bridge, float(k), bridge.ei_nm2))
            for k in range(20)
        ]
        found = [one for one in some if one is not None]
        assert len(found) == 20
        errors = np.array([one.value - truth for one in found])
        factor = np.linalg.cholesky(found[0].own)
        own.append(np.linalg.solve(factor, (errors - errors.mean(axis=0)).T) ** 2)
        common = sum((s.loading @ s.loading.T for s in found[0].shared), found[0].own / len(found))
        factor = np.linalg.cholesky(common)
        shared.append(np.linalg.solve(factor, errors.mean(axis=0)) ** 2)
    assert np.mean(own) * 20.0 / 19.0 == pytest.approx(1.0, abs=0.06)
    # 280 squares of normals: standard deviation 0.085.
    assert np.mean(shared) == pytest.approx(1.0, abs=0.3)


def test_a_period_of_several_crossings_is_their_weighted_mean() -> None:
    rng = np.random.default_rng(5)
    truth, loading = rng.standard_normal(N), 0.05 * rng.standard_normal((N, 2))
    squares = []
    for _ in range(400):
        z, parts = rng.standard_normal(2), []
        for k in range(3):
            root = (0.02 + 0.02 * k) * (np.eye(N) + 0.3 * np.eye(N, k=1))
            value = truth + loading @ z + root @ rng.standard_normal(N)
            parts.append(Observation(value, root @ root.T, (Shared("truck", loading),)))
        together = fused(parts, N)
        ((name, share),) = together.shared
        assert name == "truck"
        assert np.allclose(share, loading)  # the weights sum to one
        apart = together.value - truth - loading @ z
        squares.append(apart @ np.linalg.solve(together.own, apart) / N)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("second_truck", [None, 30])
def test_innovations_are_standard_normals_that_know_nothing_of_each_other(
    second_truck: int | None,
) -> None:
    """Whatever periods share: the truck's level, the slope, the baseline's own error."""
    rng = np.random.default_rng(6)
    r = []
    for _ in range(150):
        slope = SLOPE_SPREAD * rng.standard_normal()  # as its prior has it
        periods = series(rng, weeks=45, common=0.1, second_truck=second_truck, slope=slope)
        state, rows = begin(periods[0].observation), []
        for period in periods:
            state, found = innovation(state, period, 0.0)
            rows.append(found.value / np.sqrt(np.diag(found.covariance)))
        r.append(np.array(rows[8:]))
    of = np.array(r)
    assert of.std() == pytest.approx(1.0, abs=0.03)
    assert of.mean() == pytest.approx(0.0, abs=0.03)
    following = float(np.mean(of[:, 1:] * of[:, :-1]))
    assert following == pytest.approx(0.0, abs=0.02)


def test_innovations_of_who_forgets_what_is_shared_are_none() -> None:
    """The negative control: a second truck would pass for a change of the whole bridge."""
    rng = np.random.default_rng(6)
    alarms = {True: 0, False: 0}
    for _ in range(20):
        periods = series(rng, common=0.1, second_truck=30)
        blind = [p._replace(observation=p.observation._replace(shared=())) for p in periods]
        for is_blind, some in ((False, periods), (True, blind)):
            alarms[is_blind] += watch(some, Rules()).change is not None
    assert alarms[False] <= 1
    assert alarms[True] >= 15


def test_a_truck_that_is_known_hides_nothing() -> None:
    """Its level, five times the loss, is the same before and after."""
    rng = np.random.default_rng(7)
    delays = []
    for _ in range(20):
        found = watch(series(rng, loss=0.1, common=0.5), Rules()).change
        assert found is not None
        assert (found.element, found.direction) == (2, "weaker")
        delays.append(found.raised_at - 35)
    assert np.median(delays) <= 5


def test_a_season_is_no_change_where_the_temperature_is_known() -> None:
    rng = np.random.default_rng(8)
    found = [watch(series(rng, slope=-0.006), Rules()).change for _ in range(20)]
    assert sum(one is not None for one in found) <= 1


def test_usual_changes_are_found_in_the_periods_of_learning() -> None:
    rng = np.random.default_rng(9)
    quiet = [usual_change(series(rng, weeks=30)) for _ in range(5)]
    loud = []
    for _ in range(5):
        periods = series(rng, weeks=30)
        common = rng.standard_normal((30, 1))
        moves = 0.03 * np.sqrt(0.5) * (rng.standard_normal((30, N)) + common)
        loud.append(
            usual_change(
                [
                    p._replace(observation=p.observation._replace(value=p.observation.value + m))
                    for p, m in zip(periods, moves, strict=True)
                ]
            )
        )
    assert np.mean(quiet) < 0.01
    assert np.mean(loud) == pytest.approx(0.03, abs=0.008)


def test_the_change_is_told_with_an_interval_that_holds() -> None:
    rng = np.random.default_rng(10)
    inside = []
    for _ in range(60):
        periods = series(rng, loss=0.15)
        state = begin(periods[0].observation)
        for period in periods[:35]:
            state, _ = innovation(state, period, 0.0)
        now, mean, covariance = changed_since(state, periods[35:], 0.0, 1.0)
        half = 1.96 * np.sqrt(np.diag(covariance))
        truth = np.zeros(N)
        truth[2] = np.log(0.85)
        inside.append(np.abs(mean - truth) < half)
        assert now.mean[2] == pytest.approx(state.mean[2] + mean[2], abs=0.1)
        assert now.mean.size == state.mean.size
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)


def test_after_an_acknowledgement_what_is_then_is_the_baseline() -> None:
    rng = np.random.default_rng(11)
    periods = series(rng, weeks=80, loss=0.2)
    found = watch(periods, Rules())
    assert found.change is not None
    noted = found.change.raised_at + 3
    assert watch(periods, Rules(), [noted]).change is None
    # And a second loss behind it is found, against what was then.
    for period in periods[60:]:
        period.observation.value[0] += np.log(0.85)
    second = watch(periods, Rules(), [noted]).change
    assert second is not None
    assert (second.element, second.direction) == (0, "weaker")
    assert second.ratio[0] == pytest.approx(0.85, abs=0.03)
    assert second.ratio[2] == pytest.approx(1.0, abs=0.05)


def test_one_wild_period_gives_no_alarm() -> None:
    rng = np.random.default_rng(12)
    periods = series(rng)
    periods[40].observation.value[1] += 3.0
    assert watch(periods, Rules()).change is None


def by_brute_force(r: FloatArray, sign: float) -> FloatArray:
    """Page's sum as what it is: the largest sum over all beginnings, or nothing."""
    moves = sign * np.clip(r, -LARGEST, LARGEST) - ALLOWANCE
    return np.array(
        [max(0.0, *(moves[k : t + 1].sum() for k in range(t + 1))) for t in range(r.size)]
    )


def test_sums_are_those_of_every_beginning_tried() -> None:
    rng = np.random.default_rng(13)
    r = 1.5 * rng.standard_normal((60, 2))
    chart, up, down = nothing(2), [], []
    for one in r:
        chart = moved(chart, one)
        up.append(chart.up)
        down.append(chart.down)
    for element in range(2):
        assert np.allclose(np.array(up)[:, element], by_brute_force(r[:, element], 1.0))
        assert np.allclose(np.array(down)[:, element], by_brute_force(r[:, element], -1.0))


def test_plain_series_against_skchange() -> None:
    """One element, independent errors, one temperature: where its segments meet, a change began."""
    from skchange.detectors import PELT

    rng = np.random.default_rng(14)
    agree = 0
    for number in range(30):
        has_changed = number < 20
        values = 0.03 * rng.standard_normal(100)
        values[60:] -= 0.075 if has_changed else 0.0
        periods = [
            Period(Observation(np.array([one]), 0.03**2 * np.eye(1), ()), 10.0) for one in values
        ]
        found = watch(periods, Rules()).change
        told = PELT().fit(values[:, None] / 0.03).predict(values[:, None] / 0.03)
        theirs = np.asarray(told).ravel().tolist()
        assert (found is not None) == has_changed
        if found is not None:
            agree += abs(theirs[0] - found.since) <= 2
            assert found.direction == "weaker"
    assert agree >= 17


def test_run_lengths_are_those_of_the_literature() -> None:
    """k = 0.5: Siegmund's approximation, and the tables of NIST's handbook (h = 4, 5)."""
    for threshold in (3.0, 5.0, 8.0):
        b = threshold + 1.166
        assert run_length(threshold) == pytest.approx((np.exp(b) - b - 1.0) / 0.5, rel=0.03)
    assert run_length(4.0) / 2.0 == pytest.approx(168.0, rel=0.02)  # both sides
    assert run_length(5.0) / 2.0 == pytest.approx(465.0, rel=0.02)
    assert run_length(4.0, 1.0) == pytest.approx(8.38, rel=0.01)
    assert run_length(5.0, 1.0) == pytest.approx(10.4, rel=0.01)


def test_the_threshold_gives_the_false_alarms_that_are_asked_for() -> None:
    """Series without any change, a thousand periods each: alarms in 5,000 years of a bridge."""
    wanted = 0.5
    threshold = threshold_for(wanted, 2 * N, 52.0)
    rng = np.random.default_rng(15)
    series_count, periods = 250, 1000
    chart, alarms = nothing(series_count * N), 0
    for _ in range(periods):
        chart = moved(chart, rng.standard_normal(series_count * N))
        passed = (chart.up > threshold) | (chart.down > threshold)
        alarms += int(passed.sum())
        up, down = np.where(passed, 0.0, chart.up), np.where(passed, 0.0, chart.down)
        chart = chart._replace(up=up, down=down)
    years = series_count * periods / 52.0
    assert alarms / years == pytest.approx(wanted, rel=0.1)
