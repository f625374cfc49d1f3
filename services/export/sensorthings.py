"""Results as entities of OGC SensorThings API 1.1 (18-088), part 1: sensing.

A bridge is a Thing at its Location, an element a FeatureOfInterest. Each element has two
Datastreams, of single crossings and of the fused state; a rejected crossing gives no Observation.
Entities refer to each other by `@iot.id`.
"""

import json
from collections.abc import Iterator
from itertools import accumulate, pairwise
from typing import Any, Final

from schemas.results import ElementState, Parameter, Results
from schemas.site import Bridge, Site
from services.export.geojson import geometry_of, utc

Entity = dict[str, Any]

_GEOJSON: Final = "application/geo+json"
_MEASUREMENT: Final = "http://www.opengis.net/def/observationType/OGC-OM/2.0/OM_Measurement"
_UNIT: Final = {
    "name": "newton square metre",
    "symbol": "N·m²",
    "definition": "https://ucum.org/ucum",  # N.m2 there
}
_PROPERTY: Final = {
    "@iot.id": "flexural-rigidity",
    "name": "flexural rigidity",
    "definition": "https://en.wikipedia.org/wiki/Flexural_rigidity",
    "description": "EI of a part of a bridge, along the line of a truck that drove over it",
}
_SINGLE, _FUSED = "crossing", "bridge"
_HOW = {_SINGLE: "each crossing alone", _FUSED: "all crossings together"}


def sensorthings(site: Site, results: Results) -> str:
    """Return all entities of the crossed bridges, as sets by the names of the standard."""
    crossed = {crossing.bridge for crossing in results.crossings}
    bridges = [bridge for bridge in site.bridges if bridge.id in crossed]
    sets: dict[str, list[Entity]] = {
        "Things": [_thing(bridge) for bridge in bridges],
        "Locations": [_location(bridge) for bridge in bridges],
        "Sensors": [_sensor(results)],
        "ObservedProperties": [_PROPERTY],
        "FeaturesOfInterest": [f for bridge in bridges for f in _features(bridge)],
        "Datastreams": [d for bridge in bridges for d in _datastreams(bridge)],
        "Observations": [o for bridge in bridges for o in _observations(bridge, results)],
    }
    return json.dumps(sets, indent=1, ensure_ascii=False) + "\n"


def _thing(bridge: Bridge) -> Entity:
    return {
        "@iot.id": bridge.id,
        "name": bridge.owner_id or bridge.id,
        "description": f"bridge of {bridge.span_m:g} m with {bridge.elements} elements",
        "Locations": [{"@iot.id": bridge.id}],
    }


def _location(bridge: Bridge) -> Entity:
    return {
        "@iot.id": bridge.id,
        "name": f"{bridge.owner_id or bridge.id}, between its outer bearings",
        "description": "from the bridge's start to its end, WGS 84",
        "encodingType": _GEOJSON,
        "location": geometry_of(bridge, 0.0, bridge.span_m),
    }


def _sensor(results: Results) -> Entity:
    return {
        "@iot.id": "driveby",
        "name": f"{results.program} {results.version}",
        "description": "accelerations and positions of a truck that crosses the bridge",
        "encodingType": "text/html",
        "metadata": "https://doi.org/10.3390/app13053049",
    }


def _features(bridge: Bridge) -> Iterator[Entity]:
    ends = pairwise(accumulate(bridge.lengths_m, initial=0.0))
    for number, (begin_m, end_m) in enumerate(ends, start=1):
        yield {
            "@iot.id": _element(bridge, number),
            "name": f"{bridge.id}, element {number}",
            "description": f"{begin_m:.2f} to {end_m:.2f} m from the bridge's start",
            "encodingType": _GEOJSON,
            "feature": geometry_of(bridge, begin_m, end_m),
        }


def _datastreams(bridge: Bridge) -> Iterator[Entity]:
    for number in range(1, bridge.elements + 1):
        for kind, how in _HOW.items():
            yield {
                "@iot.id": f"{_element(bridge, number)}.{kind}",
                "name": f"EI of element {number}, {how}",
                "description": "mean of the posterior; std and 95 % interval are in parameters",
                "observationType": _MEASUREMENT,
                "unitOfMeasurement": _UNIT,
                "Thing": {"@iot.id": bridge.id},
                "Sensor": {"@iot.id": "driveby"},
                "ObservedProperty": {"@iot.id": _PROPERTY["@iot.id"]},
            }


def _observations(bridge: Bridge, results: Results) -> Iterator[Entity]:
    of = {c.crossing_id: c for c in results.crossings if c.bridge == bridge.id}
    made = utc(results.created)
    for crossing in of.values():
        period = f"{utc(crossing.entry_time)}/{utc(crossing.exit_time)}"
        about = {"crossing": crossing.crossing_id, "verdict": crossing.verdict}
        for number in range(1, bridge.elements + 1):
            value = (crossing.parameters or {}).get(f"EI_{number}")
            if value is not None:
                yield _observation(bridge, number, _SINGLE, value, period, made, about)
    state = results.bridges.get(bridge.id)
    used = [] if state is None else [of[name] for name in state.crossings_used if name in of]
    if state is None or not used:
        return
    first, last = min(c.entry_time for c in used), max(c.exit_time for c in used)
    judged = {"crossings_used": len(state.crossings_used), "verdict": state.verdict}
    period = f"{utc(first)}/{utc(last)}"
    for number, element in enumerate(state.elements.values(), start=1):
        yield _observation(bridge, number, _FUSED, element, period, made, judged)


def _observation(
    bridge: Bridge,
    number: int,
    kind: str,
    value: Parameter | ElementState,
    period: str,
    made: str,
    about: Entity,
) -> Entity:
    name = _element(bridge, number)
    return {
        "@iot.id": f"{name}.{about.get('crossing', kind)}",
        "phenomenonTime": period,
        "resultTime": made,
        "result": value.mean,
        "parameters": {"std": value.std, "q025": value.q025, "q975": value.q975, **about},
        "Datastream": {"@iot.id": f"{name}.{kind}"},
        "FeatureOfInterest": {"@iot.id": name},
    }


def _element(bridge: Bridge, number: int) -> str:
    return f"{bridge.id}.EI_{number}"
