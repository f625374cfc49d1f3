"""A Rerun file of a drive: accelerations, tracks on map and plan, and results.

There are two timelines: `time` (UTC) and `chainage_mm` (front axle, from the start of the bridge).
Rerun draws one timeline at a time, so the data of a crossing are on both.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import rerun as rr
from matplotlib.figure import Figure
from matplotlib.image import imread

from schemas.results import CrossingResult
from schemas.site import Site
from services.common.files import replaced_atomically
from services.common.parquet_files import arrow
from services.common.progress import Steps, no_step_progress
from services.viewer.bridge_figure import draw_bridge
from services.viewer.bridge_view import BridgeView, summary_of_bridge
from services.viewer.crossing_scene import scenes_of
from services.viewer.crossing_tab import log_crossing, when_and_where
from services.viewer.crossing_view import (
    CrossingSpan,
    CrossingView,
    DetectedCrossingView,
    ResidualCells,
    view_of_crossing,
)
from services.viewer.drawing import STYLE, figure_bytes
from services.viewer.drive_figure import draw_drive
from services.viewer.layout import (
    blueprint,
    bridge_root,
    drive_picture,
    passing_root,
)
from services.viewer.panels.place import log_position
from services.viewer.panels.signals import log_accelerations
from services.viewer.rerun_parts import log_channel, log_markdown, send_scalars
from services.viewer.rerun_places import (
    BridgeOnMap,
    bridges_near_tracks,
    bridges_of_site,
    log_bridge,
    log_drive_plan,
    log_surroundings,
    log_vehicle,
    plan_root,
)
from services.viewer.vehicle_signals import VehicleSignals, acceleration_series

APPLICATION = "driveby"
_PIECE = 2000
"""Number of batches sent at a time."""
_PICTURE_DPI = 110
"""Resolution of figures: one larger than its view is drawn without smoothing, illegibly."""


class _Count:
    """Counter of the steps done."""

    def __init__(self, report: Steps, steps: int) -> None:
        self._report, self._steps, self._done = report, steps, 0
        report(0, steps)

    def one_more(self) -> None:
        self._done += 1
        self._report(self._done, self._steps)


class RerunContent(NamedTuple):
    """Everything that a file shows."""

    vehicles: Mapping[str, VehicleSignals]
    """Signals by identifier of the truck."""
    crossings: Sequence[CrossingResult]
    site: Site | None
    """Bridges of the crossings; without it only signals are drawn."""
    overviews: Sequence[BridgeView] = ()
    """States of bridges with all their crossings, which come first."""
    residuals: Mapping[str, ResidualCells] = {}
    """Residual bins by crossing_id."""
    passings: Sequence[DetectedCrossingView] = ()
    """Stays that were not identified."""
    about: str | None = None
    """Page on the recording in Markdown."""

    def views(self) -> list[CrossingView]:
        """Return the crossings of known bridges as drawn."""
        bridges = {} if self.site is None else {bridge.id: bridge for bridge in self.site.bridges}
        return [
            view_of_crossing(one, bridges[one.bridge])._replace(
                residuals=self.residuals.get(one.crossing_id)
            )
            for one in self.crossings
            if one.bridge in bridges
        ]


def write_rrd(path: Path, content: RerunContent, drawing: Steps = no_step_progress) -> None:
    """Write a Rerun file with its own layout; an existing file is replaced as a whole.

    A crossing's accelerations are taken from the signals of its vehicle; one without any, or with
    fewer channels, is drawn with those it has. `drawing` is called for each crossing, and each
    block of accelerations.
    """
    arrow()  # before Rerun's first list
    vehicles, _, site, overviews, _, passings, about = content
    crossings, bridges = content.views(), [] if site is None else bridges_of_site(site)
    near = bridges_near_tracks(bridges, vehicles.values())
    scenes = scenes_of(crossings, vehicles, bridges, near, overviews)
    default = blueprint(vehicles, scenes, overviews, passings, bridges=near, about=about)
    states = {view.bridge: view for view in overviews}
    places = {bridge.identifier: bridge for bridge in bridges}
    pieces = sum(-(-len(signals.accel) // _PIECE) for signals in vehicles.values())
    drawn = _Count(drawing, pieces + len(crossings))
    with (
        replaced_atomically(path) as temporary,
        rr.RecordingStream(APPLICATION, recording_id=_recording_id(crossings)) as recording,
    ):
        recording.save(temporary, default_blueprint=default)
        if about is not None:
            log_markdown(recording, "about", about)
        for bridge in near:
            _log_state(recording, bridge, states.get(bridge.identifier))
            log_surroundings(recording, bridge, vehicles)
        log_drive_plan(recording, near, vehicles)
        for vehicle, signals in vehicles.items():
            log_vehicle(recording, vehicle, signals.gnss)
            _log_accelerations(recording, vehicle, signals, drawn)
            if overviews or crossings:
                _log_drive(recording, vehicle, signals, (*crossings, *passings))
        for view in overviews:
            _log_overview(recording, view)
        for scene in scenes:
            log_crossing(recording, scene)
            drawn.one_more()
        for passing in passings:
            place = places.get(passing.bridge)
            _log_passing(recording, passing, vehicles.get(passing.vehicle), place)
        recording.flush()


def _log_accelerations(
    recording: rr.RecordingStream, vehicle: str, signals: VehicleSignals, drawn: _Count
) -> None:
    """Log all samples, a block at a time: an hour at once takes a gigabyte more."""
    named: set[str] = set()
    for first in range(0, len(signals.accel), _PIECE):
        # Include the previous batch, so that a gap between two blocks counts as one, too.
        before = first - 1 if first else 0
        piece = signals.accel[before : first + _PIECE]
        for channel, (time_ns, samples) in acceleration_series(piece).items():
            entity = f"vehicle/{vehicle}/acceleration/{channel}"
            if channel not in named:
                named.add(channel)
                log_channel(recording, entity, channel)
            known = piece[0].channels.get(channel) if first else None
            sent = 0 if known is None else known.samples.size
            send_scalars(recording, entity, samples[sent:], time_ns=time_ns[sent:])
        drawn.one_more()


def _recording_id(crossings: Sequence[CrossingView]) -> str:
    """Return the same id for the same crossings, so that a viewer replaces an open file."""
    return "_".join(crossing.crossing_id for crossing in crossings) or "drive"


def _log_state(
    recording: rr.RecordingStream, bridge: BridgeOnMap, state: BridgeView | None
) -> None:
    """Draw the bridge on map and plan, in the colours of its relative EI."""
    ratios = None
    if state is not None and state.estimate is not None:
        ratios = state.estimate.mean / state.nominal_nm2
        ratios[[number - 1 for number in state.unresolved]] = np.nan
    log_bridge(
        recording,
        bridge,
        ratios,
        doubtful=state is not None and state.is_doubtful,
        map_entity=f"map/bridge/{bridge.identifier}",
        plan_entity=f"{plan_root(bridge.identifier)}/elements",
    )


def _log_overview(recording: rr.RecordingStream, bridge: BridgeView) -> None:
    root = bridge_root(bridge)
    with matplotlib.rc_context(STYLE):
        figure = draw_bridge(bridge)
    _log_picture(recording, f"{root}/picture", figure)
    wording = "None of the crossings could be used."
    if bridge.estimate is not None:
        wording = summary_of_bridge(bridge)
    doubt = "**Doubtful. Do not rely on these values.** " if bridge.is_doubtful else ""
    lines = [f"# {bridge.owner_id or bridge.bridge}", "", f"{doubt}{wording}", ""]
    verdicts = [crossing.verdict for crossing in bridge.crossings]
    counted = [f"{verdicts.count(v)} {v}" for v in dict.fromkeys(sorted(verdicts))]
    lines += [f"Crossings: {', '.join(counted)}; used: {len(bridge.used)}.", ""]
    of_state = () if bridge.state is None else bridge.state.reason_texts
    lines += [f"- {text}" for text in of_state]
    for crossing in bridge.crossings:
        used = "used" if crossing.crossing_id in bridge.used else "not used"
        which = f"{when_and_where(crossing)}, {crossing.verdict}, {used}"
        lines += [f"- {which}: {text}" for text in crossing.reason_texts]
    log_markdown(recording, f"{root}/finding", "\n".join(lines))


def _log_passing(
    recording: rr.RecordingStream,
    passing: DetectedCrossingView,
    signals: VehicleSignals | None,
    place: BridgeOnMap | None,
) -> None:
    """Log accelerations and position of a stay that was not identified."""
    root = passing_root(passing)
    log_accelerations(recording, root, passing, signals)
    log_position(recording, root, passing, signals, place)


def _log_drive(
    recording: rr.RecordingStream,
    vehicle: str,
    signals: VehicleSignals,
    crossings: Sequence[CrossingView | DetectedCrossingView],
) -> None:
    """Log the picture of a whole drive, which no timeline empties."""
    own: list[CrossingSpan] = []
    own += [one for one in crossings if one.vehicle == vehicle]
    with matplotlib.rc_context(STYLE):
        figure = draw_drive(vehicle, signals, own)
    _log_picture(recording, drive_picture(vehicle), figure)


def _log_picture(recording: rr.RecordingStream, entity: str, figure: Figure) -> None:
    """Log a figure as pixels: a PNG is not drawn while the chainage is negative (Rerun 0.41)."""
    drawn = imread(io.BytesIO(figure_bytes(figure, "png", dpi=_PICTURE_DPI)))
    pixels = np.rint(255.0 * drawn[:, :, :3]).astype(np.uint8)
    recording.log(entity, rr.Image(pixels), static=True)
