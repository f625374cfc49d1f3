"""The worker's note on a site file whose bridges no truck comes near."""

import pytest

from schemas.signals import GnssFix, encode_gnss
from schemas.topics import Key
from services.simulation.drive import paper_site
from services.worker.site_fit import SiteFit

NOW_NS = 1_790_000_000_000_000_000
GNSS = Key("live", "vehicle", "truck-1", "gnss")


def fixes(*places: tuple[float, float]) -> SiteFit:
    fit = SiteFit(paper_site().bridges)
    for second, (latitude, longitude) in enumerate(places):
        fix = GnssFix(1, second, 0, NOW_NS, latitude, longitude, 0.0, 9.0)
        fit.note(GNSS, encode_gnss(fix), 10.0 * second)
    return fit


def test_site_of_other_bridges_is_named_with_the_distance() -> None:
    assert fixes().complaint() == ""
    far = fixes((36.30, 140.10), (36.2110, 140.10), (36.40, 140.10))
    assert far.complaint() == (
        "no truck has come near a bridge of the site file: the smallest distance is 11.2 km, of "
        "truck-1 to bridge-1"
    )
    far.retarget(paper_site().bridges)
    assert far.complaint() == ""


def test_truck_that_came_near_once_ends_the_complaint() -> None:
    assert fixes((36.30, 140.10), (36.1107, 140.1012), (36.40, 140.10)).complaint() == ""


@pytest.mark.parametrize("longitude_deg", [-179.9, 0.0, 179.9])
def test_distance_is_that_of_the_sphere(longitude_deg: float) -> None:
    bridge = (
        paper_site()
        .bridges[0]
        .model_copy(update={"start_latitude_deg": 0.0, "start_longitude_deg": longitude_deg})
    )
    fit = SiteFit([bridge])
    fit.note(GNSS, encode_gnss(GnssFix(1, 0, 0, NOW_NS, 0.0, 180.0, 0.0, 9.0)), 0.0)
    expected_km = (180.0 - abs(longitude_deg)) * 111.195
    assert f" {expected_km:.1f} km" in fit.complaint()
