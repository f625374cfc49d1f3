"""Results as tables: crossings, elements, parameters, roads, and the state of each bridge."""

from collections.abc import Iterable, Iterator
from itertools import accumulate
from typing import Any

from schemas.reasons import Reason
from schemas.results import CrossingResult, Parameter, Results
from schemas.site import Bridge, Site
from services.export.tables import NamedTable

_STATISTICS = ("mean", "std", "q025", "q50", "q975")


def tables_of_results(results: Results, site: Site | None) -> list[NamedTable]:
    """Return all tables of results; without a site, chainages and nominal values are empty."""
    bridges = {} if site is None else {bridge.id: bridge for bridge in site.bridges}
    crossings = results.crossings
    return [
        _table("crossings", _CROSSING, map(_crossing, crossings)),
        _table("elements", _ELEMENT, (r for c in crossings for r in _elements(c, bridges))),
        _table("parameters", _PARAMETER, (r for c in crossings for r in _parameters(c))),
        _table("roads", _ROAD, (r for c in crossings for r in _road(c))),
        _table("bridges", _BRIDGE, _bridges(results, bridges)),
    ]


def element_bounds_m(
    bridge: Bridge | None, elements: int
) -> list[tuple[float | None, float | None]]:
    """Return begin and end of each element, m from the bridge's start."""
    if bridge is None:
        return [(None, None)] * elements
    ends = list(accumulate(bridge.lengths_m))
    return list(zip([0.0, *ends[:-1]], ends, strict=True))


_CROSSING = (
    "crossing", "bridge", "vehicle", "realm", "direction", "entry_ns", "exit_ns", "speed_m_per_s",
    "method", "verdict", "reasons", "chi2_per_dof", "scale_error", "iri_m_per_km", "iso_class",
)  # fmt: skip
_ELEMENT = (
    "crossing", "bridge", "verdict", "element", "from_m", "to_m", "ei_mean_nm2", "ei_std_nm2",
    "ei_q025_nm2", "ei_q50_nm2", "ei_q975_nm2", "nominal_nm2", "ratio",
)  # fmt: skip
_PARAMETER = ("crossing", "bridge", "verdict", "name", "unit", *_STATISTICS)
_ROAD = ("crossing", "x_m", "front_m", "rear_m", "mean_m", "std_m")
_BRIDGE = (
    "bridge", "element", "from_m", "to_m", "ei_mean_nm2", "ei_std_nm2", "ei_q025_nm2",
    "ei_q975_nm2", "nominal_nm2", "ratio", "crossings_used",
)  # fmt: skip


def _table(name: str, columns: Iterable[str], rows: Iterable[dict[str, Any]]) -> NamedTable:
    table: dict[str, list[Any]] = {column: [] for column in columns}
    for row in rows:
        for column, cells in table.items():
            cells.append(row.get(column))
    return NamedTable(name, dict(table))


def _identity_columns(crossing: CrossingResult) -> dict[str, Any]:
    return {
        "crossing": crossing.crossing_id,
        "bridge": crossing.bridge,
        "verdict": crossing.verdict,
    }


def _crossing(crossing: CrossingResult) -> dict[str, Any]:
    same = ("vehicle", "realm", "direction", "speed_m_per_s", "method", "chi2_per_dof")
    road = crossing.road
    return (
        _identity_columns(crossing)
        | {name: getattr(crossing, name) for name in (*same, "scale_error")}
        | {
            "entry_ns": _ns(crossing.entry_time),
            "exit_ns": _ns(crossing.exit_time),
            "reasons": " ".join(crossing.reasons),
            "iri_m_per_km": None if road is None else road.iri_m_per_km,
            "iso_class": None if road is None else road.iso_class,
        }
    )


def _ns(seconds: float) -> int:
    # Seconds since 1970 carry a quarter of a microsecond.
    return round(seconds * 1e6) * 1000


def _statistics(crossing: CrossingResult, found: Parameter) -> dict[str, float]:
    """Return the statistics; without a noise model the interval is left out as meaningless."""
    names = _STATISTICS if Reason.NO_NOISE_MODEL not in crossing.reasons else ("mean",)
    return {name: getattr(found, name) for name in names}


def _elements(crossing: CrossingResult, bridges: dict[str, Bridge]) -> Iterator[dict[str, Any]]:
    bridge = bridges.get(crossing.bridge)
    found = [(n, p) for n, p in (crossing.parameters or {}).items() if n.startswith("EI_")]
    for number, (name, parameter) in enumerate(sorted(found, key=lambda one: int(one[0][3:]))):
        values = _statistics(crossing, parameter)
        yield (
            _identity_columns(crossing)
            | {f"ei_{key}_nm2": value for key, value in values.items()}
            | _place(bridge, number, len(found), name, parameter.mean)
        )


def _place(
    bridge: Bridge | None, number: int, elements: int, name: str, mean: float
) -> dict[str, Any]:
    begin_m, end_m = element_bounds_m(bridge, elements)[number]
    nominal = None if bridge is None else bridge.nominal_flexural_rigidity_nm2[number]
    return {
        "element": name,
        "from_m": begin_m,
        "to_m": end_m,
        "nominal_nm2": nominal,
        "ratio": None if nominal is None else mean / nominal,
    }


def _parameters(crossing: CrossingResult) -> Iterator[dict[str, Any]]:
    for name, parameter in (crossing.parameters or {}).items():
        values = _statistics(crossing, parameter)
        yield _identity_columns(crossing) | {"name": name, "unit": parameter.unit} | values


def _road(crossing: CrossingResult) -> Iterator[dict[str, Any]]:
    road = crossing.road
    if road is None:
        return
    std = road.std_m or (None,) * len(road.x_m)
    rows = zip(road.x_m, road.front_m, road.rear_m, road.mean_m, std, strict=True)
    for row in rows:
        yield {"crossing": crossing.crossing_id} | dict(zip(_ROAD[1:], row, strict=True))


def _bridges(results: Results, bridges: dict[str, Bridge]) -> Iterator[dict[str, Any]]:
    for identifier, state in results.bridges.items():
        found = state.elements
        for number, (name, element) in enumerate(found.items()):
            yield {
                "bridge": identifier,
                "ei_mean_nm2": element.mean,
                "ei_std_nm2": element.std,
                "ei_q025_nm2": element.q025,
                "ei_q975_nm2": element.q975,
                "crossings_used": " ".join(state.crossings_used),
            } | _place(bridges.get(identifier), number, len(found), name, element.mean)
