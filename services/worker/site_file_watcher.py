"""Detection of edits of the site file while a worker runs."""

import logging
from pathlib import Path
from typing import Final, NamedTuple

from schemas.site import Site
from schemas.site_file import parse_site, read_site_text, site_hash
from services.common.errors import InputError
from services.identification.baseline_cautions import origin_caution
from services.ledger.baselines import Baselines, baselines_of

_log = logging.getLogger(__name__)
CHECK_EVERY_S: Final = 2.0
_Signature = tuple[int, int, int]
"""File, size, and time of the last change in ns."""


class EditedSite(NamedTuple):
    """A valid site file that differs from the previous one."""

    text: str
    site: Site
    hash: str
    baselines: Baselines


def warn_of_simulated(realm: str, baselines: Baselines) -> None:
    """Warn of each bridge of which only one, the realm or the baseline, is simulated."""
    for bridge, realms in baselines.realms.items():
        caution = origin_caution([realm], realms)
        if caution is not None:
            _log.warning("%s: %s", bridge, caution)


class SiteFileWatcher:
    """Watcher of the site file, which reports each error once."""

    def __init__(self, path: Path, site: Site, realm: str) -> None:
        self._path = path
        self._realm = realm
        self._hash = site_hash(site)
        self._seen = self._signature()
        self._refused = ""
        self._next_check_s = 0.0

    def edited(self, now_s: float, *, is_asked: bool = False) -> EditedSite | None:
        """Return the present file, if it was edited since the last call; by any steady clock.

        If `is_asked`, it is read at once, whether it seems to have changed or not. An invalid file
        is a warning, and the previous one stays in use.
        """
        if now_s < self._next_check_s and not is_asked:
            return None
        self._next_check_s = now_s + CHECK_EVERY_S
        seen = self._signature()
        if seen == self._seen and not is_asked:
            return None
        self._seen = seen
        try:
            text = read_site_text(self._path)
            site = parse_site(text, str(self._path))
            baselines = baselines_of(site, self._path.parent)
        except InputError as error:
            if str(error) != self._refused or is_asked:
                _log.warning("%s; keeping the previous site file", error)
            self._refused = str(error)
            return None
        self._refused = ""
        if (found := site_hash(site)) == self._hash:
            return None
        self._hash = found
        warn_of_simulated(self._realm, baselines)
        return EditedSite(text, site, found, baselines)

    def _signature(self) -> _Signature | None:
        try:
            status = self._path.stat()
        except OSError:
            return None  # an editor is about to replace it
        return status.st_ino, status.st_size, status.st_mtime_ns
