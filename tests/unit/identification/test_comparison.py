"""Which element is weak, on numbers worked out by hand and on drawn ones."""

import numpy as np
import pytest

from schemas.results import BridgeResult, ElementState
from services.common.language import ENGLISH
from services.identification.bridge_state import compared as compared_of_state
from services.identification.comparison import (
    Comparison,
    Estimate,
    compare,
    describe_comparison,
    estimate_of_state,
    sentences,
)

EDGES_M = np.linspace(0.0, 30.0, 8)
RATIOS = np.array([1.0, 0.98, 1.01, 0.4, 1.02, 1.0, 0.99])
NOMINAL = np.full(7, 15e9)


def estimate(ratios: np.ndarray, relative: float = 0.03, scale_error: float = 0.0) -> Estimate:
    mean = ratios * NOMINAL[: ratios.size]
    factor = np.exp(1.96 * relative)
    return Estimate(mean, mean / factor, mean * factor, scale_error)


def compared(
    ratios: np.ndarray = RATIOS, baseline: Estimate | None = None, **options: float
) -> Comparison:
    edges = np.linspace(0.0, 30.0, ratios.size + 1)
    found = compare(estimate(ratios, **options), NOMINAL[: ratios.size], edges, baseline)
    assert found is not None
    return found


def test_a_weak_element_is_named_with_its_place_loss_and_interval() -> None:
    found = compared()
    (weak,) = found.weak
    assert (weak.number, weak.ratio) == (4, pytest.approx(0.4))
    # 3 % of its own and 1.25 · 3 % / √6 of the middle of the others.
    half = 1.96 * 0.03 * np.hypot(1.0, 1.25 / np.sqrt(6.0))
    assert (weak.low, weak.high) == pytest.approx((0.4 * np.exp(-half), 0.4 * np.exp(half)), 1e-3)
    assert sentences(found) == [
        (
            "Element 4 (12.9 to 17.1 m) is 60 % less stiff than the other elements "
            "(95 % interval 57 to 63 %)."
        ),
        ENGLISH.text("rest.others", within=3),
        ENGLISH.text("rest.detectable", loss=21),
    ]


@pytest.mark.parametrize("guess", [0.5, 0.86, 1.0, 1.3])
def test_a_wrong_nominal_value_changes_no_comparison(guess: float) -> None:
    """Nobody knows the nominal value well: 14 % too high is no loss of 14 % everywhere."""
    found = compared(guess * RATIOS)
    assert found.median_ratio == pytest.approx(guess)
    assert [e.ratio for e in found.elements] == pytest.approx(
        [e.ratio for e in compared().elements]
    )
    assert compared(np.full(7, guess)).weak == ()
    assert sentences(compared(np.full(7, guess))) == [
        ENGLISH.text("all.others", within=1),
        ENGLISH.text("rest.detectable", loss=21),
    ]


def test_what_all_elements_have_in_common_is_no_error_of_a_comparison() -> None:
    """The scale error is in every interval, and drops out of a ratio of two elements."""
    own, scale = 0.03, 0.04
    wide = compared(relative=float(np.hypot(own, scale)), scale_error=scale)
    (weak,), (exact,) = wide.weak, compared(relative=own).weak
    assert (weak.low, weak.high) == pytest.approx((exact.low, exact.high), rel=1e-3)
    (blunt,) = compared(relative=float(np.hypot(own, scale))).weak
    assert blunt.high - blunt.low > 1.3 * (exact.high - exact.low)


def test_a_loss_is_clear_only_if_all_of_its_interval_is() -> None:
    ratios = np.array([1.0, 1.0, 0.85, 1.0, 1.0])
    assert [e.number for e in compared(ratios, relative=0.01).weak] == [3]
    assert compared(ratios, relative=0.05).weak == ()
    output, _ = sentences(compared(ratios, relative=0.05))
    assert output == ENGLISH.text("all.others", within=15)


def test_the_detectable_loss_is_clear_in_95_of_100_measurements() -> None:
    """Measurements of an element with that loss are drawn, against a baseline as uncertain."""
    rng = np.random.default_rng(5)
    sound = compared(np.ones(7), estimate(np.ones(7)))
    loss = sound.elements[2].detectable_loss
    assert 0.2 < loss < 0.3
    true = np.ones(7)
    true[2] = 1.0 - loss
    clear = []
    for _ in range(2000):
        now, then = np.exp(0.03 * rng.standard_normal((2, 7)))
        clear.append(compared(true * now, estimate(then)).elements[2].is_weak)
    # The standard deviation of a share of 95 % of 2,000 is 0.5 %.
    assert np.mean(clear) == pytest.approx(0.95, abs=0.015)


def test_a_baseline_is_compared_with_and_its_errors_count() -> None:
    """Every element is 30 % less stiff: the others would not show it."""
    now = 0.7 * np.ones(7)
    baseline = estimate(np.ones(7), relative=0.02)
    found = compared(now, baseline)
    assert len(found.weak) == 7
    first = found.elements[0]
    half = 1.96 * np.hypot(0.03, 0.02)
    assert first.high == pytest.approx(0.7 * np.exp(half), rel=1e-3)
    assert "than the baseline" in sentences(found)[0]
    assert compared(now).weak == ()
    unchanged = sentences(compared(np.array([1.0, 1.04, 0.97]), estimate(np.ones(3))))
    assert unchanged == [
        ENGLISH.text("all.baseline", within=4),
        ENGLISH.text("rest.detectable", loss=23),
    ]


def test_weak_elements_come_first_and_stiffer_ones_are_named() -> None:
    ratios = np.array([1.0, 0.6, 1.0, 0.3, 1.0, 1.5, 1.0])
    found = compared(ratios)
    assert [element.number for element in found.weak] == [4, 2]
    assert [element.number for element in found.stiff] == [6]
    output = sentences(found)
    assert output[0].startswith("Element 4 (12.9 to 17.1 m) is 70 % less stiff")
    assert output[2].startswith(
        "Element 6 (21.4 to 25.7 m) is 50 % stiffer than the other elements"
    )


def test_bridges_of_unequal_elements_are_compared_by_pattern() -> None:
    nominal = np.array([10e9, 20e9, 30e9, 20e9, 10e9])
    mean = 0.9 * nominal
    mean[2] *= 0.5
    found = compare(Estimate(mean, 0.95 * mean, 1.05 * mean), nominal, np.linspace(0, 1, 6))
    assert found is not None
    assert [element.number for element in found.weak] == [3]
    assert found.weak[0].ratio == pytest.approx(0.5)


def test_lack_of_comparable_data_is_reported() -> None:
    two = estimate(np.ones(2))
    assert compare(two, NOMINAL[:2], EDGES_M[:3]) is None
    assert compare(two, NOMINAL[:2], EDGES_M[:3], two) is not None
    zero = Estimate(NOMINAL, 0.0 * NOMINAL, NOMINAL)
    assert compare(zero, NOMINAL, EDGES_M) is None
    assert compare(estimate(np.ones(7)), NOMINAL, EDGES_M, two) is None  # of another bridge
    assert sentences(None) == [
        "The elements cannot be compared with each other, and there is no baseline."
    ]


def test_sound_bridges_are_seldom_accused_and_losses_lie_in_their_intervals() -> None:
    """1000 drawn bridges of seven elements with errors of 5 % and a scale error of 2 %."""
    rng = np.random.default_rng(7)
    held = accused = 0
    for _ in range(1000):
        truth = np.ones(7)
        truth[rng.integers(7)] = 0.6
        errors = np.exp(0.05 * rng.standard_normal(7) + 0.02 * rng.standard_normal())
        relative = float(np.hypot(0.05, 0.02))
        found = compared(0.9 * truth * errors, relative=relative, scale_error=0.02)
        weak = int(np.argmin(truth))
        element = found.elements[weak]
        held += element.low <= 0.6 <= element.high
        accused += any(e.is_weak for e in found.elements if e.number != weak + 1)
    assert 930 <= held <= 985  # 95 %, and six standard deviations less for what is approximate
    assert accused <= 5


def state_of_draws(ei: np.ndarray, lengths: np.ndarray) -> BridgeResult:
    """What is stored of a bridge that was drawn (draws, n) relative to nominal."""

    def summary(draws: np.ndarray) -> ElementState:
        low, high = np.quantile(draws, [0.025, 0.975])
        return ElementState(mean=draws.mean(), std=draws.std(), q025=low, q975=high)

    elements = {f"EI_{n}": summary(one) for n, one in enumerate(ei.T, start=1)}
    level = summary(np.exp(np.log(ei) @ (lengths / lengths.sum())))
    return BridgeResult(**elements, level=level)


@pytest.mark.parametrize(
    ("own", "common"), [(0.03, 0.0), (0.03, 0.015), (0.03, 0.06), (0.3, 0.0), (0.2, 0.1)]
)
@pytest.mark.parametrize("lengths", [np.ones(7), np.array([1.0, 2.0, 4.0, 6.0, 4.0, 2.0, 1.0])])
def test_common_to_all_is_what_the_level_has_beyond_elements_that_err_on_their_own(
    own: float, common: float, lengths: np.ndarray
) -> None:
    rng = np.random.default_rng(3)
    errors = own * rng.standard_normal((40_000, 7)) + common * rng.standard_normal((40_000, 1))
    ei = RATIOS * np.exp(errors)
    state = state_of_draws(ei, lengths)
    found = estimate_of_state(state, lengths.tolist()).scale_error
    # Of a log-normal the relative deviation is not that of the logarithm: 5 % more at 0.3.
    assert found == pytest.approx(common, rel=0.1, abs=0.15 * own)
    # The interval is that of the ratio in the draws, which know what is common.
    comparison = compared_of_state(state, np.ones(7), lengths)
    assert comparison is not None
    for element in comparison.elements:
        n = element.number - 1
        ratio = ei[:, n] / np.median(np.delete(ei, n, axis=1), axis=1)
        low, high = np.quantile(np.log(ratio), [0.025, 0.975])
        assert np.log(element.high / element.low) == pytest.approx(high - low, rel=0.08)


def test_of_elements_that_trade_with_each_other_nothing_is_taken_for_common() -> None:
    rng = np.random.default_rng(4)
    errors = 0.3 * rng.standard_normal((10_000, 7))
    errors -= 0.8 * errors.mean(axis=1, keepdims=True)
    state = state_of_draws(np.exp(errors), np.ones(7))
    assert estimate_of_state(state).scale_error == 0.0
    assert state.level is not None
    assert state.level.std > 0.01


LEVEL = ElementState(mean=0.9, std=0.09, q025=0.75, q975=1.08)


def test_unresolved_elements_are_never_stated_to_agree() -> None:
    found = compared()
    assert describe_comparison(found) == sentences(found)
    assert describe_comparison(found, frozenset({1, 5}), LEVEL) == [
        (
            "Element 4 (12.9 to 17.1 m) is 60 % less stiff than the other elements "
            "(95 % interval 57 to 63 %)."
        ),
        "The loss may also be in the adjacent element 5.",
        "Elements 1 and 5 are not resolved (standard deviation above 25 %).",
        ENGLISH.text("rest.resolved", loss=21),
        "The overall stiffness is 0.90 times the nominal value, ± 10 %.",
    ]
    sound = compared(np.ones(7))
    assert describe_comparison(sound, frozenset({7})) == [
        "Element 7 is not resolved (standard deviation above 25 %).",
        ENGLISH.text("rest.resolved", loss=21),
    ]
    assert describe_comparison(sound, frozenset({7}), without=("detectable", "unresolved")) == []
    (only,) = sentences(sound, without=("detectable",))
    assert only == "No element differs clearly from the others (estimates differ by up to 1 %)."
    both = describe_comparison(found, frozenset({3, 5}))
    assert both[1] == "The loss may also be in the adjacent element 3 or 5."
    every = describe_comparison(sound, frozenset(range(1, 8)))
    assert every == ["No single element is resolved (standard deviation above 25 %)."]


def test_the_range_of_detectable_losses_names_the_elements_it_holds_for() -> None:
    now = estimate(np.ones(5))
    spread = np.exp(1.96 * np.array([0.2, 0.03, 0.02, 0.03, 0.1]))
    wide = now._replace(low=now.mean / spread, high=now.mean * spread)
    then = estimate(np.ones(5), relative=0.01)
    found = compare(wide, NOMINAL[:5], np.linspace(0.0, 30.0, 6), then)
    by_hand = [1.0 - 0.9 * np.exp(-(1.96 + 1.645) * np.hypot(of, 0.01)) for of in (0.02, 0.2)]
    low, high = (int(np.ceil(100.0 * one)) for one in by_hand)
    sentence = (
        f"The smallest loss that is detected with 95 % probability ranges from {low} % (element 3) "
        f"to {high} % (element 1)."
    )
    assert sentences(found)[-1] == sentence
    assert describe_comparison(found, frozenset({1}))[-1].endswith("(element 5).")
