"""The room on the disk of the recordings."""

import logging
from pathlib import Path
from typing import Final

from services.common.disk import Disk

_log = logging.getLogger(__name__)
_STOP_SHARE: Final = 0.125
"""Share of the minimum free space at which recording stops, while files can still be closed
properly."""


class NoRoomError(Exception):
    """The disk is too full to go on recording."""


class DiskRoom:
    """Free space of a folder's disk, compared with a minimum."""

    def __init__(self, folder: Path, min_free_bytes: int, disk: Disk) -> None:
        self.free_bytes: int | None = None
        """Free space at the last check."""
        self.is_low = False
        """Whether that is less than the minimum."""
        self._folder, self._min_free_bytes, self._disk = folder, min_free_bytes, disk

    def check(self) -> str | None:
        """Return a line if free space has become low; raise NoRoomError below an eighth."""
        try:
            self.free_bytes = self._disk.free_bytes(self._folder)
        except OSError as error:
            _log.error("%s: %s", self._folder, error.strerror)
            return None
        left = f"{self.free_bytes / 1e6:.0f} MB left on the disk of {self._folder}"
        if self.free_bytes < self._min_free_bytes * _STOP_SHARE:
            raise NoRoomError(f"only {left}")
        was_low, self.is_low = self.is_low, self.free_bytes < self._min_free_bytes
        return left if self.is_low and not was_low else None
