"""Conversion of `schemas.results` to and from protobuf messages.

Most fields have one name in both (`message_fields`); this module converts the others. Times are
seconds since 1970 UTC in results and nanoseconds in messages.
"""

import json
import math
from typing import Any

from pydantic import JsonValue, ValidationError

from schemas.message_fields import fill_fields, read_fields
from schemas.proto import driveby_pb2 as pb
from schemas.results import (
    LOSSES_PERCENT,
    SCHEMA_VERSION,
    BridgeResult,
    CrossingResult,
    Direction,
    ResultHeader,
    Thirds,
)
from schemas.signals import NS_PER_S

_THIRDS = tuple(Thirds.model_fields)
_ELEMENTS = ("element_edges_m", "nominal_ei_nm2")
_LOSSES = tuple(zip(("ten", "twenty", "thirty"), map(str, LOSSES_PERCENT), strict=True))
"""Field of each loss on the wire, and its percentage."""


def crossing_to_protobuf(crossing: CrossingResult, header: ResultHeader) -> pb.Estimate:
    """Return the Estimate message of one crossing."""
    values = crossing.model_dump()
    message = pb.Estimate(
        schema_version=SCHEMA_VERSION,
        program=header.program,
        version=header.version,
        created_ns=_nanoseconds(header.created),
        site_hash=header.site_hash,
        settings_json=json.dumps(header.settings, sort_keys=True, separators=(",", ":")),
        seed=header.seed,
        entry_time_ns=_nanoseconds(values.pop("entry_time")),
        exit_time_ns=_nanoseconds(values.pop("exit_time")),
    )
    covariance, mismatch = values["covariance"], (values["road"] or {}).get("mismatch")
    if covariance is not None:
        covariance["matrix"] = [value for row in covariance["matrix"] for value in row]
    if mismatch is not None:
        mismatch["a_m3"] = mismatch.pop("A_m3")
    fill_fields(message, values)
    return message


def estimate_to_crossing(message: pb.Estimate) -> tuple[CrossingResult, ResultHeader]:
    """Return the crossing and header of a message; raise ValueError if it is malformed."""
    if message.schema_version != SCHEMA_VERSION:
        raise ValueError(f"Estimate has schema version {message.schema_version}, not 1")
    values = read_fields(message)
    del values["schema_version"]
    try:
        header = ResultHeader(
            version=values.pop("version"),
            created=_seconds(values.pop("created_ns")),
            site_hash=values.pop("site_hash"),
            settings=_settings(values.pop("settings_json")),
            seed=values.pop("seed"),
            program=values.pop("program"),
        )
        return _crossing(values), header
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in problem["loc"])
        raise ValueError(f"Estimate: {place}: {problem['msg']}") from error


def bridge_to_protobuf(name: str, time_ns: int, bridge: BridgeResult) -> pb.BridgeState:
    """Return the BridgeState message of a fused estimate."""
    values = bridge.model_dump(exclude=set(bridge.elements))
    message = pb.BridgeState(schema_version=SCHEMA_VERSION, bridge=name, time_ns=time_ns)
    elements = {element: state.model_dump() for element, state in bridge.elements.items()}
    losses = {
        element: {name: of[percent] for name, percent in _LOSSES}
        for element, of in (values.pop("probability_of_loss") or {}).items()
    }
    thirds = values.pop("thirds") or {}
    own = {"flexural_rigidity_nm2": elements, "probability_of_loss": losses}
    fill_fields(message, values | thirds | own)
    return message


def state_to_bridge(message: pb.BridgeState) -> tuple[str, int, BridgeResult]:
    """Return bridge, time in ns and fused estimate of a message; raise ValueError if malformed."""
    if message.schema_version != SCHEMA_VERSION:
        raise ValueError(f"BridgeState has schema version {message.schema_version}, not 1")
    values = read_fields(message)
    bridge, time_ns = values.pop("bridge"), values.pop("time_ns")
    del values["schema_version"]
    thirds = {name: values.pop(name) for name in _THIRDS}
    losses = {
        element: {percent: of[name] for name, percent in _LOSSES}
        for element, of in values["probability_of_loss"].items()
    }
    _empty_is_none(values, "finding", "weakest_element", *_ELEMENTS)
    for track in values["tracks"]:
        _check_direction(track)
    values |= values.pop("flexural_rigidity_nm2")
    values |= {
        "probability_of_loss": losses or None,
        "thirds": None if thirds["left"] is None else thirds,
    }
    return bridge, time_ns, BridgeResult.model_validate(values)


def direction_to_protobuf(direction: Direction) -> pb.Direction:
    """Return the direction of travel as on the wire."""
    return pb.START_TO_END if direction == "start_to_end" else pb.END_TO_START


def _crossing(values: dict[str, Any]) -> CrossingResult:
    """Return the result of an Estimate's fields without those of the header."""
    _check_direction(values)
    _empty_is_none(values, "certificate", *_ELEMENTS)
    values["entry_time"] = _seconds(values.pop("entry_time_ns"))
    values["exit_time"] = _seconds(values.pop("exit_time_ns"))
    if values["verdict"] == "rejected":
        values["parameters"] = None
    covariance, derived, road = (values[name] for name in ("covariance", "derived", "road"))
    if covariance is not None:
        size, flat = max(len(covariance["names"]), 1), covariance["matrix"]
        covariance["matrix"] = [flat[i : i + size] for i in range(0, len(flat), size)]
    if derived is not None:
        _empty_is_none(derived, "probability_below_90_percent_of_baseline")
    if road is not None:
        _empty_is_none(road, "std_m", "iso_class")
        if road["mismatch"] is not None:
            road["mismatch"]["A_m3"] = road["mismatch"].pop("a_m3")
    return CrossingResult.model_validate(values)


def _check_direction(values: dict[str, Any]) -> None:
    if values["direction"] is None:
        raise ValueError("the direction of travel is not given")


def _empty_is_none(values: dict[str, Any], *names: str) -> None:
    """Replace empty texts, lists and maps, which cannot be absent on the wire, by None."""
    for name in names:
        values[name] = values[name] or None


def _settings(text: str) -> dict[str, JsonValue]:
    try:
        settings = json.loads(text)
    except ValueError as error:
        raise ValueError(f"Estimate: settings_json: {error}") from error
    if not isinstance(settings, dict):
        raise ValueError("Estimate: settings_json: an object is expected")
    return settings


def _seconds(nanoseconds: int) -> float:
    return nanoseconds / NS_PER_S  # division of integers rounds once, / 1e9 twice


def _nanoseconds(seconds: float) -> int:
    # Seconds since 1970 carry a quarter of a microsecond; whole microseconds come back unchanged.
    return math.floor(seconds * 1e6 + 0.5) * 1000
