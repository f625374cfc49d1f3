"""What was stored of a bridge, for later results to be compared with."""

from __future__ import annotations

import logging
from pathlib import Path

from schemas.site import Bridge
from services.history.baselines import stored_state
from services.identification.comparison import Estimate, estimate_of_state

_log = logging.getLogger(__name__)


def named_baseline(
    bridge: Bridge, folder: Path, *, required: bool = False
) -> tuple[Estimate | None, str | None]:
    """The baseline that the site file names for a bridge, and its file's name; None without one.

    A path that is not absolute begins at `folder`. A file that is not there is a warning unless it
    is `required`: a recording carries its site file to where the baseline need not be. InputError
    if the file is none, or has no state of this bridge with as many elements.
    """
    if bridge.baseline is None:
        return None, None
    path = folder / bridge.baseline
    if not required and not path.is_file():
        _log.warning("%s: the baseline %s is not there", bridge.id, path)
        return None, None
    return stored_baseline(bridge, path)


def stored_baseline(bridge: Bridge, path: Path) -> tuple[Estimate, str]:
    """The state of a bridge in a results file, and the file's name; InputError as above."""
    return estimate_of_state(stored_state(path, bridge)), path.name
