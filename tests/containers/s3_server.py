"""An S3 server as processes on loopback: OpenStack Swift with its S3 API.

python -m venv build/containers/swift
build/containers/swift/bin/pip install swift==2.38.3
"""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from tests.containers.stack import ROOT
from tests.endpoints import free_port
from tests.waiting import LONGEST_S, until

INSTALLED = ROOT / "build" / "containers" / "swift" / "bin"
OWNER, READER, SECRET = "test:owner", "test:reader", "a-secret-of-this-test"
"""Keys of the bucket's owner, of one who may do what everyone may, and the secret of both."""

PROXY, OBJECT = "proxy", "object"
STORES = ("account", "container", OBJECT)
_DEFAULTS = """
[DEFAULT]
bind_ip = 127.0.0.1
bind_port = {port}
swift_dir = {root}
devices = {root}
mount_check = false
workers = 0
user = {user}
log_address = {root}/no-log
"""
_PROXY = f"""
[pipeline:main]
pipeline = catch_errors s3api tempauth bulk slo proxy-server
[app:proxy-server]
use = egg:swift#proxy
account_autocreate = true
[filter:catch_errors]
use = egg:swift#catch_errors
[filter:s3api]
use = egg:swift#s3api
[filter:tempauth]
use = egg:swift#tempauth
user_{OWNER.replace(":", "_")} = {SECRET} .admin
user_{READER.replace(":", "_")} = {SECRET}
[filter:bulk]
use = egg:swift#bulk
[filter:slo]
use = egg:swift#slo
"""
_STORE = """
[pipeline:main]
pipeline = {name}-server
[app:{name}-server]
use = egg:swift#{name}
"""


def find() -> Path | None:
    """Return the folder of Swift's programs: from the variable SWIFT, PATH, or build/containers."""
    given = os.environ.get("SWIFT") or shutil.which("swift-proxy-server")
    if given:
        return Path(given) if Path(given).is_dir() else Path(given).parent
    return INSTALLED if INSTALLED.exists() else None


class S3Server:
    """A server with a single disk, which can be killed and started again."""

    def __init__(self, programs: Path, root: Path) -> None:
        self._programs = programs
        self._root = root
        self._ports = {name: free_port() for name in (PROXY, *STORES)}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        (root / "disk").mkdir()
        (root / "swift.conf").write_text("[swift-hash]\nswift_hash_path_suffix = test\n")
        user = pwd.getpwuid(os.geteuid()).pw_name
        for name, port in self._ports.items():
            rest = _PROXY if name == PROXY else _STORE.format(name=name)
            settings = _DEFAULTS.format(port=port, root=root, user=user)
            (root / f"{name}.conf").write_text(settings + rest)
        for name in STORES:
            place = f"r1z1-127.0.0.1:{self._ports[name]}/disk"
            for words in (["create", "4", "1", "0"], ["add", place, "1"], ["rebalance"]):
                command = [str(programs / "swift-ring-builder"), str(root / f"{name}.builder")]
                subprocess.run([*command, *words], check=True, capture_output=True)

    def environment(self, key: str = OWNER, secret: str = SECRET) -> dict[str, str]:
        """Return the variables by which commands reach the server."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self._ports[PROXY]}",
            "AWS_ACCESS_KEY_ID": key,
            "AWS_SECRET_ACCESS_KEY": secret,
            "AWS_DEFAULT_REGION": "us-east-1",
        }

    def start(self) -> None:
        for name, port in self._ports.items():
            with (self._root / f"{name}.log").open("ab") as log:
                self._processes[name] = subprocess.Popen(
                    [self._programs / f"swift-{name}-server", self._root / f"{name}.conf"],
                    stdout=log,
                    stderr=log,
                )
            until(partial(self._listens, name, port), f"an S3 server whose {name} listens")

    def kill(self) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait(LONGEST_S)

    def bytes_read(self) -> int:
        """Return the bytes that the server of objects has read, from its disk above all."""
        io = Path(f"/proc/{self._processes[OBJECT].pid}/io").read_text()
        return int(io.partition("rchar: ")[2].split()[0])

    def _listens(self, name: str, port: int) -> bool:
        assert self._processes[name].poll() is None, (self._root / f"{name}.log").read_text()
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def s3_server(programs: Path) -> Iterator[S3Server]:
    with tempfile.TemporaryDirectory(prefix="driveby-s3-") as folder:
        server = S3Server(programs, Path(folder))
        try:
            server.start()
            yield server
        finally:
            server.kill()
