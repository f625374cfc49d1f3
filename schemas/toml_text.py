"""TOML text from untrusted sources, checked before parsing because tomllib's cost has no bound.

tomllib keeps a namespace for every prefix of every key, so that 60 KB of one dotted key take
gigabytes. One pass counts keys and brackets outside strings and comments. Up to the first syntax
error it splits the text as tomllib does; beyond that nothing is parsed.
"""

import re
import stat
import tomllib
from pathlib import Path
from typing import Any, Final

from schemas.errors import InputError

MAX_BYTES: Final = 16 << 20
"""Largest file; a site file of this size has some 20,000 bridges."""
MAX_DEPTH: Final = 8
"""Largest number of parts of a dotted key, and of nested tables and lists; a site file needs two.
"""
MAX_DEEP: Final = 1000
"""Largest number of keys with three parts or more, each of which costs tomllib its depth squared.
"""
MAX_KEYS: Final = 500_000
MAX_BRACKETS: Final = 150_000
"""Largest number of tables and lists together; `[[bridge]]` counts twice."""

# `(?!)`, which never matches, ends the alternatives of repeated groups: Python before 3.11.5 goes
# on where the last alternative has failed rather than where it began.
_PART = r'(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]++|\\.|(?!))*+"|\'[^\'\n]*+\')'
_SCAN: Final = re.compile(
    r"#[^\n]*+"
    r'|"""(?:[^"\\]++|\\[\s\S]|"(?!"")|(?!))*+"""(?:"{0,2}+)'
    r"|'''(?:[^']++|'(?!'')|(?!))*+'''(?:'{0,2}+)"
    rf"|(?P<deep>{_PART}(?:[ \t]*+\.[ \t]*+{_PART}|(?!)){{2,}}+)"
    rf"|{_PART}(?:[ \t]*+\.[ \t]*+{_PART}|(?!))?+"
    r"|(?P<open>[\[{])|(?P<close>[\]}])|(?P<key>=)|(?P<end>[\"'])"
)
_DECIMAL_COMMA: Final = re.compile(
    r"[ \t]*[A-Za-z0-9_-]+[ \t]*=[ \t]*([+-]?\d+),(\d+(?:[eE][+-]?\d+)?)[ \t]*(?:#.*)?"
)
_DOT: Final = re.compile(rf"{_PART}(?P<dot>[ \t]*+\.)?")


def read_toml_text(path: Path, what: str) -> str:
    """Return the text of a file; raise InputError if it cannot be read or exceeds `MAX_BYTES`.

    `what` is the expected kind of file, such as "a site file".
    """
    expected = f"{what} (TOML) is expected"
    try:
        # A pipe or a device may never end or never begin, so check before opening.
        if not stat.S_ISREG(path.stat().st_mode) and not path.is_dir():
            raise InputError(f"{path}: is not an ordinary file, {expected}")
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file, {expected}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: is larger than {MAX_BYTES >> 20} MiB, {expected}")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text, {expected}") from error


def parse_toml(text: str, source_name: str) -> dict[str, Any]:
    """Return the content of TOML text; raise an InputError that begins with `source_name`.

    Text that would take more time and memory than any site file is refused unparsed.
    """
    too_much = _too_much(text)
    if too_much:
        raise InputError(f"{source_name}: {too_much}")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a number of 5,000 digits is a plain ValueError
        raise InputError(f"{source_name}: {_syntax(str(error), text)}") from error


def _too_much(text: str) -> str | None:
    """Return why a text is too complex for a site file; None if it is not."""
    # A character takes up to four bytes: counting them is only worth it where it can matter.
    if len(text) > MAX_BYTES or (
        len(text) > MAX_BYTES // 4 and len(text.encode(errors="replace")) > MAX_BYTES
    ):
        return f"is larger than {MAX_BYTES >> 20} MiB"
    depth = brackets = deep = keys = 0
    for token in _SCAN.finditer(text):
        match token.lastgroup:
            case "open":
                depth, brackets = depth + 1, brackets + 1
                if depth > MAX_DEPTH:
                    return f"{_line(text, token)}: is more than {MAX_DEPTH} deep in brackets"
            case "close":
                depth = max(0, depth - 1)
            case "key":
                keys += 1
            case "end":  # an unterminated string: tomllib stops here as well
                return None
            case "deep":
                deep += 1
                if sum(part["dot"] is not None for part in _DOT.finditer(token[0])) >= MAX_DEPTH:
                    return f"{_line(text, token)}: a key is more than {MAX_DEPTH} deep"
            case _:
                continue
        for count, most, name in (
            (deep, MAX_DEEP, "keys of three parts or more"),
            (keys, MAX_KEYS, "keys"),
            (brackets, MAX_BRACKETS, "tables and lists"),
        ):
            if count > most:
                return f"has more than {most} {name}"
    return None


def _line(text: str, token: re.Match[str]) -> str:
    return f"line {text.count(chr(10), 0, token.start()) + 1}"


def _syntax(message: str, text: str) -> str:
    """Return tomllib's message in our form: the line first."""
    match = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|(end of document))\)", message)
    if match is None:
        return f"is not TOML: {message}"
    row = int(match[2]) if match[2] else 0
    comma = _DECIMAL_COMMA.fullmatch(text.split("\n")[row - 1]) if row else None
    if comma is not None:
        return (
            f"line {row}: is not TOML: {comma[1]},{comma[2]} has a decimal comma, "
            f"TOML has a point: {comma[1]}.{comma[2]}"
        )
    line = text.split("\n")[row - 1] if row else ""
    if re.fullmatch(r"[^=#]*=\s*[\d.]+,\d+\s*(#.*)?", line):
        return f"line {row}: is not TOML: a decimal comma, or points between thousands: 16000.0"
    unit = re.fullmatch(r"[^=#]*=\s*([-+\d.eE]+)\s*[^\d\s#,.\]][^#]*(#.*)?", line)
    if unit is not None:
        return f"line {row}: is not TOML: a number without a unit expected: {unit[1]}"
    if match[4]:
        return f"line {len(text.splitlines())}: is not TOML: {match[1]} before the end of the file"
    return f"line {match[2]}, column {match[3]}: is not TOML: {match[1]}"
