"""A Rerun recording of a drive: accelerations, tracks on map and plan, and what was found.

Two timelines: `time` (UTC) and `chainage_mm` (front axle, from the start of the bridge). Rerun
draws one timeline at a time, so what belongs to a crossing is there on both.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import rerun as rr
from matplotlib.image import imread

from schemas.signals import AccelBatch
from services.common.files import replaced_atomically
from services.common.progress import Steps, unwatched_steps
from services.drives.signals import series_of_batches
from services.viewer.bridge_figure import draw_bridge
from services.viewer.bridge_view import BridgeView, told
from services.viewer.crossing_view import CrossingView, FloatArray, OnBridge, PassingView
from services.viewer.drawing import STYLE, figure_bytes
from services.viewer.layout import blueprint, bridge_root, passing_root
from services.viewer.rerun_crossing import (
    WINDOW_S,
    Channels,
    log_acceleration,
    log_crossing,
    log_position,
)
from services.viewer.rerun_parts import (
    IntArray,
    channel_colour,
    log_line,
    log_markdown,
    send_scalars,
)
from services.viewer.rerun_places import (
    BridgeOnMap,
    bridges_near_tracks,
    log_bridge,
    log_drive_plan,
    log_surroundings,
    log_vehicle,
    plan_root,
)
from services.viewer.vehicle_signals import VehicleSignals

APPLICATION = "driveby"
_PIECE = 2000
"""Batches that are sent at a time."""
_PICTURE_DPI = 110
"""A picture that is larger than its view is drawn without smoothing, and cannot be read."""


class _Count:
    """How many steps have been done."""

    def __init__(self, told: Steps, steps: int) -> None:
        self._told, self._steps, self._done = told, steps, 0
        told(0, steps)

    def one_more(self) -> None:
        self._done += 1
        self._told(self._done, self._steps)


def write_rrd(
    path: Path,
    *,
    vehicles: Mapping[str, VehicleSignals],
    bridges: Sequence[BridgeOnMap],
    crossings: Sequence[CrossingView],
    overviews: Sequence[BridgeView] = (),
    passings: Sequence[PassingView] = (),
    about: str | None = None,
    drawing: Steps = unwatched_steps,
) -> None:
    """Write a Rerun recording with its own layout; an existing file is replaced as a whole.

    `overviews` are the bridges' states with all their crossings, and come first. `vehicles` are the
    signals by vehicle identifier. A crossing's accelerations are looked up in the signals of its
    vehicle; one without any, or with fewer channels, is drawn with what it has. `passings` are
    stays on a bridge that nobody has identified; `about` says in Markdown what was recorded.
    `drawing` is told of each crossing, and of each piece of accelerations.
    """
    near = bridges_near_tracks(bridges, vehicles.values())
    default = blueprint(vehicles, crossings, overviews, passings, bridges=near, about=about)
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
        for view in overviews:
            _log_overview(recording, view)
        for crossing in crossings:
            state = states.get(crossing.bridge)
            log_crossing(
                recording,
                crossing,
                places.get(crossing.bridge),
                vehicles.get(crossing.vehicle),
                _series_around(crossing, vehicles.get(crossing.vehicle)),
                None if state is None else state.baseline,
            )
            drawn.one_more()
        for passing in passings:
            root = passing_root(passing)
            around = _series_around(passing, vehicles.get(passing.vehicle))
            log_acceleration(recording, root, passing, around)
            if passing.vehicle in vehicles:
                place = places.get(passing.bridge)
                log_position(recording, root, passing, vehicles[passing.vehicle], place)
        recording.flush()


def acceleration_series(batches: Sequence[AccelBatch]) -> dict[str, tuple[IntArray, FloatArray]]:
    """Join batches into one series per channel: wall time (ns) and acceleration (m/s²).

    A NaN stands in every gap longer than one and a half samples: a plot then breaks its line there
    instead of drawing an acceleration that nobody measured.
    """
    marked = {}
    for name, (times, samples) in series_of_batches(batches).items():
        rates = (batch.channels[name].rate_hz for batch in batches if name in batch.channels)
        period_ns = 1e9 / min(rates)
        gaps = np.flatnonzero(np.diff(times) > 1.5 * period_ns) + 1
        marked[name] = (
            np.insert(times, gaps, times[gaps - 1] + int(period_ns / 2)),
            np.insert(samples, gaps, np.nan),
        )
    return marked


def _log_accelerations(
    recording: rr.RecordingStream, vehicle: str, signals: VehicleSignals, drawn: _Count
) -> None:
    """All samples, a piece at a time: an hour at once takes a gigabyte more."""
    named: set[str] = set()
    for first in range(0, len(signals.accel), _PIECE):
        # With the batch before it, so that a gap between two pieces is one, too.
        before = first - 1 if first else 0
        piece = signals.accel[before : first + _PIECE]
        for channel, (time_ns, samples) in acceleration_series(piece).items():
            entity = f"vehicle/{vehicle}/acceleration/{channel}"
            if channel not in named:
                named.add(channel)
                log_line(recording, entity, channel.replace("_", " "), channel_colour(channel))
            known = piece[0].channels.get(channel) if first else None
            sent = 0 if known is None else known.samples.size
            send_scalars(recording, entity, samples[sent:], time_ns=time_ns[sent:])
        drawn.one_more()


def _series_around(passage: OnBridge, signals: VehicleSignals | None) -> Channels:
    """Accelerations while a truck was on a bridge, and somewhat more."""
    if signals is None:
        return {}
    first_ns = (passage.entry_time_s - 2.0 * WINDOW_S) * 1e9
    last_ns = (passage.exit_time_s + WINDOW_S) * 1e9
    return acceleration_series([b for b in signals.accel if first_ns <= b.wall_time_ns <= last_ns])


def _recording_id(crossings: Sequence[CrossingView]) -> str:
    """The same for the same crossings, so that writing anew replaces what a viewer has open."""
    return "_".join(crossing.crossing_id for crossing in crossings) or "drive"


def _log_state(
    recording: rr.RecordingStream, bridge: BridgeOnMap, state: BridgeView | None
) -> None:
    """The bridge on map and plan, with the colours of what is known of it."""
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
    with matplotlib.rc_context(STYLE):
        drawn = imread(io.BytesIO(figure_bytes(draw_bridge(bridge), "png", dpi=_PICTURE_DPI)))
    root = bridge_root(bridge)
    pixels = np.rint(255.0 * drawn[:, :, :3]).astype(np.uint8)
    # Not as PNG: such a picture is not drawn at all while the chainage is negative (Rerun 0.41).
    recording.log(f"{root}/picture", rr.Image(pixels), static=True)
    said = "None of the crossings could be used."
    if bridge.estimate is not None:
        said = " ".join(told(bridge))
    doubt = "**Doubtful: to be looked at, not to be relied upon.** " if bridge.is_doubtful else ""
    lines = [f"# {bridge.owner_id or bridge.bridge}", "", f"{doubt}{said}", ""]
    verdicts = [crossing.verdict for crossing in bridge.crossings]
    counted = [f"{verdicts.count(v)} {v}" for v in dict.fromkeys(sorted(verdicts))]
    lines += [f"Crossings: {', '.join(counted)}; used: {len(bridge.used)}.", ""]
    of_state = () if bridge.state is None else bridge.state.reason_texts
    of_crossings = (text for c in bridge.crossings for text in c.reason_texts)
    reasons = dict.fromkeys((*of_state, *of_crossings))
    lines += [f"- {text}" for text in reasons]
    log_markdown(recording, f"{root}/finding", "\n".join(lines))
