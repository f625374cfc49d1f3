"""Optional packages: which extra brings each, and the error of a command that lacks one."""

import json
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from services.common.errors import InputError

EXTRAS: Final[Mapping[str, tuple[str, ...]]] = {
    "identify": ("numba", "scipy", "threadpoolctl"),
    "view": ("matplotlib", "rerun"),
    "history": ("duckdb", "fsspec", "pyarrow"),
    "ros2": ("rosbags",),
    "s3": ("s3fs",),
    "cluster": ("distributed",),
    "notebook": ("h5netcdf", "pandas", "xarray"),
}
"""Modules of each extra of pyproject.toml."""


def check_extras(what: str, extras: Iterable[str]) -> None:
    """Raise InputError with the install command if a module of these extras is missing."""
    lacking = {extra: _missing(EXTRAS[extra]) for extra in extras}
    lacking = {extra: modules for extra, modules in lacking.items() if modules}
    if lacking:
        missing = [module for modules in lacking.values() for module in modules]
        raise InputError(_sentence(what, missing, ",".join(lacking)))


def check_installed(what: str, *modules: str, otherwise: str = "", extra: str = "notebook") -> None:
    """Raise InputError with the install command if a module is missing; imports none.

    `otherwise` names an alternative without them, `extra` the extra that contains them.
    """
    missing = _missing(modules)
    if missing:
        raise InputError(f"{_sentence(what, missing, extra)}{otherwise and f' ({otherwise})'}")


def _missing(modules: Iterable[str]) -> list[str]:
    return [module for module in modules if not _is_found(module)]


def _is_found(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # an importer may refuse it in this way
        return False


def install_command(extra: str) -> str:
    """Return the command that installs extras, from the wheel or checkout of this installation.

    There is no release on PyPI yet; where the origin is unknown or gone, WHEEL stands for it.
    """
    origin = _origin()
    if origin is None:
        return f'pip install "WHEEL[{extra}]" with your wheel of driveby'
    editable = "-e " if origin.is_dir() else ""
    return f'pip install {editable}"{origin}[{extra}]"'


def _origin() -> Path | None:
    """Return the wheel or checkout that pip has recorded for this installation (PEP 610)."""
    try:
        recorded = distribution("driveby").read_text("direct_url.json")
        url = urlsplit(json.loads(recorded or "{}").get("url", ""))
    except (PackageNotFoundError, ValueError):
        return None
    path = Path(unquote(url.path))
    return path if url.scheme == "file" and path.exists() else None


def _sentence(what: str, missing: list[str], extra: str) -> str:
    verb = "is" if len(missing) == 1 else "are"
    *first, last = missing
    named = f"{', '.join(first)} and {last}" if first else last
    return f"{what} needs {named}, which {verb} not installed: {install_command(extra)}"
