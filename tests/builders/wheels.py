"""The wheel of the working tree."""

import shutil
import subprocess
import sys
from pathlib import Path

INNER = ("pre_core", "schemas", "services")


def sources(project: Path, folder: Path) -> Path:
    """Return the folder after copying into it what a distribution is built from, and studies."""
    for name in ("driveby", "studies", *INNER):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(project / name, folder / name, ignore=ignored)
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(project / name, folder / name)
    return folder


def built(project: Path, folder: Path) -> Path:
    """Return the wheel after building it in an empty folder."""
    source = sources(project, folder)
    # As pip does, which starts further processes to ask what the build needs.
    build = "from setuptools import build_meta; build_meta.build_wheel('dist')"
    subprocess.run([sys.executable, "-c", build], cwd=source, check=True, capture_output=True)
    (found,) = (source / "dist").glob("*.whl")
    return found
