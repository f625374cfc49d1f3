"""The trucks of a live view: their data that are not drawn yet."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np
import rerun as rr

from schemas.signals import AccelBatch, GnssFix
from services.viewer.live_parts import TimestampedStream, extremes
from services.viewer.rerun_parts import MUTED, rgb, send_scalars
from services.viewer.vehicle_signals import acceleration_series

_TRACK_FIXES: Final = 300
"""Number of fixes, one per second, of a truck's track on the map."""
_GAP_NS: Final = 200_000_000
"""Gap in ns at which a line of accelerations is broken."""


class LiveTruck:
    """Data of a truck that are not drawn yet, and the state of its picture."""

    def __init__(self) -> None:
        self.batches: list[AccelBatch] = []
        self.fixes: list[GnssFix] = []
        self.track: deque[tuple[float, float]] = deque(maxlen=_TRACK_FIXES)
        self.channels: set[str] = set()
        self.drawn_to_ns = 0
        self.placed_s = -math.inf
        self.track_ns = 0

    def draw_accelerations(self, recording: rr.RecordingStream, vehicle: str) -> None:
        """Draw the new batches."""
        if not self.batches:
            return
        batches = sorted(self.batches, key=lambda one: one.wall_time_ns)
        self.batches = []
        for channel, (time_ns, samples) in acceleration_series(batches).items():
            times, values = extremes(time_ns, samples, batches[0].channels[channel].rate_hz)
            if self.drawn_to_ns and times[0] - self.drawn_to_ns > _GAP_NS:
                times = np.insert(times, 0, self.drawn_to_ns + _GAP_NS // 2)
                values = np.insert(values, 0, np.nan)
            entity = f"vehicle/{vehicle}/acceleration/{channel}"
            send_scalars(recording, entity, values, time_ns=times)
        last = batches[-1]
        longest_s = max(one.samples.size / one.rate_hz for one in last.channels.values())
        self.drawn_to_ns = last.wall_time_ns + round(1e9 * longest_s)

    def draw_track(
        self, recording: rr.RecordingStream, vehicle: str, fixes: Sequence[GnssFix]
    ) -> None:
        """Draw the track, one fix per second."""
        for fix in fixes:
            if fix.wall_time_ns - self.track_ns < 1_000_000_000:
                continue
            self.track_ns = fix.wall_time_ns
            self.track.append((fix.latitude_deg, fix.longitude_deg))
        if len(self.track) > 1:
            style = {"radii": rr.Radius.ui_points(1.0), "colors": [rgb(MUTED)]}
            line = rr.GeoLineStrings(lat_lon=[np.array(self.track)], **style)
            TimestampedStream(recording, self.track_ns).log(f"map/track/{vehicle}", line)
