"""CSV drives in other units or with swapped columns are refused."""

from pathlib import Path

import pytest

from schemas.site_file import load_site
from services.common.errors import InputError
from services.drives.csv_import import read_folder
from services.drives.plausible import check_plausible
from services.drives.runs import Run


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
