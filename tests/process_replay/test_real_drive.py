"""A real drive, with one body sensor and a real receiver, over the bus and back."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rerun.chunk import RrdReader

from schemas.results import load_results
from schemas.signals import decode_accel, decode_gnss, location_class
from schemas.site_file import load_site, site_toml
from services.cli import main as cli
from services.common.geodesy import bridge_frame, to_chainage
from services.drives.comma2k19 import read_comma2k19
from services.drives.importing import import_command
from services.drives.settings import ImportOptions
from services.recordings.recording import read_messages

pytestmark = pytest.mark.process

BRIDGE_M = 40.0


@pytest.fixture
def site(shared: Path, csv_example: Path, tmp_path: Path) -> Path:
    """The car as a truck of the example, and a bridge laid over its track by its own fixes."""
    gnss = read_comma2k19(shared / "real" / "comma2k19").gnss
    known = load_site(csv_example / "site.toml")
    first = int(np.searchsorted(gnss.time_s, gnss.time_s[0] + 30.0))
    ends = {
        "start_latitude_deg": gnss.latitude_deg[first],
        "start_longitude_deg": gnss.longitude_deg[first],
    }
    for last in range(first + 1, first + 100):
        ends["end_latitude_deg"] = gnss.latitude_deg[last]
        ends["end_longitude_deg"] = gnss.longitude_deg[last]
        bridge = known.bridges[0].model_copy(update={**ends, "span_m": BRIDGE_M})
        length_m = bridge_frame(bridge).ground_length_m
        if length_m > BRIDGE_M:
            break
    laid = bridge.model_copy(update={"span_m": length_m, "id": "laid-by-the-test"})
    path = tmp_path / "site.toml"
    path.write_text(site_toml(known.model_copy(update={"bridges": (laid,)})))
    return path


Start = Callable[..., subprocess.Popen[str]]
End = Callable[[subprocess.Popen[str]], None]


def test_comma2k19_is_published_recorded_and_replayed(
    start: Start,
    finish: End,
    terminate: End,
    endpoint: str,
    shared: Path,
    site: Path,
    tmp_path: Path,
) -> None:
    imported = tmp_path / "imported.mcap"
    import_command(
        ImportOptions(sources=(shared / "real" / "comma2k19",), site=site, realm="comma"), imported
    )
    settings = {"listen": endpoint, "folder": tmp_path, "realms": ["*"], "site": None}

    logger = start("services.logger", file=tmp_path / "driven.mcap", **settings)
    drive = {"endpoint": endpoint, "realm": "live", "speed": 30.0, "vehicle": None}
    finish(start("services.truck", recording=imported, **drive))
    terminate(logger)

    logger = start("services.logger", file=tmp_path / "replayed.mcap", **settings)
    again = {"endpoint": endpoint, "speed": 0.0, "name": "comma"}
    finish(start("services.replay", recordings=[str(tmp_path / "driven.mcap")], **again))
    terminate(logger)

    files = [imported, tmp_path / "driven.mcap", tmp_path / "replayed.mcap"]
    first, driven, replayed = (list(read_messages(file)) for file in files)
    assert len(first) == len(driven) > 500
    assert [m.payload for m in replayed] == [m.payload for m in driven]

    batches = [decode_accel(m.payload) for m in driven if m.key.stream == "accel"]
    assert {name for batch in batches for name in batch.channels} == {"sprung_front"}
    samples = sum(batch.channels["sprung_front"].samples.size for batch in batches)
    originals = [decode_accel(m.payload) for m in first if m.key.stream == "accel"]
    assert samples == sum(batch.channels["sprung_front"].samples.size for batch in originals)
    fixes = [decode_gnss(m.payload) for m in driven if m.key.stream == "gnss"]
    positions = [(fix.latitude_deg, fix.longitude_deg) for fix in fixes]
    assert positions == [
        (fix.latitude_deg, fix.longitude_deg)
        for fix in (decode_gnss(m.payload) for m in first if m.key.stream == "gnss")
    ]

    # The track, for any viewer that knows foxglove.LocationFix.
    with (tmp_path / "driven.mcap").open("rb") as file:
        found = [schema for schema, _, _ in make_reader(file).iter_messages()]
        schemas = {schema.name for schema in found if schema is not None}
    assert "foxglove.LocationFix" in schemas
    located = [m.payload for m in driven if m.key.stream == "location"]
    track = [location_class().FromString(payload) for payload in located]
    assert [(one.latitude, one.longitude) for one in track] == positions  # type: ignore[attr-defined]

    # The bridge under it: found, and refused, on exit code 0.
    out, rrd = tmp_path / "out.json", tmp_path / "out.rrd"
    arguments = ["--site", site, "--json", out, "--rrd", rrd]
    assert cli.main(["identify", str(tmp_path / "driven.mcap"), *map(str, arguments)]) == 0
    (crossing,) = load_results(out).crossings
    assert (crossing.verdict, crossing.reasons) == ("rejected", ("channel_missing",))
    assert crossing.parameters is None
    assert (crossing.bridge, crossing.direction) == ("laid-by-the-test", "start_to_end")
    # Here the car drove 15 to 18 m/s by its own receiver.
    bridge = load_site(site).bridges[0]
    chainage_m, _ = to_chainage(bridge_frame(bridge), *np.array(positions).T)
    on_it = [fix for fix, x in zip(fixes, chainage_m, strict=True) if 0.0 < x < bridge.span_m]
    speed = np.median([fix.speed_m_per_s for fix in on_it])
    assert crossing.speed_m_per_s == pytest.approx(speed, rel=0.05)
    assert crossing.entry_time == pytest.approx(on_it[0].wall_time_ns * 1e-9, abs=0.2)

    points = 0
    for chunk in RrdReader(rrd).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.startswith("GeoPoints"):
                points += batch.num_rows
    assert points >= len(positions)
