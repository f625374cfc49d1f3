"""Which program this is: what two processes must have in common to give the same last digits.

Version and code of ours, Python, and the packages that compute. The kind of processor is told
beside it: another one may round otherwise, and is no other program.
"""

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Final

from pre_core import unknowns
from schemas import topics
from services.identification import identify
from services.recordings.recording import program_version

COMPUTING: Final = ("numpy", "scipy", "numba", "llvmlite")
"""Packages of which another version may give other digits."""
PYTHON: Final = "Python"


def program() -> dict[str, str]:
    """This process's program: a version by name, `driveby` first."""
    found = {"driveby": f"{program_version()} (code {_code()})", PYTHON: platform.python_version()}
    return found | {name: metadata.version(name) for name in COMPUTING}


def another_program(theirs: Mapping[str, str], ours: Mapping[str, str]) -> str:
    """In what another process's program differs from this one's, in words; empty if in nothing."""
    names = [name for name in ours if theirs.get(name) != ours[name]]
    if not names:
        return ""
    has = ", ".join(f"{name} {theirs.get(name) or 'unknown'}" for name in names)
    here = ", ".join(f"{name} {ours[name]}" for name in names)
    return f"has {has}; here is {here}"


def processor() -> str:
    """The kind of processor that numba compiles for."""
    from llvmlite import binding

    return str(binding.get_host_cpu_name())


@cache
def _code() -> str:
    """What the sources that decide about a result are: versions do not tell two checkouts apart."""
    digest = hashlib.sha256()
    for module in _DECIDING:
        folder = Path(str(module.__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{folder.name}/{path.relative_to(folder)}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:10]


_DECIDING: Final[tuple[ModuleType, ...]] = (unknowns, topics, identify)
"""A module of each package whose sources count."""
