"""Elements and crossings as GeoJSON (RFC 7946), for maps: lines in WGS 84, longitude first."""

import json
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Any

from schemas.results import CrossingResult, Results
from schemas.site import Bridge, Site
from services.common.geodesy import bridge_frame, to_lat_lon
from services.export.result_tables import element_bounds_m
from services.finding.bridges import DetectedCrossing

_DECIMALS = 9
"""Decimal places of coordinates in degrees: a tenth of a millimetre."""


def elements_geojson(site: Site, results: Results | None) -> str:
    """Return a line for each element of each bridge, with the bridge's latest state if any."""
    return _collection(f for bridge in site.bridges for f in _elements(bridge, results))


def crossings_geojson(
    site: Site, crossings: Iterable[CrossingResult], detected: Iterable[DetectedCrossing]
) -> str:
    """Return a line for each crossing, in the direction of travel.

    `crossings` have a result; those `detected` in positions only have none.
    """
    bridges = {bridge.id: bridge for bridge in site.bridges}
    return _collection(
        [
            *(_crossing(bridges[crossing.bridge], crossing) for crossing in crossings),
            *(_detected(bridges[passing.bridge], passing) for passing in detected),
        ]
    )


def _collection(features: Iterable[dict[str, Any]]) -> str:
    collection = {"type": "FeatureCollection", "features": list(features)}
    return json.dumps(collection, indent=1, ensure_ascii=False) + "\n"


def _line(
    bridge: Bridge, begin_m: float, end_m: float, properties: dict[str, Any]
) -> dict[str, Any]:
    geometry = geometry_of(bridge, begin_m, end_m)
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def geometry_of(bridge: Bridge, begin_m: float, end_m: float) -> dict[str, Any]:
    """Return a line along a bridge, between two chainages."""
    latitude, longitude = to_lat_lon(bridge_frame(bridge), [begin_m, end_m])
    places = zip(longitude.tolist(), latitude.tolist(), strict=True)
    coordinates = [[round(lon, _DECIMALS), round(lat, _DECIMALS)] for lon, lat in places]
    return {"type": "LineString", "coordinates": coordinates}


def _elements(bridge: Bridge, results: Results | None) -> Iterator[dict[str, Any]]:
    state = None if results is None else results.bridges.get(bridge.id)
    found = {} if state is None else state.elements
    for number, (begin_m, end_m) in enumerate(element_bounds_m(bridge, bridge.elements), start=1):
        assert begin_m is not None  # noqa: S101 - the bridge is known
        assert end_m is not None  # noqa: S101
        name = f"EI_{number}"
        nominal = bridge.nominal_flexural_rigidity_nm2[number - 1]
        element = found.get(name)
        properties: dict[str, Any] = {
            "bridge": bridge.id,
            "owner_id": bridge.owner_id,
            "element": name,
            "from_m": begin_m,
            "to_m": end_m,
            "nominal_nm2": nominal,
            "ei_mean_nm2": None if element is None else element.mean,
            "ei_q025_nm2": None if element is None else element.q025,
            "ei_q975_nm2": None if element is None else element.q975,
            "ratio": None if element is None else element.mean / nominal,
            "crossings_used": [] if state is None else list(state.crossings_used),
        }
        yield _line(bridge, begin_m, end_m, properties)


def _crossing(bridge: Bridge, crossing: CrossingResult) -> dict[str, Any]:
    names = ("vehicle", "bridge", "direction", "speed_m_per_s", "method", "verdict", "chi2_per_dof")
    properties = {
        "crossing": crossing.crossing_id,
        "entry_time": utc(crossing.entry_time),
        "exit_time": utc(crossing.exit_time),
        "reasons": [reason.value for reason in crossing.reasons],
    } | {name: getattr(crossing, name) for name in names}
    return _along(bridge, properties, forward=crossing.direction == "start_to_end")


def _detected(bridge: Bridge, passing: DetectedCrossing) -> dict[str, Any]:
    properties = {
        "crossing": None,
        "entry_time": utc(passing.entry_ns * 1e-9),
        "exit_time": utc(passing.exit_ns * 1e-9),
        "vehicle": passing.vehicle,
        "bridge": passing.bridge,
        "direction": "start_to_end" if passing.forward else "end_to_start",
        "verdict": None,
    }
    return _along(bridge, properties, forward=passing.forward)


def _along(bridge: Bridge, properties: dict[str, Any], *, forward: bool) -> dict[str, Any]:
    ends = (0.0, bridge.span_m) if forward else (bridge.span_m, 0.0)
    return _line(bridge, *ends, properties)


def utc(seconds: float) -> str:
    """Return a Unix time in the format of RFC 3339."""
    moment = datetime.fromtimestamp(seconds, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
