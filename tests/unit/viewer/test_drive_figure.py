"""The figure of a drive: its words do not cover each other, and its time axis is named."""

from collections.abc import Iterator

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from services.drives.runs import GnssTrack, Run
from services.viewer import drive_figure
from services.viewer.drawing import STYLE
from services.viewer.drive_figure import run_picture
from tests.unit.words import assert_words_apart

CHANNELS = ("sprung_front", "sprung_rear", "unsprung_front", "unsprung_rear")


@pytest.fixture(autouse=True)
def style() -> Iterator[None]:
    with matplotlib.rc_context(STYLE):
        yield


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    figures: list[Figure] = []

    def keep(figure: Figure, *_: object, **__: object) -> bytes:
        figures.append(figure)
        return b""

    monkeypatch.setattr(drive_figure, "figure_bytes", keep)
    return figures


@pytest.mark.parametrize("source", ["accel_00.csv", "/data/" + "a-long-folder/" * 9 + "accel.csv"])
def test_picture_of_a_run_has_words_apart_and_a_time_axis(drawn: list[Figure], source: str) -> None:
    time_s = 1.79e9 + 0.01 * np.arange(600, dtype=np.float64)
    channels = {name: np.array(np.sin(time_s)) for name in CHANNELS}
    even = np.full(6, 10.0, dtype=np.float64)
    track = GnssTrack(1.79e9 + np.arange(6.0), 47.0 + 0.0 * even, even, even, even, None)
    run_picture(Run(source, time_s, 100.0, channels, track))
    (figure,) = drawn
    figure.draw_without_rendering()
    assert_words_apart(figure)
    assert figure.axes[-1].get_xlabel() == "time (UTC)"
    (heading,) = figure.texts
    assert heading.get_text().removeprefix("…") in source
    assert heading.get_window_extent().x1 <= figure.bbox.x1
