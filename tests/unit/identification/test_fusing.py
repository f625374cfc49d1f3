"""A bridge from results of many crossings: what is used, what is left out, and what is said."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas import fusion
from schemas.reasons import BridgeReason, LeftOutReason, Reason
from schemas.results import (
    BridgeResult,
    CrossingResult,
    ElementState,
    ResultHeader,
    load_results,
    results,
    results_json,
)
from services.cli.main import main
from services.identification.bridge_state import (
    NOTHING_STORED,
    BridgeStateCache,
    FusionSettings,
    RecentCrossings,
    add_crossings,
    state_of,
    usable,
    with_common_shares,
    with_loss_probability,
)
from services.identification.fusing import fused, fusion_input
from services.identification.usable import Source, source_of

NOMINAL = 1.6e10
ELEMENTS = 5
AXLE = fusion.AxleFootprint(
    width_m=0.25, twin_distance_m=0.0, length_m=0.2, track_m=1.9, offset_m=0.0
)


def likelihood(
    ratio: tuple[float, ...], seed: int, nominal: float = NOMINAL, std: float = 0.03
) -> fusion.FusionLikelihood:
    """Information of a crossing that estimates EI/nominal of every element to `std`."""
    rng = np.random.default_rng(seed)
    elements = [
        fusion.Coordinate(name=f"EI_{n}", location=nominal, scale=0.55, is_log=True)
        for n in range(1, len(ratio) + 1)
    ]
    spring = fusion.Coordinate(
        name="k_rot_start", location=0.0, scale=5e8, is_log=False, absence=0.5
    )
    gain = fusion.Coordinate(name="common_gain", location=1.0, scale=0.01, is_log=True)
    compliance = nominal / (NOMINAL * np.array(ratio))
    x = np.concatenate([[0.1], compliance, [0.0]])
    root = np.diag(np.concatenate([[2.0], 1.0 / (std * compliance), [0.1]]))
    return fusion.FusionLikelihood(
        bridge=(spring, *elements),
        truck=(gain,),
        root=tuple(root[np.triu_indices(x.size)]),
        target=tuple(root @ x + rng.standard_normal(x.size)),
        element_lengths_m=(6.0,) * len(ratio),
        mass_spread=0.01,
        footprints=(AXLE, AXLE),
        knot_spacing_m=1.25,
        level_m3=(0.0, 0.0),
    )


def test_moves_of_single_coordinates_are_directions_too() -> None:
    """Older results have a size of each coordinate."""
    plain = likelihood((1.0,) * ELEMENTS, 1)
    moves = ELEMENTS + 2
    size = tuple(np.linspace(0.1, 0.7, moves))
    m = len(plain.target) + 2
    terms = {"about": (0.0,) * (moves - 1), "shapes": (0.1,) * (moves * (moves + 1) // 2)}

    def directions(**given: tuple[float, ...]) -> NDArray[np.float64]:
        curved = plain.model_copy(
            update={
                "root": tuple(np.eye(m)[np.triu_indices(m)]),
                "target": (0.0,) * m,
                "bends": fusion.Bends.model_validate({**terms, **given}),
            }
        )
        part, _ = fusion_input(Source("one", "lorry", 1, curved))
        assert part.likelihood.bends is not None
        return part.likelihood.bends.directions

    of_all = np.diag(size) + 0.01
    assert np.array_equal(directions(size=size), np.diag(size))
    assert np.allclose(directions(directions=tuple(of_all.ravel())), of_all)


def crossing(
    number: int,
    ratio: tuple[float, ...] = (1.0, 1.0, 0.6, 1.0, 1.0),
    verdict: str = "good",
    nominal: float = NOMINAL,
) -> CrossingResult:
    of_all = {"unit": "N·m²", "std": 5e8, "q025": 1e9, "q975": 3e10}
    parameters = {
        f"EI_{n}": of_all | {"mean": r * NOMINAL, "q50": r * NOMINAL}
        for n, r in enumerate(ratio, start=1)
    }
    return CrossingResult.model_validate(
        {
            "crossing_id": f"truck-1.bridge-1.{number:03d}",
            "realm": "sim-x",
            "vehicle": "truck-1",
            "bridge": "bridge-1",
            "direction": "start_to_end",
            "entry_time": 1.8e9 + 600.0 * number,
            "exit_time": 1.8e9 + 600.0 * number + 4.0,
            "speed_m_per_s": 10.0,
            "method": "pre",
            "verdict": verdict,
            "reasons": () if verdict == "good" else (Reason.RESIDUALS_COLOURED,),
            "parameters": parameters,
            "derived": {
                name: {"unit": "1", "mean": 1.0, "std": 0.1, "q025": 0.8, "q50": 1.0, "q975": 1.2}
                for name in ("f1_hz", "max_deflection_m")
            },
            "fusion_likelihood": likelihood(ratio, number, nominal),
        }
    )


def state(crossings: list[CrossingResult], fusing: FusionSettings = NOTHING_STORED) -> BridgeResult:
    counted = add_crossings(
        RecentCrossings(), [one for one in map(usable, crossings) if one is not None]
    )
    found = state_of(counted, "bridge-1", fusing)
    assert found is not None
    return found


def test_many_crossings_are_one_estimate() -> None:
    crossings = [crossing(n) for n in range(8)]
    found = state(crossings)
    assert found.verdict == "good"
    assert found.weakest_element == "EI_3"
    assert found.crossings_used == tuple(one.crossing_id for one in crossings)
    assert found.elements["EI_3"].q025 < 0.6 * NOMINAL < found.elements["EI_3"].q975
    # Of one crossing 3 %; of eight a third of that, the mass' 1 % and what a bridge may change by.
    assert found.elements["EI_1"].std / NOMINAL < 0.025
    assert found.probability_of_loss is None
    assert found.finding is not None
    assert "Element 3 (12.0 to 18.0 m) is " in found.finding
    assert found.thirds is not None
    assert found.thirds.middle.mean < found.thirds.left.mean
    assert found == state(crossings[::-1])


def test_suspect_crossings_are_left_out_unless_asked_for() -> None:
    crossings = [crossing(0), crossing(1, (3.0,) * ELEMENTS, "suspect"), crossing(2)]
    found = state(crossings)
    assert found.crossings_used == (crossings[0].crossing_id, crossings[2].crossing_id)
    (left,) = found.crossings_left_out
    assert (left.crossing_id, left.reason) == (crossings[1].crossing_id, LeftOutReason.SUSPECT)
    assert found.crossings_left_out_count == 1
    every = [crossing(0), crossing(1, verdict="suspect")]
    found = state(every, NOTHING_STORED._replace(with_suspect=True))
    assert len(found.crossings_used) == 2
    assert (found.verdict, found.reasons) == ("suspect", (BridgeReason.USES_SUSPECT,))


def test_a_suspect_crossing_alone_is_no_state_of_a_bridge() -> None:
    found = state([crossing(0, verdict="suspect")])
    assert (found.verdict, found.reasons) == ("rejected", (BridgeReason.NO_GOOD_CROSSING,))
    assert not found.elements
    assert not found.crossings_used


def test_one_that_disagrees_is_named() -> None:
    crossings = [crossing(n) for n in range(9)]
    crossings.append(crossing(9, (1.0, 1.8, 0.6, 1.0, 1.0)))
    found = state(crossings)
    assert [one.reason for one in found.crossings_left_out] == [LeftOutReason.DISAGREES]
    assert found.verdict == "good"
    assert found.elements["EI_2"].mean == pytest.approx(NOMINAL, rel=0.05)
    two = state([crossing(0), crossing(1, (1.0, 1.8, 0.6, 1.0, 1.0))])
    assert (two.verdict, two.reasons) == ("suspect", (BridgeReason.CROSSINGS_DISAGREE,))


def test_newest_crossings_that_disagree_give_no_all_clear() -> None:
    """An element loses half before the last two of ten: fewer than a third are excluded."""
    sound, weak = (1.0,) * ELEMENTS, (1.0, 1.0, 0.5, 1.0, 1.0)
    crossings = [crossing(n, sound if n < 8 else weak) for n in range(10)]
    found = state(crossings)
    left = {one.crossing_id: one.reason for one in found.crossings_left_out}
    assert left == {one.crossing_id: LeftOutReason.DISAGREES for one in crossings[-2:]}
    assert (found.verdict, found.reasons) == ("suspect", (BridgeReason.NEWEST_DISAGREE,))
    assert "newest crossings disagree with the earlier ones" in found.reason_texts[0]
    assert "the bridge may have changed" in found.reason_texts[0]
    assert found.finding is not None
    assert "is detected with" not in found.finding
    assert "No element differs" not in found.finding


def test_two_earlier_crossings_that_disagree_are_doubtful() -> None:
    sound, wrong = (1.0,) * ELEMENTS, (1.0, 1.8, 0.6, 1.0, 1.0)
    found = state([crossing(n, wrong if n in (2, 5) else sound) for n in range(10)])
    assert len(found.crossings_left_out) == 2
    assert (found.verdict, found.reasons) == ("suspect", (BridgeReason.MANY_LEFT_OUT,))


def test_crossings_with_other_elements_are_left_out() -> None:
    found = state([crossing(0, (1.0,) * 4), crossing(1), crossing(2)])
    assert [one.reason for one in found.crossings_left_out] == [LeftOutReason.OTHER_MODEL]


def test_another_nominal_value_is_the_same_bridge() -> None:
    one = state([crossing(n) for n in range(6)])
    other = state([crossing(n, nominal=1.3 * NOMINAL if n < 5 else NOMINAL) for n in range(6)])
    for name in one.elements:
        assert other.elements[name].mean == pytest.approx(one.elements[name].mean, rel=0.03)


def test_probabilities_of_loss_are_against_a_baseline() -> None:
    before = state([crossing(n, (1.0,) * ELEMENTS) for n in range(6)])
    now = state([crossing(n) for n in range(10, 16)], FusionSettings({"bridge-1": before}))
    assert now.probability_of_loss is not None
    lost = now.probability_of_loss["EI_3"]
    assert lost["10"] == lost["20"] == lost["30"] == 1.0
    assert now.probability_of_loss["EI_1"]["10"] < 0.01
    assert now.finding is not None
    assert "than the baseline" in now.finding
    derived = with_loss_probability(crossing(20), before).derived
    assert derived is not None
    below = derived.probability_below_90_percent_of_baseline
    assert below is not None
    assert below["EI_3"] > 0.99
    assert below["EI_1"] < 0.05


def test_element_unresolved_in_the_baseline_gets_no_claim() -> None:
    """Its interval would make EI_2 a loss of 80 % and the weakest element."""
    before = state([crossing(n, (1.0,) * ELEMENTS) for n in range(6)])
    vague = ElementState(mean=5e10, std=2.5e10, q025=1.2e10, q975=1e11)
    before = before.model_copy(update={"EI_2": vague, "verdict": "suspect"})
    now = state([crossing(n) for n in range(10, 16)], FusionSettings({"bridge-1": before}))
    assert now.weakest_element == "EI_3"
    assert now.probability_of_loss is not None
    assert list(now.probability_of_loss) == ["EI_1", "EI_3", "EI_4", "EI_5"]
    assert now.finding is not None
    assert "Element 2 is not resolved in the baseline (standard deviation above" in now.finding
    assert "Element 2, 6.0" not in now.finding
    assert "The loss may also be in the adjacent element 2" in now.finding
    assert "The baseline is a suspect measurement" in now.finding
    derived = with_loss_probability(crossing(20), before).derived
    assert derived is not None
    below = derived.probability_below_90_percent_of_baseline
    assert below is not None
    assert "EI_2" not in below


def test_baseline_that_is_later_is_named() -> None:
    def dated(number: int, day: str) -> CrossingResult:
        name = f"truck-1.bridge-1.{day}T1{number}0000.000Z"
        return crossing(number).model_copy(update={"crossing_id": name})

    early = state([dated(n, "20260101") for n in range(2)])
    late = state([dated(n, "20270101") for n in range(2)])
    words = "later crossings (until 2027-01-01) than this measurement (until 2026-01-01)"
    for crossings, before, is_named in (("20260101", late, True), ("20270101", early, False)):
        fusing = FusionSettings({"bridge-1": before})
        found = state([dated(n, crossings) for n in range(2)], fusing)
        assert found.finding is not None
        assert (words in found.finding) is is_named
        assert "is a suspect measurement" not in found.finding


def test_other_methods_and_older_results_are_not_fused() -> None:
    old = [crossing(n).model_copy(update={"fusion_likelihood": None}) for n in range(3)]
    found = state(old)
    assert (found.verdict, found.reasons) == ("suspect", (BridgeReason.NOT_FUSED,))
    assert found.crossings_used == (old[2].crossing_id,)
    found = state([*old[:2], crossing(5)])
    assert [one.reason for one in found.crossings_left_out] == [LeftOutReason.NO_LIKELIHOOD] * 2


def test_a_state_is_made_anew_only_when_crossings_have_come() -> None:
    """A worker asks for all its bridges after every result."""
    states = BridgeStateCache(NOTHING_STORED)
    counted = add_crossings(
        RecentCrossings(), [one for one in map(usable, [crossing(0), crossing(1)]) if one]
    )
    first = states.of(counted, "bridge-1", "here")
    assert first == state_of(counted, "bridge-1")
    assert states.of(counted, "bridge-1", "here") is first
    third = usable(crossing(2))
    assert third is not None
    after = states.of(add_crossings(counted, [third]), "bridge-1", "here")
    assert after is not None
    assert len(after.crossings_used) == 3


def test_nothing_is_fused_from_nothing() -> None:
    assert state_of(RecentCrossings(), "bridge-1") is None
    with pytest.raises(ValueError, match="no crossings"):
        fused([])
    assert source_of(crossing(0).model_copy(update={"fusion_likelihood": None})) is None
    one = crossing(0)
    assert with_common_shares([one], {}) == [one]


HEADER = ResultHeader("1", 1.8e9, "hash", {"method": "pre"}, 1)


def write(path: Path, crossings: list[CrossingResult]) -> Path:
    path.write_text(results_json(results(HEADER, crossings, {})), encoding="utf-8")
    return path


@pytest.mark.parametrize(("before", "after"), [(2, 2), (4, 2), (4, 4)])
def test_crossings_of_two_states_have_no_common_one(
    before: int, after: int, tmp_path: Path
) -> None:
    """Their mean, which is neither state, was `good`: the variability between them took it."""
    lost = (1.0, 0.6, 0.6, 1.0, 1.0)
    crossings = [crossing(n) for n in range(before)]
    crossings += [crossing(before + n, lost) for n in range(after)]
    out = tmp_path / "out.json"
    assert main(["fuse", str(write(tmp_path / "all.json", crossings)), "--json", str(out)]) == 0
    state = load_results(out).bridges["bridge-1"]
    assert state.verdict == "suspect"
    assert set(state.reasons) & {
        BridgeReason.CROSSINGS_DISAGREE,
        BridgeReason.NEWEST_DISAGREE,
        BridgeReason.MANY_LEFT_OUT,
    }


def test_the_command_fuses_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = write(tmp_path / "one.json", [crossing(n) for n in range(3)])
    other = write(tmp_path / "other.json", [crossing(n) for n in range(2, 5)])
    out = tmp_path / "out.json"
    assert main(["fuse", str(one), str(other), "--json", str(out)]) == 0
    output = capsys.readouterr().out
    assert "bridge-1, 5 crossings fused" in output
    assert "measurement good" in output
    found = load_results(out)
    assert len(found.crossings) == 5
    assert len(found.bridges["bridge-1"].crossings_used) == 5
    assert main(["fuse", str(one), "--baseline", str(out)]) == 0
    assert "loss>10/20/30" in capsys.readouterr().out


def test_the_command_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = write(tmp_path / "empty.json", [])
    assert main(["fuse", str(empty)]) == 2
    assert "empty.json: holds no crossing; driveby identify --into" in capsys.readouterr().err
    rejected = crossing(0).model_copy(
        update={
            "verdict": "rejected",
            "reasons": (Reason.GAP_ON_BRIDGE,),
            "reason_texts": ("A gap.",),
            "parameters": None,
            "fusion_likelihood": None,
        }
    )
    assert main(["fuse", str(write(tmp_path / "rejected.json", [rejected]))]) == 2
    assert "no crossing that could be fused" in capsys.readouterr().err
    live = crossing(1).model_copy(update={"realm": "live"})
    both = write(tmp_path / "both.json", [crossing(0), live])
    assert main(["fuse", str(both)]) == 2
    assert "one realm at a time" in capsys.readouterr().err


def test_a_baseline_of_other_elements_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.json"
    three = write(tmp_path / "three.json", [crossing(0, (1.0, 1.0, 1.0))])
    assert main(["fuse", str(three), "--json", str(out)]) == 0
    five = write(tmp_path / "five.json", [crossing(0)])
    assert main(["fuse", str(five), "--baseline", str(out)]) == 2
    assert "out.json: bridge-1 has 3 elements there and 5 in the results" in capsys.readouterr().err
