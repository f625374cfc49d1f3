"""Results: the JSON of the contract, and the same through Protocol Buffers."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.errors import InputError
from schemas.fusion import AxleFootprint, Bends, Coordinate, FusionLikelihood, ShortWaves, Stretch
from schemas.proto import driveby_pb2 as pb
from schemas.reasons import REASON_TEXTS, Reason, texts
from schemas.results import (
    BridgeResult,
    Covariance,
    CrossingResult,
    Derived,
    Parameter,
    Prior,
    ResultHeader,
    Results,
    RoadResult,
    load_results,
    results,
    results_json,
)
from schemas.results_on_the_wire import (
    bridge_to_protobuf,
    crossing_to_protobuf,
    estimate_to_crossing,
    state_to_bridge,
)

HEADER = ResultHeader("0.1.0", 1790010003.25, "0123456789abcdef", {"method": "pre", "draws": 10}, 7)

numbers = st.floats(allow_nan=False, allow_infinity=False)
names = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), min_size=1, max_size=12)
# What a float holds of a time since 1970 is a quarter of a microsecond; microseconds come back.
times = st.integers(10**15, 4 * 10**15).map(lambda us: us / 1e6)
priors = st.builds(
    Prior,
    distribution=st.sampled_from(["normal", "log_normal"]),
    location=numbers,
    scale=numbers,
    probability_zero=st.none() | st.floats(0.0, 1.0),
)
parameters = st.builds(
    Parameter,
    unit=names,
    mean=numbers,
    std=numbers,
    q025=numbers,
    q50=numbers,
    q975=numbers,
    prior=st.none() | priors,
)


@st.composite
def roads(draw: st.DrawFn) -> RoadResult:
    size = draw(st.integers(1, 4))
    profile = st.lists(numbers, min_size=size, max_size=size).map(tuple)
    return RoadResult(
        x_m=draw(profile),
        front_m=draw(profile),
        rear_m=draw(profile),
        mean_m=draw(profile),
        std_m=draw(st.none() | profile),
        iri_m_per_km=draw(st.none() | numbers),
        iso_class=draw(st.none() | st.sampled_from("ABCDE")),
    )


@st.composite
def covariances(draw: st.DrawFn) -> Covariance:
    size = draw(st.integers(1, 4))
    row = st.lists(numbers, min_size=size, max_size=size).map(tuple)
    rows = draw(st.lists(row, min_size=size, max_size=size))
    return Covariance(names=tuple(f"p{i}" for i in range(size)), matrix=tuple(rows))


@st.composite
def crossings(draw: st.DrawFn) -> CrossingResult:
    verdict = draw(st.sampled_from(["good", "suspect", "rejected"]))
    reasons = draw(st.lists(st.sampled_from(Reason), min_size=verdict != "good", unique=True))
    estimated = draw(st.dictionaries(names, parameters, min_size=1, max_size=3))
    values: dict[str, Any] = {
        "crossing_id": draw(names),
        "realm": "live",
        "vehicle": "truck-1",
        "bridge": "bridge-1",
        "direction": draw(st.sampled_from(["start_to_end", "end_to_start"])),
        "entry_time": draw(times),
        "exit_time": draw(times),
        "speed_m_per_s": draw(numbers),
        "method": draw(st.sampled_from(["pre", "least_squares", "random_walk"])),
        "certificate": draw(st.none() | names),
        "verdict": verdict,
        "reasons": tuple(reasons),
        "chi2_per_dof": draw(st.none() | numbers),
        "diagnostics": draw(st.dictionaries(names, numbers, max_size=3)),
        "parameters": None if verdict == "rejected" else estimated,
        "scale_error": draw(st.none() | numbers),
        "covariance": draw(st.none() | covariances()),
        "derived": draw(
            st.none()
            | st.builds(
                Derived,
                f1_hz=parameters,
                max_deflection_m=parameters,
                probability_below_90_percent_of_baseline=st.none()
                | st.dictionaries(names, numbers, min_size=1, max_size=2),
            )
        ),
        "road": draw(st.none() | roads()),
        "fusion_likelihood": draw(st.none() | likelihoods()),
        "element_edges_m": draw(st.none() | st.just((0.0, 4.0, 9.0))),
        "nominal_ei_nm2": draw(st.none() | st.just((1e10, 2e10))),
    }
    return CrossingResult(**values)


@st.composite
def likelihoods(draw: st.DrawFn) -> FusionLikelihood:
    sizes = st.floats(1e-9, 1e9)
    coordinate = st.builds(
        Coordinate,
        name=names,
        location=numbers,
        scale=sizes,
        is_log=st.booleans(),
        absence=st.floats(0.0, 1.0),
    )
    bridge = draw(st.lists(coordinate, min_size=1, max_size=3))
    truck = draw(st.lists(coordinate, max_size=2))
    knots = draw(st.integers(0, 2))
    count = draw(st.integers(0, 2)) if knots else 0
    m = len(bridge) + len(truck) + knots + (1 + count if knots else 0)
    moves = len(bridge) + 1
    axle = AxleFootprint(width_m=0.25, twin_distance_m=0.0, length_m=0.2, track_m=1.9, offset_m=0.0)

    def some(count: int) -> tuple[float, ...]:
        return tuple(draw(st.lists(numbers, min_size=count, max_size=count)))

    return FusionLikelihood(
        bridge=tuple(bridge),
        truck=tuple(truck),
        root=some(m * (m + 1) // 2),
        target=some(m),
        element_lengths_m=some(1),
        mass_spread=draw(st.floats(0.0, 1.0)),
        footprints=(axle, axle),
        first_knot_m=draw(numbers) if knots else None,
        knot_spacing_m=draw(sizes),
        level_m3=some(2),
        off_bridge_m=tuple(
            Stretch(begin_m=draw(numbers), step_m=draw(sizes), values=some(draw(st.integers(0, 3))))
            for _ in range(draw(st.integers(0, 2)))
        ),
        bends=Bends.model_validate(
            {
                "about": tuple(1.0 + abs(x) for x in some(len(bridge))),
                "shapes": some(count * moves * (moves + 1) // 2),
                "logarithms": draw(st.integers(0, len(bridge))),
                **draw(st.sampled_from([{"size": (0.5,) * moves}, {"directions": some(moves**2)}])),
            }
        )
        if knots
        else None,
        short_waves=ShortWaves(
            step_cycles_per_m=0.02, cosine=some(2 * len(bridge)), sine=some(2 * len(bridge))
        )
        if knots
        else None,
    )


def a_crossing(**changes: object) -> CrossingResult:
    value = Parameter(unit="N·m²", mean=1.5e10, std=1e8, q025=1.3e10, q50=1.5e10, q975=1.7e10)
    values: dict[str, Any] = {
        "crossing_id": "truck-1_bridge-1_1790010003",
        "realm": "live",
        "vehicle": "truck-1",
        "bridge": "bridge-1",
        "direction": "start_to_end",
        "entry_time": 1790010003.0,
        "exit_time": 1790010006.44,
        "speed_m_per_s": 10.0,
        "method": "least_squares",
        "verdict": "suspect",
        "reasons": ("no_noise_model",),
        "parameters": {"EI_1": value},
    }
    return CrossingResult(**{**values, **changes})


def a_bridge() -> BridgeResult:
    element = {"mean": 1.5e10, "std": 1e8, "q025": 1.3e10, "q975": 1.7e10}
    return BridgeResult.model_validate(
        {
            **{f"EI_{n}": element for n in (10, 9, 2, 1)},
            "between_crossing_std": 0.02,
            "between_crossing_std_q025": 0.0,
            "between_crossing_std_q975": 0.05,
            "verdict": "suspect",
            "reasons": ["crossings_disagree"],
            "finding": "No element stands out.",
            "weakest_element": "EI_9",
            "probability_of_loss": {"EI_1": {"10": 0.5, "20": 0.25, "30": 0.125}},
            "level": element,
            "thirds": dict.fromkeys(("left", "middle", "right"), element),
            "tracks": [
                {
                    "vehicle": "truck-1",
                    "direction": "end_to_start",
                    "common_share": 0.25,
                    "wander_m": 0.125,
                },
                {"vehicle": "truck-2", "direction": "start_to_end", "common_share": 0.0},
            ],
            "crossings_used": ["a"],
            "crossings_left_out": [{"crossing_id": "b", "reason": "rejected"}],
        }
    )


@given(crossings())
def test_a_crossing_survives_the_wire(crossing: CrossingResult) -> None:
    payload = crossing_to_protobuf(crossing, HEADER).SerializeToString(deterministic=True)
    assert estimate_to_crossing(pb.Estimate.FromString(payload)) == (crossing, HEADER)


@given(st.lists(crossings(), max_size=2))
def test_results_survive_the_file(found: list[CrossingResult]) -> None:
    content = results(HEADER, found, {"bridge-1": a_bridge()})
    text = results_json(content)
    assert Results.model_validate_json(text) == content
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} was written"))


def test_the_file_has_the_fields_of_the_contract() -> None:
    content = json.loads(results_json(results(HEADER, [a_crossing()], {"bridge-1": a_bridge()})))
    assert list(content) == [
        "program", "version", "created", "site_hash", "settings", "seed", "crossings", "bridges",
    ]  # fmt: skip
    assert content["program"] == "driveby"
    assert list(content["crossings"][0]) == [
        "crossing_id", "realm", "vehicle", "bridge", "direction", "entry_time", "exit_time",
        "speed_m_per_s", "method", "certificate", "verdict", "reasons", "reason_texts",
        "chi2_per_dof", "diagnostics", "parameters", "scale_error", "covariance", "derived", "road",
        "fusion_likelihood", "element_edges_m", "nominal_ei_nm2",
    ]  # fmt: skip
    assert list(content["crossings"][0]["parameters"]["EI_1"]) == [
        "unit", "mean", "std", "q025", "q50", "q975", "prior",
    ]  # fmt: skip
    assert content["crossings"][0]["reason_texts"] == [REASON_TEXTS[Reason.NO_NOISE_MODEL]]
    assert set(content["bridges"]["bridge-1"]) == {
        "EI_1", "EI_2", "EI_9", "EI_10",
        "between_crossing_std", "between_crossing_std_q025", "between_crossing_std_q975",
        "verdict", "reasons", "reason_texts", "finding", "weakest_element", "probability_of_loss",
        "level", "thirds", "tracks", "crossings_used", "crossings_left_out",
        "crossings_left_out_count", "element_edges_m", "nominal_ei_nm2",
    }  # fmt: skip


def test_elements_of_a_bridge_are_in_their_order_and_survive_the_wire() -> None:
    bridge = a_bridge()
    assert list(bridge.elements) == ["EI_1", "EI_2", "EI_9", "EI_10"]
    payload = bridge_to_protobuf("bridge-1", 5, bridge).SerializeToString()
    assert state_to_bridge(pb.BridgeState.FromString(payload)) == ("bridge-1", 5, bridge)
    with pytest.raises(ValidationError):
        BridgeResult.model_validate({"EI_0": {"mean": 1, "std": 1, "q025": 1, "q975": 1}})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused(value: float) -> None:
    with pytest.raises(ValidationError):
        a_crossing(chi2_per_dof=value)
    with pytest.raises(ValidationError):
        a_crossing(diagnostics={"r_hat": value})
    message = crossing_to_protobuf(a_crossing(), HEADER)
    message.parameters["EI_1"].std = value
    with pytest.raises(ValueError, match="EI_1"):
        estimate_to_crossing(message)


def test_a_rejected_crossing_has_reasons_and_no_numbers() -> None:
    rejected = a_crossing(verdict="rejected", reasons=("channel_missing",), parameters=None)
    assert rejected.reason_texts == (REASON_TEXTS[Reason.CHANNEL_MISSING],)
    with pytest.raises(ValidationError, match="no parameters"):
        a_crossing(verdict="rejected")
    with pytest.raises(ValidationError, match="no parameters"):
        a_crossing(parameters=None)
    with pytest.raises(ValidationError, match="at least one reason"):
        a_crossing(verdict="rejected", reasons=(), parameters=None)
    with pytest.raises(ValidationError):
        a_crossing(reasons=("bad_weather",), reason_texts=("It rained.",))


def test_malformed_messages_are_refused_with_one_line() -> None:
    message = crossing_to_protobuf(a_crossing(), HEADER)
    for change, words in (
        ({"schema_version": 99}, "schema version 99"),
        ({"direction": pb.DIRECTION_UNSPECIFIED}, "direction"),
        ({"verdict": pb.VERDICT_UNSPECIFIED}, "verdict"),
        ({"settings_json": "{"}, "settings"),
        ({"method": "guess"}, "method"),
    ):
        wrong = pb.Estimate()
        wrong.CopyFrom(message)
        for name, value in change.items():
            setattr(wrong, name, value)
        with pytest.raises(ValueError, match=words) as caught:
            estimate_to_crossing(wrong)
        assert len(str(caught.value).splitlines()) == 1


def test_matrix_and_profiles_must_have_the_right_size() -> None:
    with pytest.raises(ValidationError, match="2 × 2"):
        Covariance(names=("a", "b"), matrix=((1.0, 2.0),))
    with pytest.raises(ValidationError, match="as long as x_m"):
        RoadResult(x_m=(0, 1), front_m=(0, 1), rear_m=(0,), mean_m=(0, 1))


def test_reading_a_file_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    with pytest.raises(InputError, match=r"out\.json: no such file"):
        load_results(path)
    path.write_text("{")
    with pytest.raises(InputError, match=r"out\.json: not a results file"):
        load_results(path)
    path.write_text(results_json(results(HEADER, [], {})).replace("seed", "sed"))
    with pytest.raises(InputError, match=r"out\.json: "):
        load_results(path)
    path.write_text(results_json(results(HEADER, [a_crossing()], {})))
    assert load_results(path).crossings == (a_crossing(),)


def test_every_reason_has_a_sentence_of_its_own() -> None:
    assert set(REASON_TEXTS) == set(Reason)
    assert len(set(REASON_TEXTS.values())) == len(Reason)
    for reason in Reason:
        assert reason.value == reason.name.lower()
        assert REASON_TEXTS[reason].endswith(".")
    assert texts([Reason.FAILED]) == [REASON_TEXTS[Reason.FAILED]]


def test_a_result_with_a_reason_of_before_is_read_without_it() -> None:
    now = a_crossing()
    message = crossing_to_protobuf(now, HEADER)
    message.reasons.append("tyre_damping_ignored")
    message.reason_texts.append("The site file gives the tyres a damping.")
    assert estimate_to_crossing(message) == (now, HEADER)
