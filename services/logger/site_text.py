"""Text of the site file for new recordings, which follows edits of the file."""

import logging
from pathlib import Path

from schemas.site_file import parse_site, read_site_text
from services.common.errors import InputError

_log = logging.getLogger(__name__)


class RecordedSite:
    """Last valid text of a site file."""

    def __init__(self, path: Path) -> None:
        """Read the file; raise InputError if it is not a site file."""
        self._path = path
        self._text = read_site_text(path)
        parse_site(self._text, str(path))
        self._seen: str | None = self._text
        self._problem = ""

    def current(self) -> str:
        """Return the file's text, or the previous one, with a warning, if it became invalid."""
        text, problem = None, ""
        try:
            text = read_site_text(self._path)
            # Many trucks may start a file at the same time: one check of a text is enough.
            if text == self._seen:
                return self._text
            parse_site(text, str(self._path))
        except InputError as error:
            problem = str(error)
            if problem != self._problem:
                _log.warning("%s; new recordings keep the previous site file", problem)
        self._seen, self._problem = text, problem
        if text is not None and not problem and text != self._text:
            self._text = text
            _log.info("%s: edited; new recordings contain the new text", self._path)
        return self._text
