"""An S3 server as a process on loopback: s3s-fs, whose buckets are folders."""

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.containers.stack import ROOT
from tests.endpoints import free_port
from tests.waiting import LONGEST_S, until

COMPILED = ROOT / "build" / "containers" / "bin" / "s3s-fs"
KEY, SECRET = "driveby", "a secret of this test"
NOBODY = 65534


def find() -> str | None:
    """Return the path of `s3s-fs`: from the variable S3S_FS, PATH, or build/containers."""
    given = os.environ.get("S3S_FS") or shutil.which("s3s-fs")
    return given or (str(COMPILED) if COMPILED.exists() else None)


class S3Server:
    """A server with one bucket, which can be killed and started again."""

    def __init__(self, program: str, root: Path) -> None:
        self._command = [
            program,
            "--host",
            "127.0.0.1",
            "--access-key",
            KEY,
            "--secret-key",
            SECRET,
        ]
        self._root = root
        self._port = free_port()
        self._process: subprocess.Popen[bytes] | None = None
        self.bucket.mkdir()

    @property
    def bucket(self) -> Path:
        return self._root / "bucket"

    def environment(self, key: str = KEY, secret: str = SECRET) -> dict[str, str]:
        """Return the variables by which commands reach the server."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self._port}",
            "AWS_ACCESS_KEY_ID": key,
            "AWS_SECRET_ACCESS_KEY": secret,
            "AWS_DEFAULT_REGION": "us-east-1",
        }

    def start(self) -> None:
        """Start the server; root's would write everywhere, so it is another user's."""
        user = NOBODY if os.geteuid() == 0 else None
        if user is not None:
            shutil.chown(self._root, user)
            for path in self._root.rglob("*"):
                shutil.chown(path, user)
        self._process = subprocess.Popen(
            [*self._command, "--port", str(self._port), str(self._root)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            user=user,
        )
        until(self._listens, "an S3 server that listens")

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(LONGEST_S)

    def bytes_read(self) -> int:
        """Return the bytes that the server has read, from its disk above all."""
        assert self._process is not None
        io = Path(f"/proc/{self._process.pid}/io").read_text()
        return int(io.partition("rchar: ")[2].split()[0])

    def _listens(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self._port)) == 0


@contextmanager
def s3_server(program: str) -> Iterator[S3Server]:
    # Not in pytest's folder, in which another user may not even search.
    with tempfile.TemporaryDirectory(prefix="driveby-s3-") as folder:
        Path(folder).chmod(0o755)
        server = S3Server(program, Path(folder))
        server.start()
        try:
            yield server
        finally:
            server.kill()
