"""A real drive, with one body sensor and a real receiver, over the bus and back."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from schemas.signals import decode_accel, decode_gnss
from services.common.recording import read_messages
from services.importing import import_command

pytestmark = pytest.mark.process

Start = Callable[..., subprocess.Popen[str]]
End = Callable[[subprocess.Popen[str]], None]


def test_comma2k19_is_published_recorded_and_replayed(
    start: Start, finish: End, terminate: End, endpoint: str, shared: Path, tmp_path: Path
) -> None:
    site = shared / "crossings" / "d1_clean_const_speed" / "site.toml"  # any truck will do
    imported = tmp_path / "imported.mcap"
    import_command(
        sources=[shared / "real" / "comma2k19"],
        site=site,
        output=imported,
        vehicle=None,
        name="comma",
    )
    settings = {"listen": endpoint, "folder": tmp_path, "realm": None, "site": None}

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
