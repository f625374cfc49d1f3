"""A bridge's history as a Rerun file: its figure, and EI of each element over time."""

import io
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.image import imread
from numpy.typing import NDArray

from services.common.files import replaced_atomically
from services.common.language import utc_day
from services.history.bridge_history import BridgeHistory
from services.viewer.drawing import STYLE, figure_bytes
from services.viewer.history_figure import HistoryView, draw_history, history_view
from services.viewer.view import run_viewer

_APPLICATION = "driveby"
_TIME = "date"
_GOOD, _DOUBTFUL, _TEMPERATURE = (86, 180, 233), (150, 150, 150), (204, 121, 167)
_DOTS_PER_INCH = 110
_BESIDE_S = 15 * 86_400
"""Margin in s before the first and after the last period, so that both are visible."""


def view_history(past: BridgeHistory, *, web: bool) -> int:
    """Open a bridge's history in the viewer or a browser (`web`); wait until it is closed.

    Return the exit code. Raise FailureError if the viewer does not start.
    """
    with tempfile.TemporaryDirectory(prefix="driveby-view-") as folder:
        shown = Path(folder) / f"{past.bridge}.rrd"
        write_history(shown, past)
        return run_viewer(shown, web=web)


def write_history(path: Path, past: BridgeHistory) -> None:
    """Write the file; an existing file is replaced."""
    history = history_view(past)
    with replaced_atomically(path) as temporary:
        recording = rr.RecordingStream(_APPLICATION, recording_id=f"history-{history.bridge}")
        recording.save(temporary, default_blueprint=_blueprint(history))
        recording.log("picture", rr.Image(_picture(history)), static=True)
        recording.log("alarms", rr.TextDocument(_history_text(history), media_type="text/markdown"),
                      static=True)  # fmt: skip
        _log_elements(recording, history)
        recording.log(
            "history/temperature", rr.SeriesLines(colors=[_TEMPERATURE], names="°C"), static=True
        )
        for point in history.points:
            if point.temperature_deg_c is not None:
                recording.set_time(_TIME, timestamp=point.time_s)
                recording.log("history/temperature", rr.Scalars(point.temperature_deg_c))
        recording.flush()
        recording.disconnect()


def _log_elements(recording: rr.RecordingStream, history: HistoryView) -> None:
    """Log lines at the limits of the interval and a point at the mean, grey if doubtful."""
    thin = {"q025": "2.5 %", "q975": "97.5 %"}
    for n in range(_elements(history)):
        where = f"history/EI_{n + 1}"
        for name, words in thin.items():
            line = rr.SeriesLines(colors=[_GOOD], widths=1.0, names=words)
            recording.log(f"{where}/{name}", line, static=True)
        for name, colour in (("mean", _GOOD), ("doubtful", _DOUBTFUL)):
            dots = rr.SeriesPoints(colors=[colour], marker_sizes=4.0, names=name)
            recording.log(f"{where}/{name}", dots, static=True)
        for point in history.points:
            if n >= len(point.mean):
                continue
            recording.set_time(_TIME, timestamp=point.time_s)
            name = "mean" if point.verdict == "good" else "doubtful"
            recording.log(f"{where}/{name}", rr.Scalars(point.mean[n] / 1e9))
            recording.log(f"{where}/q025", rr.Scalars(point.low[n] / 1e9))
            recording.log(f"{where}/q975", rr.Scalars(point.high[n] / 1e9))


def _picture(history: HistoryView) -> NDArray[np.uint8]:
    """Return the figure as an image (height, width, 3)."""
    with matplotlib.rc_context(STYLE):
        drawn = imread(io.BytesIO(figure_bytes(draw_history(history), "png", dpi=_DOTS_PER_INCH)))
    return np.rint(255.0 * drawn[:, :, :3]).astype(np.uint8)


def _history_text(history: HistoryView) -> str:
    lines = [f"# {history.bridge}", ""]
    for mark in history.marks:
        state = f"acknowledged by {mark.acknowledged}" if mark.acknowledged else "active"
        lines.append(f"- Alarm of {utc_day(mark.raised_s)}, {state}: {mark.sentence}")
    for wording in history.statements:
        lines += ["", wording.text]
    return "\n".join(lines) + "\n"


def _elements(history: HistoryView) -> int:
    return max((len(point.mean) for point in history.points), default=0)


def _blueprint(history: HistoryView) -> rrb.Blueprint:
    tabs: list[rrb.View | rrb.Container] = [
        rrb.Horizontal(
            rrb.Spatial2DView(origin="picture", name="over time", background=(255, 255, 255)),
            rrb.TextDocumentView(origin="alarms", name="alarms"),
            column_shares=[3, 1],
            name="all elements",
        )
    ]
    if history.points:
        times = [point.time_s for point in history.points]
        start, end = (
            rrb.TimeRangeBoundary.absolute(seconds=time_s)
            for time_s in (min(times) - _BESIDE_S, max(times) + _BESIDE_S)
        )
        whole = rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end))
        names = {f"EI_{n + 1}": f"EI_{n + 1} (GN·m²)" for n in range(_elements(history))}
        if any(point.temperature_deg_c is not None for point in history.points):
            names["temperature"] = "temperature (°C)"
        tabs += [
            rrb.TimeSeriesView(
                origin=f"history/{where}",
                name=name,
                axis_x=whole,
                plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
            )
            for where, name in names.items()
        ]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline=_TIME, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
