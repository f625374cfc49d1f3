"""A site file other than that of the results is named, unless only descriptions differ."""

from pathlib import Path
from typing import Any

import pytest

from schemas.site import Site
from schemas.site_file import site_hash, site_toml
from services.ledger.site_of_results import site_of_results
from services.recordings.writer import write_recording
from tests.unit.drives.recorded import drive
from tests.unit.viewer.found import results_of, some_crossing


def with_bridge(site: Site, **changes: Any) -> Site:
    bridges = tuple(bridge.model_copy(update=changes) for bridge in site.bridges)
    return site.model_copy(update={"bridges": bridges})


def warnings_with(folder: Path, then: Site, now: Site, caplog: pytest.LogCaptureFixture) -> str:
    results = results_of(then, some_crossing("a"))
    assert results.site_hash == site_hash(then)
    caplog.clear()
    assert site_of_results(folder / "found.json", results, now) == now
    return caplog.text


def test_added_description_is_no_other_site_file(
    site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    plain = with_bridge(site, owner_id=None, baseline=None)
    with_both = with_bridge(plain, owner_id="B 317", baseline="first.json")
    for now in (plain, with_bridge(plain, baseline="first.json"), with_both):
        assert warnings_with(tmp_path, plain, now, caplog) == ""
    owned = with_bridge(plain, owner_id="B 317")
    assert warnings_with(tmp_path, owned, with_both, caplog) == ""
    longer = with_bridge(with_both, span_m=1.01 * site.bridges[0].span_m)
    assert "computed with another site file" in warnings_with(tmp_path, plain, longer, caplog)


def test_changed_description_is_known_from_a_recording(
    site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    then, now = (with_bridge(site, baseline=name) for name in ("first.json", "second.json"))
    assert "computed with another" in warnings_with(tmp_path, then, now, caplog)
    write_recording(tmp_path / "a.mcap", drive(), site_toml=site_toml(then), reason="test")
    assert warnings_with(tmp_path, then, now, caplog) == ""
