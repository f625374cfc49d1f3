"""Identity of the program: two processes that agree in it give the same last digits.

It covers driveby's version and code, Python, and the packages that compute. The kind of processor
is separate: another one may round differently, and is not another program.
"""

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Final

from pre_core import parameters
from schemas import topics
from services.finding import crossing_data
from services.identification import identify
from services.recordings.recording import program_version

COMPUTING: Final = ("numpy", "scipy", "numba", "llvmlite")
"""Packages of which another version may give other digits."""
PYTHON: Final = "Python"


def program() -> dict[str, str]:
    """Return this process's program: a version by name, `driveby` first."""
    found = {"driveby": f"{program_version()} (code {_code()})", PYTHON: platform.python_version()}
    return found | {name: metadata.version(name) for name in COMPUTING}


def version_difference(theirs: Mapping[str, str], ours: Mapping[str, str]) -> str:
    """Return how another process's program differs from this one's, in words; empty if equal."""
    names = [name for name in ours if theirs.get(name) != ours[name]]
    if not names:
        return ""
    has = ", ".join(f"{name} {theirs.get(name) or 'unknown'}" for name in names)
    here = ", ".join(f"{name} {ours[name]}" for name in names)
    return f"has {has}; here is {here}"


def processor() -> str:
    """Return the kind of processor that numba compiles for."""
    from llvmlite import binding

    return str(binding.get_host_cpu_name())


@cache
def _code() -> str:
    """Return a hash of the sources that determine a result: two checkouts may share a version."""
    digest = hashlib.sha256()
    for module in _DECIDING:
        folder = Path(str(module.__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{folder.name}/{path.relative_to(folder)}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:10]


_DECIDING: Final[tuple[ModuleType, ...]] = (parameters, topics, crossing_data, identify)
"""A module of each package whose sources count."""
