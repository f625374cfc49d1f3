"""The units of systemd start commands that exist, in a sandbox, and stop them as the pages say."""

import re
import shlex
import shutil
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest

from services.cli import main as cli
from services.cli.table import name_of

ROOT = Path(__file__).parents[2]
UNITS = {path.stem.removeprefix("driveby-"): path for path in (ROOT / "deploy").glob("*.service")}
PROGRAM = "/opt/driveby/bin/driveby"
SANDBOX = {
    "CapabilityBoundingSet": "",
    "LockPersonality": "yes",
    "NoNewPrivileges": "yes",
    "PrivateDevices": "yes",
    "PrivateTmp": "yes",
    "PrivateUsers": "yes",
    "ProtectClock": "yes",
    "ProtectControlGroups": "yes",
    "ProtectHome": "yes",
    "ProtectHostname": "yes",
    "ProtectKernelLogs": "yes",
    "ProtectKernelModules": "yes",
    "ProtectKernelTunables": "yes",
    "ProtectProc": "invisible",
    "ProtectSystem": "strict",
    "RemoveIPC": "yes",
    "RestrictAddressFamilies": "AF_INET AF_INET6 AF_NETLINK AF_UNIX",
    "RestrictNamespaces": "yes",
    "RestrictRealtime": "yes",
    "RestrictSUIDSGID": "yes",
    "SystemCallArchitectures": "native",
    "SystemCallErrorNumber": "EPERM",
}
EXPOSURE = 20
"""Largest exposure in tenths, of which 0 is none and 100 all, by `systemd-analyze security`."""


def unit(name: str) -> ConfigParser:
    """Return a unit; of a key that is there twice the last value."""
    parser = ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(UNITS[name].read_text())
    return parser


def test_logger_and_worker_have_units() -> None:
    assert set(UNITS) == {"logger", "worker"}


@pytest.mark.parametrize("name", UNITS)
def test_unit_starts_its_command(name: str, tmp_path: Path) -> None:
    service = unit(name)["Service"]
    program, *arguments = shlex.split(service["ExecStart"])
    assert program == PROGRAM
    assert arguments[-2:] == ["--config", f"/etc/driveby/{name}.toml"]
    example = (ROOT / "deploy" / f"{name}.toml").read_text()
    complete = re.sub(r"^# (?=[a-z_]+ = )", "", example, flags=re.MULTILINE)
    assert complete != example
    for number, text in enumerate((example, complete)):
        config = tmp_path / f"{number}.toml"
        config.write_text(text)
        options = cli._parser().parse_args([*arguments[:-1], str(config)])
        assert name_of(options) == name
        assert name in cli._SERVICES
        assert options.folder == Path("recordings")
        assert options.site == Path("/etc/driveby/site.toml")
        assert (options.tls is not None) == (text == complete)
    assert service["WorkingDirectory"] == f"/var/lib/{service['StateDirectory']}"
    assert service["RestartPreventExitStatus"] == str(cli.EXIT_BAD_INPUT)


@pytest.mark.parametrize("name", UNITS)
def test_unit_is_confined(name: str) -> None:
    service = unit(name)["Service"]
    assert {key: service.get(key) for key in SANDBOX} == SANDBOX
    filters = re.findall(r"^SystemCallFilter=(.*)$", UNITS[name].read_text(), re.MULTILINE)
    assert filters == ["@system-service", "~@privileged"]
    # numba compiles in the worker's memory; a logger compiles nothing.
    assert service["MemoryDenyWriteExecute"] == ("no" if name == "worker" else "yes")
    assert service["User"] != "root"


def test_worker_has_the_time_that_its_page_allows() -> None:
    page = (ROOT / "docs" / "worker.md").read_text()
    stop = unit("worker")["Service"]["TimeoutStopSec"]
    assert f"`TimeoutStopSec={stop}`" in page
    assert unit("worker")["Service"]["ExecReload"] == "kill -HUP $MAINPID"
    assert "driveby-logger.service" in unit("worker")["Unit"]["After"].split()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_units(tmp_path: Path) -> None:
    paths = []
    for path in UNITS.values():
        copy = tmp_path / path.name
        copy.write_text(path.read_text().replace(PROGRAM, sys.executable))
        paths.append(str(copy))
    done = subprocess.run(
        ["systemd-analyze", "verify", *paths], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    for verified in paths:
        security = ["systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE}"]
        done = subprocess.run([*security, verified], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
