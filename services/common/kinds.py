"""The kind of a file, recognised by its first bytes, so that no output replaces another kind."""

import re
from typing import Final, NamedTuple

HEAD_BYTES: Final = 1 << 16
"""Number of bytes read to recognise a kind: a site file may begin with a long comment."""

RECORDING: Final = "a recording"
SITE: Final = "a site file"
JSON: Final = "a JSON file"
TEXT: Final = "a text file"
OTHER: Final = "a file of an unknown kind"
EMPTY: Final = ""

_MAGIC: Final = (
    (b"\x89MCAP0\r\n", RECORDING),
    (b"\x89PNG\r\n\x1a\n", "a PNG picture"),
    (b"%PDF-", "a PDF file"),
    (b"PAR1", "a Parquet file"),
    (b"\x89HDF\r\n\x1a\n", "a NetCDF file"),
    (b"CDF", "a NetCDF file"),
    (b"PK\x03\x04", "an archive (ZIP, NumPy)"),
    (b"RRF", "a Rerun recording"),
    (b"SQLite format 3\x00", "a database (SQLite)"),
    (b"\x7fELF", "a program"),
    (b"\x1f\x8b", "an archive (gzip)"),
)
_SITE_TABLE: Final = re.compile(r"^[ \t]*\[\[?[ \t]*(vehicle|bridge|sensor|receiver)\b", re.M)
_FIRST_KEY: Final = re.compile(r'[\[{\s]*"((?:[^"\\]|\\.)*)"')


class Kind(NamedTuple):
    """A kind of file that an output may replace: its family and the beginning of its text."""

    name: str
    """Name in "is replaced by NAME only"."""
    family: str
    begins: str = ""
    """The first key of a JSON file, or the beginning of the first line of a text."""

    def matches(self, head: bytes) -> bool:
        """Return whether a file that begins with `head` is of this kind; an empty one always is."""
        family = family_of(head)
        if family == EMPTY:
            return True
        return family == self.family and beginning_of(head).startswith(self.begins)


RESULTS: Final = Kind("a results file", JSON, "program")
HISTORY_JSON: Final = Kind("the JSON of a history", JSON, "bridge")
SURVEY_JSON: Final = Kind("the JSON of a survey", JSON, "vehicle")
VALIDATION_JSON: Final = Kind("the JSON of a validation", JSON, "scenarios")
AIMS_JSON: Final = Kind("the JSON of a validation", JSON, "aims")
RECORDS: Final = Kind("records of a validation", JSON)
IMPORT_MAP: Final = Kind("a map of an import", TEXT, "# How driveby import reads")
HISTORY_CSV: Final = Kind("the CSV of a history", TEXT, "begin_time,end_time,element")
CATALOG_CSV: Final = Kind("the CSV of a catalogue", TEXT, "recording,vehicles,first_time")
CROSSINGS_CSV: Final = Kind("the CSV of a catalogue", TEXT, "realm,vehicle,bridge")
VALIDATION_PAGE: Final = Kind("a page of a validation", TEXT, "# Validation of method")
MCAP: Final = Kind(RECORDING, RECORDING)
RERUN: Final = Kind("a Rerun recording", "a Rerun recording")
PNG: Final = Kind("a PNG picture", "a PNG picture")
SVG: Final = Kind("an SVG picture", "an SVG picture")
HTML: Final = Kind("a web page", "a web page")
PDF: Final = Kind("a PDF file", "a PDF file")
ARRAYS: Final = Kind("an archive of arrays", "an archive (ZIP, NumPy)")
NETCDF: Final = Kind("a NetCDF file", "a NetCDF file")


def family_of(head: bytes) -> str:
    """Return the family of a file that begins with `head`; `EMPTY` for an empty file."""
    if not head:
        return EMPTY
    for magic, family in _MAGIC:
        if head.startswith(magic):
            return family
    text = _text(head)
    if text is None:
        return OTHER
    start = text.lstrip()[:200].lower()
    if start.startswith(("<!doctype html", "<html")):
        return "a web page"
    if start.startswith("<svg") or (start.startswith("<?xml") and "<svg" in text):
        return "an SVG picture"
    if _SITE_TABLE.search(text):
        return SITE
    if start.startswith(("{", "[")):
        return JSON
    return "a key or certificate (PEM)" if start.startswith("-----begin ") else TEXT


def beginning_of(head: bytes) -> str:
    """Return the first key of a JSON file, else the first line of a text; "" of other files."""
    text = _text(head) or ""
    family = family_of(head)
    if family == JSON:
        key = _FIRST_KEY.match(text)
        return key[1] if key else ""
    return text.lstrip().split("\n", 1)[0] if family == TEXT else ""


def described(head: bytes) -> str:
    """Return what a file is, in words, with its beginning."""
    beginning = beginning_of(head)
    shown = beginning if len(beginning) <= 40 else f"{beginning[:37]}..."
    return family_of(head) + (f' that begins with "{shown}"' if shown else "")


def _text(head: bytes) -> str | None:
    """Return the head of a text, whose last character may be cut; None if it is not text."""
    if b"\x00" in head:
        return None
    try:
        return head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        cut = len(head) - error.start < 4 and error.reason == "unexpected end of data"
        return head[: error.start].decode("utf-8-sig") if cut else None
