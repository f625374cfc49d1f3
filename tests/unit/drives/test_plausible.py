"""CSV drives in other units or with swapped columns are refused."""

from pathlib import Path

import numpy as np
import pytest

from schemas.site_file import load_site
from services.common.arrays import Floats
from services.common.errors import InputError
from services.drives.csv_import import read_folder
from services.drives.plausible import check_plausible
from services.drives.runs import GnssTrack, Run

_METRE_DEG = 1.0 / 111_200.0


def changed(run: Run, what: str) -> Run:
    gnss = run.gnss
    if what == "swapped":
        return run._replace(
            gnss=gnss._replace(latitude_deg=gnss.longitude_deg, longitude_deg=gnss.latitude_deg)
        )
    if what == "km/h":
        return run._replace(gnss=gnss._replace(speed_m_per_s=gnss.speed_m_per_s * 3.6))
    return run._replace(channels={n: v / 9.80665 + 1.0 for n, v in run.channels.items()})


@pytest.mark.parametrize("what", ["swapped", "km/h", "in g"])
def test_contradicted_unit_or_order_is_refused(csv_example: Path, what: str) -> None:
    site = load_site(csv_example / "site.toml")
    (run,) = read_folder(csv_example)
    check_plausible(run, site)
    with pytest.raises(InputError, match=what):
        check_plausible(changed(run, what), site)


def driven(north_m: Floats, west_m: Floats, noise_m: float) -> GnssTrack:
    """Return fixes at 10 Hz with true speeds and with positions that scatter by `noise_m`."""
    rng = np.random.default_rng(1)
    time_s = 1_790_000_000.0 + 0.1 * np.arange(north_m.size, dtype=np.float64)
    speed = np.hypot(np.gradient(north_m, 0.1), np.gradient(west_m, 0.1))
    north_m, west_m = (m + noise_m * rng.standard_normal(m.size) for m in (north_m, west_m))
    east_deg = _METRE_DEG / np.cos(np.radians(47.0))
    latitude, longitude = 47.0 + north_m * _METRE_DEG, 8.0 - west_m * east_deg
    return GnssTrack(time_s, latitude, longitude, np.zeros(time_s.size), speed, None)


@pytest.mark.parametrize("path", ["straight", "turning", "circle"])
def test_speed_in_km_h_is_refused_where_fixes_scatter(csv_example: Path, path: str) -> None:
    site = load_site(csv_example / "site.toml")
    (run,) = read_folder(csv_example)
    along, still = np.arange(0.0, 300.0), np.zeros(300)
    north, west = {
        "straight": (along, still),
        "turning": (np.minimum(along, 150.0), np.maximum(along - 150.0, 0.0)),
        "circle": (80.0 * np.cos(along / 80.0), 80.0 * np.sin(along / 80.0)),
    }[path]
    run = run._replace(gnss=driven(north, west, 0.5))
    check_plausible(run, site)
    with pytest.raises(InputError, match=r"speed_mps is 3\.\d+ times .*, which is km/h"):
        check_plausible(changed(run, "km/h"), site)
