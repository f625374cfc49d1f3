"""Source archive and wheel of the working tree."""

import os
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


def distribution(project: Path, folder: Path, modified_s: float, mode: int, umask: int) -> Path:
    """Return the folder with the source archive, and the wheel built from it.

    The sources have a time of change and a mode, and are built under a mask, of their own.
    """
    source = sources(project, folder / "source")
    for path in source.rglob("*"):
        os.utime(path, (modified_s, modified_s))
        path.chmod(0o755 if path.is_dir() else mode)
    script = project / "docs" / "scripts" / "distribution.py"
    subprocess.run(
        [sys.executable, script, source, folder / "out"],
        env=os.environ | {"SOURCE_DATE_EPOCH": "1750000000"},
        umask=umask,
        check=True,
        capture_output=True,
    )
    return folder / "out"
