"""Position of an element on site: the ends of a bridge by compass directions."""

from __future__ import annotations

from typing import NamedTuple

from schemas.site import Bridge
from services.common.geodesy import bridge_frame, heading_deg
from services.common.language import ENGLISH, Language
from services.identification.comparison import Element


class Ends(NamedTuple):
    """The sides of a bridge at which it starts and ends: chainage 0, and the span."""

    start: str
    end: str


def ends_of(bridge: Bridge, language: Language = ENGLISH) -> Ends:
    """Return the sides as seen from its middle, by the coordinates of the site file."""
    frame = bridge_frame(bridge)
    compass = language.text("compass").split(",")
    towards = (heading_deg(frame, start_to_end=way) for way in (False, True))
    return Ends(*(compass[round(heading / 45.0) % 8] for heading in towards))


def start_of(bridge: Bridge, language: Language = ENGLISH) -> str:
    """Return the end from which chainage is measured, in words and coordinates."""
    latitude, longitude = bridge.start_latitude_deg, bridge.start_longitude_deg
    north, south, east, west = language.text("hemispheres").split(",")
    return language.text(
        "bridge.start",
        side=ends_of(bridge, language).start,
        latitude=abs(latitude),
        north=north if latitude >= 0.0 else south,
        longitude=abs(longitude),
        east=east if longitude >= 0.0 else west,
    )


def position_of(element: Element, bridge: Bridge, language: Language = ENGLISH) -> str:
    """Return the distance of an element from the start and, where nearer, from the end too."""
    ends = ends_of(bridge, language)
    from_m, to_m = element.from_m, element.to_m
    wording = language.text("position", from_m=from_m, to_m=to_m, side=ends.start)
    if from_m + to_m <= bridge.span_m:
        return wording
    from_m, to_m = max(bridge.span_m - element.to_m, 0.0), bridge.span_m - element.from_m
    from_end = language.text("position", from_m=from_m, to_m=to_m, side=ends.end)
    return f"{wording}, {from_end}"
