"""The units of systemd start commands that exist, in a sandbox, and stop them as the pages say."""

import re
import shlex
import shutil
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest

from services.bus.playback import DELIVERY_TIMEOUT_S
from services.cli import main as cli
from services.cli.table import name_of
from services.common.errors import InputError

ROOT = Path(__file__).parents[2]
UNITS = {path.stem.removeprefix("driveby-"): path for path in (ROOT / "deploy").glob("*.service")}
SERVICES = ("logger", "worker")
TRUCK = "truck"
"""Unit of a truck's computer, which needs no file of options."""
JOBS = ("health", "night")
"""Units that a timer starts."""
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


def test_services_and_jobs_have_units() -> None:
    assert set(UNITS) == {*SERVICES, TRUCK, *JOBS}


@pytest.mark.parametrize("name", JOBS)
def test_timer_starts_its_job(name: str) -> None:
    timer = UNITS[name].with_suffix(".timer").read_text()
    assert re.search(r"^OnCalendar=\S", timer, re.MULTILINE)
    assert "WantedBy=timers.target" in timer
    assert unit(name)["Service"]["Type"] == "oneshot"
    assert f"enable --now driveby-{name}.timer" in UNITS[name].read_text()


def test_truck_unit_starts_the_gateway_with_a_spool() -> None:
    service, text = unit(TRUCK)["Service"], UNITS[TRUCK].read_text()
    program, *arguments, bus = shlex.split(service["ExecStart"])
    assert (program, bus) == (PROGRAM, "$BUS")
    (shown,) = re.findall(r'Environment="BUS=(.+)"', text)
    options = cli._parser().parse_args([*arguments, *shown.split()])
    assert name_of(options) == "gateway"
    assert (options.spool, options.endpoint) == (Path("spool"), "tls/HOST:7447")
    assert options.site == Path("/etc/driveby/site.toml")
    assert options.tls == Path(f"/etc/driveby/tls/{TRUCK}")
    # By default the bus would be the router of ROS.
    with pytest.raises(InputError, match="--endpoint: expected one argument"):
        cli._parser().parse_args(arguments)
    assert f"`cp -r certs/truck-1 /etc/driveby/tls/{TRUCK}`" in text
    assert service["WorkingDirectory"] == f"/var/lib/{service['StateDirectory']}"
    assert service["RestartPreventExitStatus"] == str(cli.EXIT_BAD_INPUT)
    assert int(service["TimeoutStopSec"]) > DELIVERY_TIMEOUT_S
    # A truck without a network starts, too.
    assert "network-online.target" not in text
    assert f"(../deploy/driveby-{TRUCK}.service)" in (ROOT / "docs/install.md").read_text()


def test_health_unit_queries_logger_and_worker() -> None:
    text = UNITS["health"].read_text()
    starts = re.findall(rf"^ExecStart={PROGRAM} (.*) \$BUS$", text, re.MULTILINE)
    (shown,) = re.findall(r'Environment="BUS=(-.*)"', text)
    for start, name in zip(starts, SERVICES, strict=True):
        options = cli._parser().parse_args([*start.split(), *shown.split()])
        assert (name_of(options), options.service) == ("health", name)
        assert options.tls == Path("/etc/driveby/tls/viewer")


def test_health_unit_names_the_option_of_another_address() -> None:
    text = UNITS["health"].read_text()
    (shown,) = re.findall(r"^# .*\badd `(--endpoint \S+)` .*to BUS", text, re.MULTILINE)
    options = cli._parser().parse_args(["health", "logger", *shown.split()])
    assert options.endpoint == "tcp/HOST:PORT"


def test_night_unit_runs_the_script_with_its_arguments() -> None:
    service = unit("night")["Service"]
    shell, script, *arguments = shlex.split(service["ExecStart"])
    name = Path(script).name
    example = (ROOT / "docs" / "examples" / "fleet_night" / name).read_text()
    assert shell == "/bin/sh"
    assert f"{name} RECORDINGS SITE.toml TEMPERATURES.csv" in example
    assert arguments[:2] == ["recordings", "/etc/driveby/site.toml"]
    assert len(arguments) == 3
    assert f"PATH={Path(PROGRAM).parent}:" in UNITS["night"].read_text()


def test_installation_is_one_numbered_list_to_which_the_units_refer() -> None:
    page = (ROOT / "docs/install.md").read_text()
    steps = re.findall(r"^(\d)\. (.*)$", page, re.MULTILINE)
    assert [int(number) for number, _ in steps] == list(range(1, len(steps) + 1))
    listed = "\n".join(step for _, step in steps)
    for needed in ("-m venv /opt/driveby", "useradd", "daemon-reload", "/etc/systemd/system/"):
        assert needed in listed
    for name in SERVICES:
        assert f"driveby-{name}" in listed
        text = " ".join(UNITS[name].read_text().replace("#", " ").split())
        assert "installation: docs/install.md, Services" in text
        assert "useradd" not in text


def test_uninstallation_removes_everything_but_the_data() -> None:
    page = (ROOT / "docs/install.md").read_text()
    (line,) = [one for one in page.splitlines() if "`systemctl disable --now" in one]
    (removed,) = re.findall(r"`rm -rf (.*?)`", line)
    installed = {"/opt/driveby", "/etc/driveby", "/etc/systemd/system/driveby-*"}
    caches = {unit(name)["Service"].get("CacheDirectory") for name in UNITS} - {None}
    assert set(removed.split()) == installed | {f"/var/cache/{name}" for name in caches}
    assert "`systemctl daemon-reload`" in line
    for name in {unit(name)["Service"]["User"] for name in UNITS}:
        assert f"`userdel {name}`" in line


def test_installation_places_credentials_where_the_options_expect_them() -> None:
    installed = (ROOT / "docs/install.md").read_text()
    (copied,) = re.findall(r"`cp -r (.*?) /etc/driveby/tls`", installed)
    places = {f"/etc/driveby/tls/{Path(one).name}" for one in copied.split()}
    on_server = set((ROOT / "deploy").iterdir()) - {UNITS[TRUCK]}
    named = "".join(path.read_text() for path in sorted(on_server))
    assert set(re.findall(r"/etc/driveby/tls/\w+", named)) == places


@pytest.mark.parametrize("name", SERVICES)
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
    # numba compiles in memory where crossings are identified, and only there.
    assert service["MemoryDenyWriteExecute"] == ("no" if name in ("worker", "night") else "yes")
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
    for name in JOBS:
        shutil.copy(UNITS[name].with_suffix(".timer"), tmp_path)
        paths.append(str(tmp_path / f"driveby-{name}.timer"))
    done = subprocess.run(
        ["systemd-analyze", "verify", *paths], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    for verified in [path for path in paths if path.endswith(".service")]:
        security = ["systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE}"]
        done = subprocess.run([*security, verified], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
