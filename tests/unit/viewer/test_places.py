"""Plans, colours, and the page of a recording."""

from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from schemas.signals import GnssFix, encode_gnss
from schemas.site import Site
from schemas.site_file import site_toml
from schemas.topics import Key, Message
from services.catalogue.contents import summarise_recording
from services.common.geodesy import bridge_frame, to_lat_lon
from services.recordings.writer import write_recording
from services.viewer.drawing import WEAK_BAR
from services.viewer.recording_page import detected_views, recording_page
from services.viewer.rerun_file import RerunContent, write_rrd
from services.viewer.rerun_parts import WEAK, ratio_colours, rgb
from services.viewer.view import convert
from tests.unit.drives.recorded import START_NS, drive
from tests.unit.viewer.found import results_of, some_crossing


def over_the_bridge(site: Site) -> list[Message]:
    """20 s at 10 m/s through the middle of the bridge, 3 m to the left of its line."""
    frame = bridge_frame(site.bridges[0])
    where = Key("live", "vehicle", site.vehicles[0].id, "gnss")
    messages = []
    for number in range(200):
        time_ns = START_NS + number * 100_000_000
        latitude, longitude = to_lat_lon(frame, -85.0 + number, 3.0)
        fix = GnssFix(
            7, number, number * 100_000_000, time_ns, float(latitude), float(longitude), 0.0, 10.0
        )
        messages.append(Message(where, encode_gnss(fix), 7, number, time_ns, time_ns))
    return messages


def positions(rrd: Path, entity: str) -> np.ndarray:
    rows = []
    for chunk in RrdReader(rrd).stream().to_chunks():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            column = next(name for name in batch.schema.names if name.endswith(":positions"))
            rows += [row[0] for row in batch.column(column).to_pylist()]
    return np.array(rows)


def test_the_plan_of_a_bridge_is_in_its_own_metres(tmp_path: Path, site: Site) -> None:
    recording, rrd = tmp_path / "run.mcap", tmp_path / "run.rrd"
    write_recording(recording, over_the_bridge(site), site_toml=site_toml(site), reason="test")
    convert(recording, rrd)
    places = positions(rrd, "/plan/bridge-1/truck/truck-1")
    assert places[:, 1] == pytest.approx(np.full(len(places), -3.0), abs=1e-3)  # left is up
    assert np.diff(places[:, 0]) == pytest.approx(np.ones(len(places) - 1), abs=1e-3)
    span = site.bridges[0].span_m
    assert (
        -0.3 * span <= places[0, 0] <= -0.3 * span + 1.0 + 1e-9
    )  # metres, and it may begin on one
    drawn = {chunk.entity_path for chunk in RrdReader(rrd).stream().to_chunks()}
    assert {"/plan/bridge-1/elements/line", "/plan_of_drive/track/truck-1", "/about"} <= drawn


def test_a_crossing_that_nobody_identified_is_shown_and_one_with_a_result_is_not(
    tmp_path: Path, site: Site
) -> None:
    recording = tmp_path / "run.mcap"
    write_recording(recording, over_the_bridge(site), site_toml=site_toml(site), reason="test")
    found = summarise_recording(recording)
    (passing,) = detected_views(found)
    assert (passing.vehicle, passing.bridge, passing.forward) == ("truck-1", "bridge-1", True)
    assert passing.speed_m_per_s == pytest.approx(10.0, rel=0.05)
    entry = START_NS / 1e9 + 8.5
    known = some_crossing("a") | {"entry_time": entry, "exit_time": entry + 3.0}
    assert detected_views(found, results_of(site, known).crossings) == []
    page = recording_page(found)
    assert "Crossings detected: 1" in page
    assert "truck-1 → bridge-1" in page
    assert "driveby identify run.mcap" in page


def test_the_page_names_gaps_and_what_is_not_known(tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    write_recording(recording, drive(leave_out=range(50, 110)), site_toml=None, reason="test")
    page = recording_page(summarise_recording(recording))
    assert "60 messages missing" in page
    assert "accel: nothing for 3." in page
    assert "gaps in the samples: 1, the longest 3 s" in page
    assert "No site file in it" in page


def test_colours_say_the_ratio_and_doubt_has_none() -> None:
    weak, middle, sound, stiff = ratio_colours(np.array([0.3, 0.75, 1.0, 1.4]), 4, doubtful=False)
    assert weak == middle == rgb(WEAK) == rgb(WEAK_BAR)
    assert sound == stiff == (86, 180, 233)
    assert len({*ratio_colours(np.array([0.3, 1.0]), 2, doubtful=True)}) == 1
    assert ratio_colours(None, 2, doubtful=False) == [(204, 121, 167)] * 2


def test_the_map_shows_each_element_with_the_colour_of_what_was_found(
    tmp_path: Path, site: Site
) -> None:
    found = results_of(site, some_crossing("a"))
    rrd = tmp_path / "found.rrd"
    write_rrd(rrd, RerunContent({}, found.crossings, site))
    (chunk,) = (
        c
        for c in RrdReader(rrd).stream().to_chunks()
        if c.entity_path.startswith("/crossing") and c.entity_path.endswith("/map")
    )
    batch = chunk.to_record_batch()
    column = next(name for name in batch.schema.names if name.endswith(":colors"))
    colours = [packed >> 8 for packed in batch.column(column).to_pylist()[0]]
    assert len(colours) == 7
    assert colours[3] == 0xE69F00
    assert colours.count(0xE69F00) == 1
