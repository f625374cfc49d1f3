"""Looks whether the site file has been edited while a worker runs."""

import logging
from pathlib import Path
from typing import Final, NamedTuple

from schemas.results import BridgeResult
from schemas.site import Site
from schemas.site_file import parse_site, read_site_text, site_hash
from services.common.errors import InputError
from services.history.baselines import baselines_of

_log = logging.getLogger(__name__)
LOOK_EVERY_S: Final = 2.0
_Signature = tuple[int, int, int]
"""File, size, and time of the last change in ns."""


class Edited(NamedTuple):
    """A site file that can be used, and is another one than before."""

    text: str
    site: Site
    hash: str
    baselines: dict[str, BridgeResult]


class SiteWatch:
    """Reads the file again when it has changed, and tells what is wrong with it once."""

    def __init__(self, path: Path, site: Site) -> None:
        self._path = path
        self._hash = site_hash(site)
        self._seen = self._signature()
        self._refused = ""
        self._next_look_s = 0.0

    def edited(self, now_s: float, *, is_asked: bool = False) -> Edited | None:
        """The file as it is now, if it was edited since the last call; by any steady clock.

        If somebody `is_asked` for it, it is read at once, whether it seems to have changed or not.
        What cannot be used is a warning, and the file before counts.
        """
        if now_s < self._next_look_s and not is_asked:
            return None
        self._next_look_s = now_s + LOOK_EVERY_S
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
                _log.warning("%s; the site file of before stays", error)
            self._refused = str(error)
            return None
        self._refused = ""
        if (found := site_hash(site)) == self._hash:
            return None
        self._hash = found
        return Edited(text, site, found, baselines)

    def _signature(self) -> _Signature | None:
        try:
            status = self._path.stat()
        except OSError:
            return None  # an editor is about to put a new one in its place
        return status.st_ino, status.st_size, status.st_mtime_ns
