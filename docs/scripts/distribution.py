"""Build the source archive, and from it the wheel: the same bytes from the same sources.

    SOURCE_DATE_EPOCH=SECONDS python docs/scripts/distribution.py SOURCE OUT

SOURCE is a folder of the project's sources, not a checkout in use: building writes into it.
`make dist` gives it the files of the commit and the time of the commit. Needs setuptools only.
"""

import hashlib
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

BACKEND = "from setuptools import build_meta; build_meta.build_{}({!r})"


def build(kind: str, source: Path, out: Path) -> None:
    """Call setuptools as build frontends do: in the folder of the sources."""
    command = [sys.executable, "-c", BACKEND.format(kind, str(out))]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{kind}: {done.stderr.strip()}")


def distribution(source: Path, out: Path) -> None:
    """Write the archive and the wheel into `out`, and print the SHA-256 of each."""
    os.umask(0o022)  # modes of files are in both
    out.mkdir(parents=True, exist_ok=True)
    build("sdist", source, out)
    (archive,) = out.glob("*.tar.gz")
    with tempfile.TemporaryDirectory() as folder, tarfile.open(archive) as file:
        file.extractall(folder, filter="data")
        (unpacked,) = Path(folder).iterdir()
        build("wheel", unpacked, out)
    for path in sorted(out.iterdir()):
        sys.stdout.write(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path}\n")


if __name__ == "__main__":
    if len(sys.argv) != 3 or "SOURCE_DATE_EPOCH" not in os.environ:
        sys.exit("usage: SOURCE_DATE_EPOCH=SECONDS python docs/scripts/distribution.py SOURCE OUT")
    distribution(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
