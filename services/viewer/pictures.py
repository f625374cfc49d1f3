"""A folder of figures: every crossing and every bridge of results, as PNG and as SVG."""

import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from schemas.results import BridgeResult, Results
from schemas.site import Site
from services.common.files import make_folder
from services.common.progress import Steps, no_step_progress
from services.identification.comparison import estimate_of_state
from services.viewer.bridge_figure import bridge_figure
from services.viewer.bridge_view import views_of_bridges
from services.viewer.crossing_view import view_of_crossing
from services.viewer.figure import crossing_figure

FORMS = ("png", "svg")


def write_pictures(
    folder: Path,
    results: Results,
    site: Site,
    progress: Steps = no_step_progress,
    baselines: Mapping[str, BridgeResult] = MappingProxyType({}),
) -> list[Path]:
    """Write `CROSSING.png`, `BRIDGE.png` and the same as `.svg`; return them.

    The folder is created if absent, files of these names are replaced. `progress` is called for
    each figure. `baselines` are stored states, by bridge, that its figures show.
    """
    make_folder(folder)
    bridges = views_of_bridges(results, site, baselines=baselines)
    steps = len(FORMS) * (len(results.crossings) + len(bridges))
    written: list[Path] = []
    for crossing in results.crossings:
        stored = baselines.get(crossing.bridge)
        before = None if stored is None else estimate_of_state(stored)
        view = view_of_crossing(crossing, site.bridge(crossing.bridge))
        for form in FORMS:
            path = folder / f"{_file_name(crossing.crossing_id)}.{form}"
            crossing_figure(path, crossing=view, baseline=before)
            written.append(path)
            progress(len(written), steps)
    for bridge in bridges:
        for form in FORMS:
            path = folder / f"{bridge.bridge}.{form}"
            bridge_figure(path, bridge)
            written.append(path)
            progress(len(written), steps)
    return written


def _file_name(crossing_id: str) -> str:
    """Return a safe file name: a results file of unknown origin must not name paths."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", crossing_id).lstrip(".")[:200] or "crossing"
