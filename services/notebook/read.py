"""Recordings and folders of CSV files as arrays, and as messages for an engine."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Final, TypeAlias

from schemas.site import Site
from schemas.site_file import load_site, parse_site
from schemas.topics import Message
from services.common.errors import InputError
from services.drives.importing import messages_of_folder, vehicle_of
from services.drives.signals import Signals, signals_of_folder, signals_of_recording
from services.notebook.arguments import known_arguments, path_of
from services.recordings.recording import read_messages, read_site

Name: TypeAlias = str | PathLike[str]

_OPTION: Final = re.compile(r"(?<![\w-])--[a-z]")
_SOURCE: Final = "a recording (.mcap) or a folder of CSV files"
_SITE: Final = "the name of a site file or what load_site() returns"


@known_arguments()
def read(
    *sources: Name, site: Name | Site | None = None, vehicle: str | None = None
) -> list[Signals]:
    """Read recordings (.mcap) and folders of CSV files, one `Signals` for each run of each truck.

    Accelerations are upward and without gravity. The site file of a CSV folder declares how they
    were measured: `site`, or `site.toml` in the folder; without one they are as in the file.
    `vehicle` selects the truck of a CSV folder for a site of several trucks. Raise InputError, in
    one line, for unreadable input.
    """
    found: list[Signals] = []
    for path in paths_of(sources):
        if not path.is_dir():
            found += signals_of_recording(path)
            continue
        known = site_of_folder(path, site)
        with _naming_import():
            if known is None:
                found += signals_of_folder(path, None, "", "")
            else:
                name = _site_name(path, site)
                found += signals_of_folder(path, known, name, vehicle_of(known, name, vehicle))
    return found


@contextmanager
def _naming_import() -> Iterator[None]:
    """Name the command of the options in errors of a folder, which Python does not have."""
    try:
        yield
    except InputError as error:
        if not _OPTION.search(str(error)):
            raise
        raise InputError(
            f"{error}; these are options of driveby import: convert the folder with it, and give "
            "its recording"
        ) from error


def paths_of(sources: Sequence[Name]) -> list[Path]:
    """Return the sources as paths; InputError if there is none or one does not exist."""
    if not sources:
        raise InputError("no source given, a recording (.mcap) or a folder of CSV files expected")
    paths = [path_of("source", source, _SOURCE) for source in sources]
    for path in paths:
        if not path.exists():
            raise InputError(
                f"{path}: no such file, a recording (.mcap) or a folder of CSV files expected"
            )
    return paths


def site_of_paths(paths: Sequence[Path], site: Name | Site | None) -> Site:
    """Return the given site, or that of the first source that has one; InputError without any."""
    for path in paths:
        if site is not None:
            return given_site(site)
        if path.is_dir():
            known = site_of_folder(path, None)
        else:
            text = read_site(path)
            known = None if text is None else parse_site(text, f"{path}: site.toml")
        if known is not None:
            return known
    raise InputError(f"{paths[0]}: no site file is stored with it, give one with site=")


def messages_of_paths(
    paths: Sequence[Path], site: Site, given: Name | Site | None, vehicle: str | None
) -> Iterator[Message]:
    """Yield all messages of the sources; of a CSV folder those that its truck would have sent."""
    for path in paths:
        if path.is_dir():
            with _naming_import():
                yield from messages_of_folder(path, site, _site_name(path, given), vehicle)
        else:
            yield from read_messages(path)


def given_site(site: Name | Site) -> Site:
    """Return the site, read if it is the name of a file."""
    return site if isinstance(site, Site) else load_site(path_of("site", site, _SITE))


def site_of_folder(folder: Path, site: Name | Site | None) -> Site | None:
    """Return the given site, or `site.toml` in the folder; None if there is neither."""
    if site is not None:
        return given_site(site)
    beside = folder / "site.toml"
    return load_site(beside) if beside.is_file() else None


def _site_name(folder: Path, site: Name | Site | None) -> str:
    if isinstance(site, Site):
        return "site"
    return str(folder / "site.toml" if site is None else site)
