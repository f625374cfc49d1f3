"""The stored baseline of a bridge, with which later results are compared."""

from __future__ import annotations

import logging
from pathlib import Path

from schemas.site import Bridge
from services.identification.comparison import Estimate, estimate_of_state
from services.ledger.baselines import stored_state

_log = logging.getLogger(__name__)


def named_baseline(
    bridge: Bridge, folder: Path, *, required: bool = False
) -> tuple[Estimate | None, str | None]:
    """Return the baseline that the site file names for a bridge, and its file's name, or None.

    A relative path begins at `folder`. An absent file is a warning unless it is `required`: a
    recording carries its site file to places without the baseline. Raise InputError if the file is
    invalid, or has no state of this bridge with as many elements.
    """
    path = baseline_path(bridge, folder, required=required)
    if path is None:
        return None, None
    return estimate_of_state(stored_state(path, bridge)), path.name


def baseline_path(bridge: Bridge, folder: Path, *, required: bool = False) -> Path | None:
    """Return the baseline file that the site file names, None as above."""
    if bridge.baseline is None:
        return None
    path = folder / bridge.baseline
    if not required and not path.is_file():
        _log.warning("%s: the baseline %s is missing", bridge.id, path)
        return None
    return path
