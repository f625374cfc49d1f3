"""Chainage at a bridge against Vincenty's geodesics, which share no formula with it."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.site_file import load_site, parse_site
from services.common.geodesy import (
    bridge_frame,
    chainage_of,
    heading_deg,
    to_chainage,
    to_lat_lon,
)


class Ends(NamedTuple):
    start_latitude_deg: float
    start_longitude_deg: float
    end_latitude_deg: float
    end_longitude_deg: float
    span_m: float


def vincenty(lat1: float, lon1: float, lat2: float, lon2: float) -> tuple[float, float]:
    """Distance in m and first azimuth in radians on WGS 84 (Vincenty, Survey Review 23, 1975)."""
    a, f = 6378137.0, 1 / 298.257223563
    b = a * (1 - f)
    u1, u2 = (math.atan((1 - f) * math.tan(math.radians(lat))) for lat in (lat1, lat2))
    difference = math.radians(lon2 - lon1)
    lam = difference
    for _ in range(100):
        x = math.cos(u2) * math.sin(lam)
        y = math.cos(u1) * math.sin(u2) - math.sin(u1) * math.cos(u2) * math.cos(lam)
        sin_sigma = math.hypot(x, y)
        if sin_sigma == 0:
            return 0.0, 0.0
        cos_sigma = math.sin(u1) * math.sin(u2) + math.cos(u1) * math.cos(u2) * math.cos(lam)
        sigma = math.atan2(sin_sigma, cos_sigma)
        sin_alpha = math.cos(u1) * math.cos(u2) * math.sin(lam) / sin_sigma
        cos2 = 1 - sin_alpha**2
        c2m = cos_sigma - 2 * math.sin(u1) * math.sin(u2) / cos2 if cos2 > 1e-12 else 0.0
        c = f / 16 * cos2 * (4 + f * (4 - 3 * cos2))
        bracket = c2m + c * cos_sigma * (2 * c2m**2 - 1)
        new = difference + (1 - c) * f * sin_alpha * (sigma + c * sin_sigma * bracket)
        if abs(new - lam) < 1e-15:
            break
        lam = new
    k = cos2 * (a * a - b * b) / (b * b)
    aa = 1 + k / 16384 * (4096 + k * (-768 + k * (320 - 175 * k)))
    bb = k / 1024 * (256 + k * (-128 + k * (74 - 47 * k)))
    inner = cos_sigma * (2 * c2m**2 - 1) - bb / 6 * c2m * (4 * sin_sigma**2 - 3) * (4 * c2m**2 - 3)
    delta = bb * sin_sigma * (c2m + bb / 4 * inner)
    return b * aa * (sigma - delta), math.atan2(x, y)


def test_vincenty_itself_gives_the_published_length_of_flinders_peak_to_buninyong() -> None:
    # Geoscience Australia's example on GRS 80, which is WGS 84 to 0.1 mm here.
    distance, azimuth = vincenty(
        -(37 + 57 / 60 + 3.72030 / 3600),
        144 + 25 / 60 + 29.52440 / 3600,
        -(37 + 39 / 60 + 10.15610 / 3600),
        143 + 55 / 60 + 35.38390 / 3600,
    )
    assert distance == pytest.approx(54972.271, abs=1e-3)
    assert math.degrees(azimuth) % 360 == pytest.approx(306 + 52 / 60 + 5.37 / 3600, abs=1e-5)


latitudes = st.floats(-75, 75)
longitudes = st.floats(-180, 180)
bearings = st.floats(0, 2 * math.pi)


def ends(latitude: float, longitude: float, bearing: float, span_m: float) -> Ends:
    """Place the ends of a bridge about `span_m` apart; the span is the distance by Vincenty."""
    north = span_m * math.cos(bearing) / 111_132
    east = span_m * math.sin(bearing) / (111_320 * math.cos(math.radians(latitude)))
    end = latitude + north, longitude + east
    return Ends(latitude, longitude, *end, vincenty(latitude, longitude, *end)[0])


@given(latitudes, longitudes, bearings, st.floats(10, 100), st.floats(10, 1000), bearings)
def test_positions_within_a_kilometre_agree_with_vincenty_to_a_millimetre(
    latitude: float, longitude: float, bearing: float, span: float, distance: float, towards: float
) -> None:
    bridge = ends(latitude, longitude, bearing, span)
    there = ends(latitude, longitude, towards, distance)
    position = there.end_latitude_deg, there.end_longitude_deg
    chainage, lateral = to_chainage(bridge_frame(bridge), *position)
    _, road = vincenty(*bridge[:4])
    length, azimuth = vincenty(latitude, longitude, *position)
    assert chainage == pytest.approx(length * math.cos(azimuth - road), abs=1e-3)
    assert lateral == pytest.approx(-length * math.sin(azimuth - road), abs=1e-3)


@given(latitudes, longitudes, bearings, st.floats(10, 100), st.floats(0.9, 1.1))
def test_the_ends_are_at_0_and_span(
    latitude: float, longitude: float, bearing: float, span: float, scale: float
) -> None:
    bridge = ends(latitude, longitude, bearing, span)._replace(span_m=span * scale)
    frame = bridge_frame(bridge)
    chainage, lateral = to_chainage(
        frame,
        [bridge.start_latitude_deg, bridge.end_latitude_deg],
        [bridge.start_longitude_deg, bridge.end_longitude_deg],
    )
    assert chainage == pytest.approx([0, bridge.span_m], abs=1e-8)
    assert lateral == pytest.approx([0, 0], abs=1e-8)


@given(latitudes, longitudes, bearings, st.floats(-1000, 1000), st.floats(-1000, 1000))
def test_there_and_back(
    latitude: float, longitude: float, bearing: float, chainage: float, lateral: float
) -> None:
    frame = bridge_frame(ends(latitude, longitude, bearing, 30.0))
    x, y = to_chainage(frame, *to_lat_lon(frame, [chainage, 0.0], [lateral, 0.0]))
    assert x == pytest.approx([chainage, 0], abs=1e-6)
    assert y == pytest.approx([lateral, 0], abs=1e-6)


def test_across_the_date_line_and_towards_all_sides() -> None:
    for towards in range(0, 360, 30):
        bridge = ends(52.0, 179.9999, math.radians(towards), 40.0)
        wrapped = bridge._replace(end_longitude_deg=(bridge.end_longitude_deg + 180) % 360 - 180)
        frame = bridge_frame(wrapped)
        assert frame.ground_length_m == pytest.approx(bridge.span_m, abs=1e-6)
        _, azimuth = vincenty(*bridge[:4])
        expected = math.degrees(azimuth) % 360
        difference = heading_deg(frame) - expected
        assert math.remainder(difference, 360) == pytest.approx(0, abs=1e-3)
        back = heading_deg(frame, start_to_end=False) - heading_deg(frame)
        assert abs(math.remainder(back, 360)) == pytest.approx(180)


def test_left_is_left_and_shapes_are_kept() -> None:
    eastward = bridge_frame(ends(0.0, 10.0, math.pi / 2, 30.0))
    chainage, lateral = to_chainage(eastward, np.full((2, 3), 0.0001), np.full((2, 3), 10.0001))
    assert chainage.shape == lateral.shape == (2, 3)
    assert np.all(lateral > 10)
    assert to_lat_lon(eastward, 5.0)[0].shape == ()


def test_the_chainage_of_one_place_is_that_of_many() -> None:
    frame = bridge_frame(Ends(-37.95, 144.42, -37.9498, 144.4204, 40.0))
    rng = np.random.default_rng(1)
    latitude = -37.95 + 0.01 * rng.standard_normal(100)
    longitude = 144.42 + 0.01 * rng.standard_normal(100)
    along, _ = to_chainage(frame, latitude, longitude)
    one_by_one = [chainage_of(frame, *place) for place in zip(latitude, longitude, strict=True)]
    assert one_by_one == pytest.approx(along, abs=1e-6)


def test_equal_ends_have_no_frame() -> None:
    with pytest.raises(ValueError, match="same place"):
        bridge_frame(Ends(1.0, 2.0, 1.0, 2.0, 30.0))


def test_the_site_files_own_distance_agrees(shared_sites, csv_example) -> None:  # type: ignore[no-untyped-def]
    for path in [*shared_sites, csv_example / "site.toml"]:
        bridge = load_site(path).bridges[0]
        assert bridge.ends_distance_m == pytest.approx(
            bridge_frame(bridge).ground_length_m, rel=1e-6
        )
        assert parse_site(path.read_text(), "x").bridges[0] == bridge
