"""Where on site an element is: the ends of a bridge by the points of the compass."""

from __future__ import annotations

from typing import NamedTuple

from schemas.site import Bridge
from services.common.geodesy import bridge_frame, heading_deg
from services.identification.comparison import Element

_COMPASS = (
    "north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west",
)  # fmt: skip


class Ends(NamedTuple):
    """The sides of a bridge at which it starts and ends: where chainage is 0, and the span."""

    start: str
    end: str


def ends_of(bridge: Bridge) -> Ends:
    """Seen from its middle, by the coordinates of the site file."""
    frame = bridge_frame(bridge)
    return Ends(*(_towards(heading_deg(frame, start_to_end=way)) for way in (False, True)))


def _towards(heading: float) -> str:
    return _COMPASS[round(heading / 45.0) % 8]


def start_of(bridge: Bridge) -> str:
    """The end from which all places are counted, in words and coordinates."""
    latitude, longitude = bridge.start_latitude_deg, bridge.start_longitude_deg
    north, east = "N" if latitude >= 0.0 else "S", "E" if longitude >= 0.0 else "W"
    return (
        f"the {ends_of(bridge).start} end ({abs(latitude):.5f}° {north}, "
        f"{abs(longitude):.5f}° {east})"
    )


def place_of(element: Element, bridge: Bridge) -> str:
    """How to find an element, from the start and, where that is nearer, from the end too."""
    ends = ends_of(bridge)
    said = f"{element.from_m:.1f} to {element.to_m:.1f} m from the {ends.start} end"
    if element.from_m + element.to_m <= bridge.span_m:
        return said
    from_m, to_m = bridge.span_m - element.to_m, bridge.span_m - element.from_m
    return f"{said}, {max(from_m, 0.0):.1f} to {to_m:.1f} m from the {ends.end} end"
