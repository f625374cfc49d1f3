"""Results of identifications on the wire: `schemas.results` to and from protobuf messages.

Times are seconds since 1970 UTC there and nanoseconds here.
"""

import json
import math
from typing import Literal

from google.protobuf import json_format
from google.protobuf.message import Message
from pydantic import JsonValue, ValidationError

from schemas.proto import driveby_pb2 as pb
from schemas.results import (
    LOSSES_PERCENT,
    SCHEMA_VERSION,
    BridgeResult,
    Crossing,
    Direction,
    ElementState,
    Header,
    Parameter,
    Thirds,
)
from schemas.signals import NS_PER_S

_THIRDS = tuple(Thirds.model_fields)
_LOSSES = ("ten", "twenty", "thirty")


def crossing_to_protobuf(crossing: Crossing, header: Header) -> pb.Estimate:
    """Return the message on the wire for one crossing."""
    message = pb.Estimate(
        schema_version=SCHEMA_VERSION,
        program=header.program,
        version=header.version,
        created_ns=_nanoseconds(header.created),
        site_hash=header.site_hash,
        settings_json=json.dumps(header.settings, sort_keys=True, separators=(",", ":")),
        seed=header.seed,
        crossing_id=crossing.crossing_id,
        realm=crossing.realm,
        vehicle=crossing.vehicle,
        bridge=crossing.bridge,
        direction=direction_to_protobuf(crossing.direction),
        entry_time_ns=_nanoseconds(crossing.entry_time),
        exit_time_ns=_nanoseconds(crossing.exit_time),
        speed_m_per_s=crossing.speed_m_per_s,
        method=crossing.method,
        certificate=crossing.certificate or "",
        verdict=crossing.verdict.upper(),
        reasons=crossing.reasons,
        reason_texts=crossing.reason_texts,
        chi2_per_dof=crossing.chi2_per_dof,
        diagnostics=crossing.diagnostics,
        scale_error=crossing.scale_error,
    )
    for name, parameter in (crossing.parameters or {}).items():
        message.parameters[name].CopyFrom(_parameter_to_protobuf(parameter))
    if crossing.covariance is not None:
        message.covariance.names.extend(crossing.covariance.names)
        message.covariance.matrix.extend(v for row in crossing.covariance.matrix for v in row)
    if crossing.derived is not None:
        message.derived.f1_hz.CopyFrom(_parameter_to_protobuf(crossing.derived.f1_hz))
        message.derived.max_deflection_m.CopyFrom(
            _parameter_to_protobuf(crossing.derived.max_deflection_m)
        )
        for name in ("probability_sprung", "probability_giving"):
            ends = getattr(crossing.derived, name)
            if ends is not None:
                getattr(message.derived, name).start = ends.start
                getattr(message.derived, name).end = ends.end
        if crossing.derived.probability_torsion is not None:
            message.derived.probability_torsion = crossing.derived.probability_torsion
        if crossing.derived.springs_believed is not None:
            message.derived.springs_believed = crossing.derived.springs_believed
        level, thirds = crossing.derived.ei_level, crossing.derived.ei_thirds
        if level is not None:
            message.derived.ei_level.CopyFrom(_parameter_to_protobuf(level))
        for name in _THIRDS if thirds is not None else ():
            third = _parameter_to_protobuf(getattr(thirds, name))
            getattr(message.derived.ei_thirds, name).CopyFrom(third)
        message.derived.probability_below_90_percent_of_baseline.update(
            crossing.derived.probability_below_90_percent_of_baseline or {}
        )
    if crossing.road is not None:
        road = crossing.road
        message.road.CopyFrom(
            pb.RoadResult(
                x_m=road.x_m,
                front_m=road.front_m,
                rear_m=road.rear_m,
                mean_m=road.mean_m,
                std_m=road.std_m or (),
                iri_m_per_km=road.iri_m_per_km,
                iso_class=road.iso_class or "",
            )
        )
        if road.mismatch is not None:
            message.road.mismatch.CopyFrom(
                pb.RoadMismatch(
                    a_m3=road.mismatch.A_m3,
                    n_0_per_m=road.mismatch.n_0_per_m,
                    common_share=road.mismatch.common_share,
                )
            )
    if crossing.fusion_likelihood is not None:
        json_format.ParseDict(
            crossing.fusion_likelihood.model_dump(exclude_none=True), message.fusion_likelihood
        )
    return message


def estimate_to_crossing(message: pb.Estimate) -> tuple[Crossing, Header]:
    """Return the crossing and header of a message; ValueError with one line if it is malformed."""
    if message.schema_version != SCHEMA_VERSION:
        raise ValueError(f"Estimate has schema version {message.schema_version}, not 1")
    try:
        header = Header(
            version=message.version,
            created=_seconds(message.created_ns),
            site_hash=message.site_hash,
            settings=_settings(message.settings_json),
            seed=message.seed,
            program=message.program,
        )
        return _crossing(message), header
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in problem["loc"])
        raise ValueError(f"Estimate: {place}: {problem['msg']}") from error


def bridge_to_protobuf(name: str, time_ns: int, bridge: BridgeResult) -> pb.BridgeState:
    """Return the message on the wire for a fused estimate."""
    message = pb.BridgeState(
        schema_version=SCHEMA_VERSION,
        bridge=name,
        time_ns=time_ns,
        between_crossing_std=bridge.between_crossing_std,
        crossings_used=bridge.crossings_used,
        crossings_left_out=[pb.LeftOut(**out.model_dump()) for out in bridge.crossings_left_out],
        crossings_left_out_count=bridge.crossings_left_out_count,
        verdict=None if bridge.verdict is None else bridge.verdict.upper(),
        reasons=bridge.reasons,
        reason_texts=bridge.reason_texts,
        finding=bridge.finding or "",
        weakest_element=bridge.weakest_element or "",
        between_crossing_std_q025=bridge.between_crossing_std_q025,
        between_crossing_std_q975=bridge.between_crossing_std_q975,
    )
    for element, state in bridge.elements.items():
        message.flexural_rigidity_nm2[element].CopyFrom(_state_to_protobuf(state))
    for element, losses in (bridge.probability_of_loss or {}).items():
        values = (losses[str(percent)] for percent in LOSSES_PERCENT)
        of = dict(zip(_LOSSES, values, strict=True))
        message.probability_of_loss[element].CopyFrom(pb.Losses(**of))
    if bridge.level is not None:
        message.level.CopyFrom(_state_to_protobuf(bridge.level))
    for name in _THIRDS if bridge.thirds is not None else ():
        getattr(message, name).CopyFrom(_state_to_protobuf(getattr(bridge.thirds, name)))
    for track in bridge.tracks:
        direction = direction_to_protobuf(track.direction)
        message.tracks.add(**track.model_dump() | {"direction": direction})
    return message


def _state_to_protobuf(state: ElementState) -> pb.ElementState:
    return pb.ElementState(**state.model_dump())


def _state(message: pb.ElementState) -> dict[str, float]:
    return {
        "mean": message.mean,
        "std": message.std,
        "q025": message.q025,
        "q975": message.q975,
    }


def _or_none(message: Message, name: str) -> float | None:
    """A field that may be absent."""
    return getattr(message, name) if message.HasField(name) else None


def state_to_bridge(message: pb.BridgeState) -> tuple[str, int, BridgeResult]:
    """Return bridge, time in ns and fused estimate of a message; ValueError if it is malformed."""
    if message.schema_version != SCHEMA_VERSION:
        raise ValueError(f"BridgeState has schema version {message.schema_version}, not 1")
    elements = {name: _state(one) for name, one in message.flexural_rigidity_nm2.items()}
    losses = {
        element: {
            str(p): getattr(of, name) for p, name in zip(LOSSES_PERCENT, _LOSSES, strict=True)
        }
        for element, of in message.probability_of_loss.items()
    }
    values = {
        **elements,
        "between_crossing_std": _or_none(message, "between_crossing_std"),
        "between_crossing_std_q025": _or_none(message, "between_crossing_std_q025"),
        "between_crossing_std_q975": _or_none(message, "between_crossing_std_q975"),
        "verdict": pb.Verdict.Name(message.verdict).lower() if message.verdict else None,
        "reasons": tuple(message.reasons),
        "reason_texts": tuple(message.reason_texts),
        "finding": message.finding or None,
        "weakest_element": message.weakest_element or None,
        "probability_of_loss": losses or None,
        "level": _state(message.level) if message.HasField("level") else None,
        "thirds": (
            {name: _state(getattr(message, name)) for name in _THIRDS}
            if message.HasField("left")
            else None
        ),
        "tracks": [
            {
                "vehicle": track.vehicle,
                "direction": direction_from_protobuf(track.direction),
                "common_share": track.common_share,
                "wander_m": _or_none(track, "wander_m"),
            }
            for track in message.tracks
        ],
        "crossings_used": message.crossings_used,
        "crossings_left_out": [
            {"crossing_id": out.crossing_id, "reason": out.reason}
            for out in message.crossings_left_out
        ],
        "crossings_left_out_count": _or_none(message, "crossings_left_out_count"),
    }
    return message.bridge, message.time_ns, BridgeResult.model_validate(values)


def direction_to_protobuf(direction: Direction) -> pb.Direction:
    """Return the direction of travel as on the wire."""
    return pb.START_TO_END if direction == "start_to_end" else pb.END_TO_START


def direction_from_protobuf(direction: pb.Direction) -> Direction:
    """Return the direction of travel; ValueError if the message does not say it."""
    if direction == pb.START_TO_END:
        return "start_to_end"
    if direction == pb.END_TO_START:
        return "end_to_start"
    raise ValueError("the direction of travel is not given")


def _crossing(message: pb.Estimate) -> Crossing:
    rejected = message.verdict == pb.REJECTED
    values = {
        "crossing_id": message.crossing_id,
        "realm": message.realm,
        "vehicle": message.vehicle,
        "bridge": message.bridge,
        "direction": direction_from_protobuf(message.direction),
        "entry_time": _seconds(message.entry_time_ns),
        "exit_time": _seconds(message.exit_time_ns),
        "speed_m_per_s": message.speed_m_per_s,
        "method": message.method,
        "certificate": message.certificate or None,
        "verdict": pb.Verdict.Name(message.verdict).lower(),
        "reasons": tuple(message.reasons),
        "reason_texts": tuple(message.reason_texts),
        "chi2_per_dof": _or_none(message, "chi2_per_dof"),
        "diagnostics": dict(message.diagnostics),
        "parameters": (
            None if rejected else {n: _parameter(p) for n, p in message.parameters.items()}
        ),
        "scale_error": _or_none(message, "scale_error"),
        "covariance": _covariance(message.covariance) if message.HasField("covariance") else None,
        "derived": _derived(message.derived) if message.HasField("derived") else None,
        "road": _road(message.road) if message.HasField("road") else None,
        "fusion_likelihood": (
            _fields(message.fusion_likelihood) if message.HasField("fusion_likelihood") else None
        ),
    }
    return Crossing.model_validate(values)


def _fields(message: Message) -> dict[str, object]:
    """A message of which the fields are those of its model."""
    return json_format.MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )


def _settings(text: str) -> dict[str, JsonValue]:
    try:
        settings = json.loads(text)
    except ValueError as error:
        raise ValueError(f"Estimate: settings_json: {error}") from error
    if not isinstance(settings, dict):
        raise ValueError("Estimate: settings_json: an object is expected")
    return settings


def _parameter_to_protobuf(parameter: Parameter) -> pb.Parameter:
    prior = parameter.prior
    return pb.Parameter(
        unit=parameter.unit,
        mean=parameter.mean,
        std=parameter.std,
        q025=parameter.q025,
        q50=parameter.q50,
        q975=parameter.q975,
        prior=None if prior is None else pb.Prior(**prior.model_dump()),
    )


def _parameter(message: pb.Parameter) -> dict[str, object]:
    prior = message.prior
    return {
        "unit": message.unit,
        "mean": message.mean,
        "std": message.std,
        "q025": message.q025,
        "q50": message.q50,
        "q975": message.q975,
        "prior": (
            {"distribution": prior.distribution, "location": prior.location, "scale": prior.scale}
            if message.HasField("prior")
            else None
        ),
    }


def _covariance(message: pb.Covariance) -> dict[str, object]:
    size = max(len(message.names), 1)
    rows = [message.matrix[i : i + size] for i in range(0, len(message.matrix), size)]
    return {"names": tuple(message.names), "matrix": rows}


def _ends(
    message: pb.Derived, name: Literal["probability_sprung", "probability_giving"]
) -> dict[str, float] | None:
    if not message.HasField(name):
        return None
    ends: pb.AtEnds = getattr(message, name)
    return {"start": ends.start, "end": ends.end}


def _derived(message: pb.Derived) -> dict[str, object]:
    return {
        "f1_hz": _parameter(message.f1_hz),
        "max_deflection_m": _parameter(message.max_deflection_m),
        "probability_sprung": _ends(message, "probability_sprung"),
        "probability_giving": _ends(message, "probability_giving"),
        "probability_torsion": _or_none(message, "probability_torsion"),
        "springs_believed": _or_none(message, "springs_believed"),
        "ei_level": _parameter(message.ei_level) if message.HasField("ei_level") else None,
        "ei_thirds": (
            {name: _parameter(getattr(message.ei_thirds, name)) for name in _THIRDS}
            if message.HasField("ei_thirds")
            else None
        ),
        "probability_below_90_percent_of_baseline": (
            dict(message.probability_below_90_percent_of_baseline) or None
        ),
    }


def _road(message: pb.RoadResult) -> dict[str, object]:
    return {
        "x_m": tuple(message.x_m),
        "front_m": tuple(message.front_m),
        "rear_m": tuple(message.rear_m),
        "mean_m": tuple(message.mean_m),
        "std_m": tuple(message.std_m) or None,
        "iri_m_per_km": _or_none(message, "iri_m_per_km"),
        "iso_class": message.iso_class or None,
        "mismatch": _mismatch(message.mismatch) if message.HasField("mismatch") else None,
    }


def _mismatch(message: pb.RoadMismatch) -> dict[str, float | None]:
    return {
        "A_m3": message.a_m3,
        "n_0_per_m": message.n_0_per_m,
        "common_share": _or_none(message, "common_share"),
    }


def _seconds(nanoseconds: int) -> float:
    return nanoseconds / NS_PER_S  # of two integers: rounded once, where / 1e9 rounds twice


def _nanoseconds(seconds: float) -> int:
    # Seconds since 1970 carry a quarter of a microsecond; whole microseconds come back unchanged.
    return math.floor(seconds * 1e6 + 0.5) * 1000
