"""Optional packages: which extra brings each, and the error of a command that lacks one."""

from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from typing import Final

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
    """InputError that says how to install them if a module of these extras is missing."""
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


def _sentence(what: str, missing: list[str], extra: str) -> str:
    verb = "is" if len(missing) == 1 else "are"
    *first, last = missing
    named = f"{', '.join(first)} and {last}" if first else last
    return f'{what} needs {named}, which {verb} not installed: pip install "driveby[{extra}]"'
