"""The tab of a crossing in Rerun: its panels, laid out and drawn in their order."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple

import rerun.blueprint as rrb

from services.viewer.crossing_scene import CrossingScene, Panel
from services.viewer.crossing_view import CrossingView, DetectedCrossingView
from services.viewer.panels import (
    deflection,
    learned,
    place,
    residuals,
    rigidity,
    signals,
    verdict,
)
from services.viewer.rerun_parts import RerunStream


class _Column(NamedTuple):
    share: int
    panels: tuple[Panel[Any], ...]
    arranged: Callable[..., rrb.Container]


def _stacked(*parts: rrb.Container | rrb.View) -> rrb.Container:
    return rrb.Vertical(*parts, row_shares=[5, 3])


def _tabbed(*parts: rrb.Container | rrb.View) -> rrb.Container:
    return rrb.Tabs(*parts, active_tab=0)


_COLUMNS: Final = (
    _Column(5, (verdict.PANEL, place.PANEL), _stacked),
    _Column(6, (rigidity.PANEL, deflection.PANEL), _stacked),
    _Column(5, (signals.PANEL, learned.PANEL, residuals.PANEL), _tabbed),
)
"""All panels: verdict and position, result, evidence."""


def crossing_layout(scene: CrossingScene) -> rrb.Container:
    """Lay out the panels of a crossing that have something to show."""
    columns: list[rrb.Container | rrb.View] = []
    shares = []
    for share, panels, arranged in _COLUMNS:
        known = [(panel, panel.data(scene)) for panel in panels]
        parts = [panel.layout(scene, data) for panel, data in known if data is not None]
        if parts:
            columns.append(arranged(*parts) if len(parts) > 1 else parts[0])
            shares.append(share)
    return rrb.Horizontal(*columns, column_shares=shares, name=tab_name(scene.crossing))


def log_crossing(recording: RerunStream, scene: CrossingScene) -> None:
    """Log everything of one crossing below its root."""
    for panel in (panel for column in _COLUMNS for panel in column.panels):
        data = panel.data(scene)
        if data is not None:
            panel.log(recording, scene, data)


def tab_name(crossing: CrossingView) -> str:
    """Return time, place and verdict of a crossing: a bridge may have many."""
    return f"{when_and_where(crossing)}, {crossing.verdict}"


def when_and_where(crossing: CrossingView | DetectedCrossingView) -> str:
    """Return time, direction and bridge of a crossing."""
    moment = datetime.fromtimestamp(crossing.entry_time_s, UTC)
    way = "→" if crossing.forward else "←"
    return f"{moment:%Y-%m-%d %H:%M} {way} {crossing.bridge}"
