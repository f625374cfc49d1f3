"""Watching a bridge: what crossings say and share, innovations, the chart, what is no change."""

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.constants import SLOPE_SPREAD
from pre_core.monitoring.baseline import (
    BaselineState,
    Period,
    Scales,
    adopt_change,
    change_of,
    compress_shared_errors,
    filter_step,
    initial_baseline,
    predict_state,
    scales_compared,
    standardised,
    update_state,
    with_change,
)
from pre_core.monitoring.change_detection import (
    AcknowledgedChange,
    AlarmRules,
    compare_periods,
    detect_change,
    judged_periods,
)
from pre_core.monitoring.chart import STEP_SPREAD, empty_chart, log_ratio, update_chart
from pre_core.monitoring.observation import Observation, SharedError, combine_observations
from services.identification.observed import observation_of
from tests.fleet import bridge_of, crossing_of, templates, trucks_of

N = 5
WEEKS = 60
ONE = Scales(np.zeros(1), np.zeros(1), np.ones(1), np.zeros(1))
"""A bridge that never moves."""


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
        of = Observation(value, spread, (SharedError(truck, loading),))
        out.append(Period(of, float(warm) if knows_temperature else None, 7.0 * week))
    return out


def drifting(
    rng: np.random.Generator, weeks: int, spread: float, correlation_weeks: float
) -> FloatArray:
    """(weeks, N): an Ornstein-Uhlenbeck process, half of its variance common to all elements."""
    kept = np.exp(-1.0 / correlation_weeks)
    steps = np.sqrt(0.5) * (rng.standard_normal((weeks, N)) + rng.standard_normal((weeks, 1)))
    out = [steps[0]]
    for step in steps[1:]:
        out.append(kept * out[-1] + np.sqrt(1.0 - kept**2) * step)
    return spread * np.array(out)


def with_moves(periods: list[Period], moves: FloatArray) -> list[Period]:
    """The same with something added to ln EI in each period, (weeks, N)."""
    return [
        p._replace(observation=p.observation._replace(value=p.observation.value + move))
        for p, move in zip(periods, moves, strict=True)
    ]


def taught(state: BaselineState, periods: list[Period]) -> BaselineState:
    for period in periods:
        state, _ = predict_state(state, period.time_days)
        state, _ = update_state(state, filter_step(state, period))
    return state


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
            parts.append(Observation(value, root @ root.T, (SharedError("truck", loading),)))
        together = combine_observations(parts, N)
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
        state, rows = initial_baseline(periods, ONE), []
        for period in periods:
            state, _ = predict_state(state, period.time_days)
            found = filter_step(state, period)
            rows.append(standardised(state, found))
            state, _ = update_state(state, found)
        r.append(np.array(rows[8:]))
    of = np.array(r)
    assert of.std() == pytest.approx(1.0, abs=0.03)
    assert of.mean() == pytest.approx(0.0, abs=0.03)
    following = float(np.mean(of[:, 1:] * of[:, :-1]))
    assert following == pytest.approx(0.0, abs=0.02)


def test_ignoring_shared_errors_raises_false_alarms() -> None:
    """The negative control: a second truck would pass for a change of the whole bridge.

    By chance alone, of whatever size: some trucks differ by less than 5 %.
    """
    rng = np.random.default_rng(6)
    alarms, rules = {True: 0, False: 0}, AlarmRules(at_least=0.0)
    for _ in range(20):
        periods = series(rng, common=0.2, second_truck=30)
        blind = [p._replace(observation=p.observation._replace(shared=())) for p in periods]
        for is_blind, some in ((False, periods), (True, blind)):
            alarms[is_blind] += detect_change(some, rules).change is not None
    assert alarms[False] <= 1
    assert alarms[True] >= 15


def test_a_truck_that_is_known_hides_nothing() -> None:
    """Its level, five times the loss, is the same before and after."""
    rng = np.random.default_rng(7)
    delays = []
    for _ in range(20):
        found = detect_change(series(rng, loss=0.1, common=0.5), AlarmRules()).change
        assert found is not None
        assert (found.element, found.direction) == (2, "weaker")
        delays.append(found.raised_at - 35)
    assert np.median(delays) <= 5


def test_a_season_is_no_change_where_the_temperature_is_known() -> None:
    rng = np.random.default_rng(8)
    found = [detect_change(series(rng, slope=-0.006), AlarmRules()).change for _ in range(20)]
    assert sum(one is not None for one in found) <= 1


def test_usual_movements_are_found_by_their_size_and_their_slowness() -> None:
    rng = np.random.default_rng(9)
    weeks = 104
    found = []
    for kind in ("none", "white", "drift"):
        for _ in range(3):
            moves = np.zeros((weeks, N))
            if kind == "white":
                moves = 0.015 * np.sqrt(0.5) * rng.standard_normal((weeks, N))
                moves += 0.015 * np.sqrt(0.5) * rng.standard_normal((weeks, 1))
            if kind == "drift":
                moves = drifting(rng, weeks, 0.015, 26.0)
            outcome = detect_change(with_moves(series(rng, weeks=weeks), moves), AlarmRules())
            found.append((outcome.usual_change, outcome.usual_drift))
    quiet, white, drift = np.array(found).reshape(3, 3, 2).mean(axis=1)
    assert quiet.max() < 0.006
    assert white == pytest.approx([0.015, 0.0], abs=0.006)
    assert drift == pytest.approx([0.0, 0.015], abs=0.006)


def test_change_is_printed_with_a_true_interval() -> None:
    rng = np.random.default_rng(10)
    inside = []
    for _ in range(60):
        periods = series(rng, loss=0.15)
        state = taught(initial_baseline(periods, ONE), periods[:35])
        since = taught(with_change(state, 1.0), periods[35:])
        now, (mean, covariance) = adopt_change(since), change_of(since)
        half = 1.96 * np.sqrt(np.diag(covariance))
        truth = np.zeros(N)
        truth[2] = np.log(0.85)
        inside.append(np.abs(mean - truth) < half)
        assert now.mean[0, 2] == pytest.approx(state.mean[0, 2] + mean[2], abs=0.1)
        assert now.mean.size == state.mean.size
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)


def test_after_an_acknowledgement_what_is_then_is_the_baseline() -> None:
    rng = np.random.default_rng(11)
    periods = series(rng, weeks=80, loss=0.2)
    found = detect_change(periods, AlarmRules())
    assert found.change is not None
    noted = AcknowledgedChange(found.change.since, found.change.raised_at + 3)
    assert detect_change(periods, AlarmRules(), [noted]).change is None
    # And a second loss behind it is found, against what was then.
    for period in periods[60:]:
        period.observation.value[0] += np.log(0.85)
    second = detect_change(periods, AlarmRules(), [noted]).change
    assert second is not None
    assert (second.element, second.direction) == (0, "weaker")
    assert second.ratio[0] == pytest.approx(0.85, abs=0.03)
    assert second.ratio[2] == pytest.approx(1.0, abs=0.05)


def test_one_wild_period_gives_no_alarm() -> None:
    rng = np.random.default_rng(12)
    periods = series(rng)
    periods[40].observation.value[1] += 3.0
    assert detect_change(periods, AlarmRules()).change is None


def test_an_acknowledged_change_that_would_not_be_raised_again_is_taken() -> None:
    """As of an alarm that an earlier version raised: it is no reason for another one."""
    rng = np.random.default_rng(16)
    periods = series(rng, weeks=80, loss=0.2)
    assert detect_change(periods, AlarmRules(), [AcknowledgedChange(35, 36)]).change is None
    assert (
        detect_change(periods, AlarmRules(), [AcknowledgedChange(20, 21)]).change is not None
    )  # of something else


def test_ratios_are_those_of_a_filter_that_knows_of_the_change() -> None:
    """Willsky's and Jones's sums against a state that has the step in it, element by element."""
    rng = np.random.default_rng(13)
    periods = series(rng, weeks=30, loss=0.1, at=20)
    state = initial_baseline(periods, scales_compared())
    chart, states = empty_chart(state), []
    drift = state.indices["drift"]
    for number, period in enumerate(periods):
        states.append(state)
        state, kept = predict_state(state, period.time_days)
        outcome = filter_step(state, period)
        state, weight = update_state(state, outcome)
        chart = update_chart(chart, number, kept, drift, weight, outcome, 1.0)
    _, log = log_ratio(chart, state, len(periods) - 1)
    assert chart.begins[-8:] == tuple(range(22, 30))
    for at, since in enumerate(chart.begins):
        if since + 3 > len(periods):
            assert np.all(np.isinf(log[at]))
            continue
        for element in (0, 2):
            stepped = with_change(states[since], STEP_SPREAD)
            place = stepped.indices["change"]
            others = [place.start + n for n in range(N) if n != element]
            stepped.covariance[:, others] = 0.0
            stepped.covariance[:, :, others] = 0.0
            with_it = evidence(stepped, periods[since:])
            without = evidence(states[since], periods[since:])
            assert log[at, element] == pytest.approx(with_it - without, abs=1e-6)


def evidence(state: BaselineState, periods: list[Period]) -> float:
    """Logarithm of the density of what was observed, the scales integrated out."""
    total = 0.0
    for period in periods:
        state, _ = predict_state(state, period.time_days)
        outcome = filter_step(state, period)
        apart = np.linalg.solve(outcome.covariance, outcome.value[:, :, None])[:, :, 0]
        log = -0.5 * np.sum(apart * outcome.value, axis=1)
        log = log - 0.5 * np.linalg.slogdet(outcome.covariance)[1]
        total += float(np.log(np.sum(np.exp(state.log_weight + log))))
        state, _ = update_state(state, outcome)
    return total


def test_false_alarms_are_no_more_than_stated() -> None:
    """Bridges that move as the priors have it, by chance alone, whatever the size of the change."""
    rng = np.random.default_rng(15)
    scales, weeks, rules = scales_compared(), 60, AlarmRules(1.0, at_least=0.0)
    alarms = 0
    for _ in range(40):
        which = rng.choice(scales.change.size, p=np.exp(scales.log_prior))
        moves = drifting(rng, weeks, scales.drift[which], scales.correlation_days[which] / 7.0)
        common = rng.standard_normal((weeks, 1))
        moves += scales.change[which] * np.sqrt(0.5) * (rng.standard_normal((weeks, N)) + common)
        slope = SLOPE_SPREAD * rng.standard_normal()
        periods = with_moves(series(rng, weeks=weeks, slope=slope), moves)
        alarms += detect_change(periods, rules).change is not None
    # 40 years of a bridge; a chart that forgets what is uncertain alarms in most of them.
    assert alarms <= 10


@pytest.mark.parametrize("correlation_weeks", [8.0, 26.0])
def test_stiffness_that_drifts_is_no_change(correlation_weeks: float) -> None:
    rng = np.random.default_rng(21)
    alarms = 0
    for _ in range(30):
        moves = drifting(rng, 104, 0.012, correlation_weeks)
        alarms += (
            detect_change(with_moves(series(rng, weeks=104), moves), AlarmRules()).change
            is not None
        )
    assert alarms == 0


def test_a_season_of_unknown_temperature_is_no_change_and_takes_a_year() -> None:
    rng = np.random.default_rng(22)
    for _ in range(15):
        periods = series(rng, weeks=156, slope=-0.006, knows_temperature=False)
        found = detect_change(periods, AlarmRules())
        assert found.change is None
        assert np.flatnonzero(found.judged)[0] == 52


def test_a_loss_behind_a_season_of_unknown_temperature_is_found() -> None:
    rng = np.random.default_rng(23)
    delays = []
    for _ in range(10):
        periods = series(rng, weeks=110, loss=0.15, at=70, knows_temperature=False)
        found = detect_change(periods, AlarmRules()).change
        assert found is not None
        assert (found.element, found.direction) == (2, "weaker")
        delays.append(found.raised_at - 69)
    assert np.median(delays) <= 6


def test_a_change_that_is_too_small_to_matter_raises_no_alarm() -> None:
    """A loss of 4 % that is as certain as can be; and the same where 2 % matter."""
    rng = np.random.default_rng(24)
    inside = 0
    for _ in range(8):
        periods = series(rng, loss=0.04, own=0.005, weeks=60)
        assert detect_change(periods, AlarmRules()).change is None
        found = detect_change(periods, AlarmRules(at_least=0.02)).change
        assert found is not None
        assert (found.element, found.high[2] < 0.98) == (2, True)
        inside += bool(found.low[2] < 0.96 < found.high[2])
    assert inside >= 6


def test_a_slow_loss_is_found_though_the_baseline_learns_of_it() -> None:
    rng = np.random.default_rng(25)
    moves = np.zeros((130, N))
    moves[26:, 2] = np.log(1.0 - 0.15 * np.arange(104) / 52.0)
    found = [
        detect_change(with_moves(series(rng, weeks=130), moves), AlarmRules()).change
        for _ in range(6)
    ]
    assert [c is not None and (c.element, c.direction) for c in found] == [(2, "weaker")] * 6


def test_periods_are_judged_behind_training_or_behind_a_year() -> None:
    rng = np.random.default_rng(26)
    known = series(rng, weeks=20)
    assert judged_periods(known, 8).tolist() == [False] * 8 + [True] * 12
    # Two weeks without temperature: they are not judged, and teach no slope.
    some = [p._replace(temperature_deg_c=None) if k in (3, 12) else p for k, p in enumerate(known)]
    assert np.flatnonzero(judged_periods(some, 8)).tolist() == [9, 10, 11, *range(13, 20)]
    unknown = series(rng, weeks=60, knows_temperature=False)
    assert np.flatnonzero(judged_periods(unknown, 8)).tolist() == list(range(52, 60))
    assert judged_periods([], 8).tolist() == []


def test_months_that_are_missing_widen_what_is_not_known() -> None:
    """A drift goes on while nobody looks: half a year later less is known."""
    rng = np.random.default_rng(27)
    moves = drifting(rng, 60, 0.02, 20.0)
    periods = with_moves(series(rng, own=0.01), moves)
    state = taught(initial_baseline(periods, scales_compared()), periods[:52])
    near = filter_step(predict_state(state, periods[51].time_days + 7.0)[0], periods[52])
    far = filter_step(predict_state(state, periods[51].time_days + 182.0)[0], periods[52])
    assert np.all(far.covariance[:, 2, 2] >= near.covariance[:, 2, 2])
    weight = np.exp(state.log_weight)
    assert weight @ far.covariance[:, 2, 2] > 1.3 * (weight @ near.covariance[:, 2, 2])


def test_shared_errors_lose_nothing_that_matters_by_compression() -> None:
    """Innovations with all unknowns of three trucks, and with the few directions of each."""
    rng = np.random.default_rng(29)
    trucks, bridge = trucks_of(rng, 3), bridge_of(rng, "bridge-1")
    periods = []
    for week in range(20):
        crossing = crossing_of(
            rng, templates()[week % 3], trucks[week % 2], bridge, float(week), bridge.ei_nm2
        )
        found = observation_of(crossing)
        assert found is not None
        periods.append(Period(found, 10.0, 7.0 * week))
    few = compress_shared_errors(periods)
    whole, part = initial_baseline(periods, ONE), initial_baseline(few, ONE)
    assert part.mean.size < 0.7 * whole.mean.size
    for plain, short in zip(periods, few, strict=True):
        a, b = filter_step(whole, plain), filter_step(part, short)
        assert np.allclose(a.covariance, b.covariance, rtol=0.03, atol=1e-5)
        scale = np.sqrt(np.diagonal(a.covariance[0]))
        assert np.abs((a.value - b.value)[0] / scale).max() < 0.1
        whole, part = update_state(whole, a)[0], update_state(part, b)[0]


def test_two_periods_are_compared_without_what_they_share() -> None:
    """One truck, whose error of 10 % is in both; intervals that hold, and are no wider."""
    rng = np.random.default_rng(30)
    inside, widths = [], []
    for _ in range(100):
        first, *_, last = series(rng, weeks=20, loss=0.2, at=10, common=0.1, slope=0.0)
        found = compare_periods(first, last)
        truth = np.where(np.arange(N) == 2, 0.8, 1.0)
        inside.append((found.low < truth) & (truth < found.high))
        widths.append(np.log(found.high / found.low) / 3.92)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)
    assert np.mean(widths) == pytest.approx(0.03 * np.sqrt(2.0), rel=0.05)


@pytest.mark.slow
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
            Period(Observation(np.array([one]), 0.03**2 * np.eye(1), ()), 10.0, 7.0 * week)
            for week, one in enumerate(values)
        ]
        found = detect_change(periods, AlarmRules(0.1, at_least=0.0)).change
        outcome = PELT().fit(values[:, None] / 0.03).predict(values[:, None] / 0.03)
        theirs = np.asarray(outcome).ravel().tolist()
        assert (found is not None) == has_changed
        if found is not None:
            agree += abs(theirs[0] - found.since) <= 2
            assert found.direction == "weaker"
    assert agree >= 17
