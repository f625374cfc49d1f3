"""A bridge's past as a Rerun recording: EI of each element with its interval, and temperature."""

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from services.common.files import replaced_atomically
from services.viewer.history_figure import History

_APPLICATION = "driveby"


def write_history(path: Path, history: History) -> None:
    """Write the recording; an existing file is replaced."""
    with replaced_atomically(path) as temporary:
        recording = rr.RecordingStream(_APPLICATION, recording_id=f"history-{history.bridge}")
        recording.save(temporary, default_blueprint=_blueprint(history))
        for point in history.points:
            recording.set_time("date", timestamp=point.time_s)
            for n, mean in enumerate(point.mean):
                where = f"history/EI_{n + 1}"
                recording.log(f"{where}/mean", rr.Scalars(mean / 1e9))
                recording.log(f"{where}/q025", rr.Scalars(point.low[n] / 1e9))
                recording.log(f"{where}/q975", rr.Scalars(point.high[n] / 1e9))
            if point.temperature_deg_c is not None:
                recording.log("history/temperature", rr.Scalars(point.temperature_deg_c))
        for mark in history.marks:
            recording.set_time("date", timestamp=mark.raised_s)
            level = rr.TextLogLevel.INFO if mark.acknowledged else rr.TextLogLevel.WARN
            recording.log("history/alarms", rr.TextLog(mark.sentence, level=level))
        recording.flush()
        recording.disconnect()


def _blueprint(history: History) -> rrb.Blueprint:
    elements = max((len(point.mean) for point in history.points), default=0)
    views: list[rrb.View | rrb.Container] = [
        rrb.TimeSeriesView(origin=f"history/EI_{n + 1}", name=f"EI_{n + 1} (GN·m²)")
        for n in range(elements)
    ]
    if any(point.temperature_deg_c is not None for point in history.points):
        views.append(rrb.TimeSeriesView(origin="history/temperature", name="temperature (°C)"))
    alarms = rrb.TextLogView(origin="history/alarms", name="alarms")
    return rrb.Blueprint(rrb.Horizontal(rrb.Vertical(*views), alarms, column_shares=[3, 1]))
