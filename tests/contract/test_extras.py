"""What each extra brings, what commands need of them, and that they run with that and no more."""

import gzip
import importlib.util
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin

from schemas.site_file import site_toml
from services.cli import main as cli
from services.cli.table import COMMANDS
from services.common.errors import InputError
from services.common.extras import EXTRAS, check_extras, check_installed, install_command
from services.simulation.drive import paper_site
from tests import ros2
from tests.builders.processes import stop
from tests.endpoints import free_endpoint
from tests.unit.drives.test_ros2_recording import drive

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "recordings" / "sample" / "crossing.mcap"
CSV_EXAMPLE = ROOT / "tests" / "data" / "csv_example"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MODULES = {"rerun-sdk": "rerun"}
"""Modules of packages that have another name."""
LIGHT = ("numba", "scipy", "threadpoolctl", "matplotlib", "rerun", "duckdb", "fsspec", "pyarrow")
WITHOUT = (
    "pre_core",
    "pre_core.constants",
    "services.bus.session",
    "services.cli.realm_model",
    "services.drives.importing",
    "services.export.signal_tables",
    "services.ledger.processed",
    "services.logger.run",
    "services.recordings.recovery",
    "services.replay.run",
    "services.truck.run",
    "services.truck.ros2",
)
"""Modules that are imported without any of these packages."""
IN_ORDER = """
from services.cli.main import main
for words in {}:
    assert main(words) == 0, words
"""


def test_modules_import_nothing_that_computes_draws_or_stores() -> None:
    """Imported one after the other in one process, so that the first one at fault is named."""
    code = (
        "import importlib, sys\n"
        f"for module in {WITHOUT!r}:\n"
        "    importlib.import_module(module)\n"
        f"    found = sorted(set({LIGHT!r}) & sys.modules.keys())\n"
        "    assert not found, (module, found)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# The tables


def packages_of(requirements: list[str]) -> set[str]:
    return {re.split(r"[^\w-]", one)[0] for one in requirements}


def test_extras_are_those_of_the_project() -> None:
    declared = PROJECT["optional-dependencies"]
    for extra, modules in EXTRAS.items():
        packages = packages_of(declared[extra])
        assert {MODULES.get(name, name) for name in packages} == set(modules), extra
    (everything,) = declared["all"]
    assert set(re.findall(r"\w+", everything)) == {"driveby", *EXTRAS}
    assert "driveby[all]" in declared["dev"]
    core = packages_of(PROJECT["dependencies"])
    assert not [extra for extra in EXTRAS if core & packages_of(declared[extra])]


def test_every_command_says_what_it_needs() -> None:
    (commands,) = (
        action.choices for action in cli.whole_parser()._actions if isinstance(action.choices, dict)
    )
    assert list(COMMANDS) == list(commands)
    for name, needs in COMMANDS.items():
        known = {action.dest for action in commands[name]._actions}
        assert {option.partition("=")[0] for option in needs.by_option} <= known
        assert {*needs.always, *(x for more in needs.by_option.values() for x in more)} <= {*EXTRAS}


def test_the_page_has_every_extra_and_what_commands_need() -> None:
    commands = (ROOT / "docs" / "commands.md").read_text()
    for name, needs in COMMANDS.items():
        (row,) = re.findall(rf"^\| `driveby {name}` \|.*$", commands, re.MULTILINE)
        cell = row.split(" | ")[3]
        for extra in (*needs.always, *(x for more in needs.by_option.values() for x in more)):
            assert f"`{extra}`" in cell, name
        for option in needs.by_option:
            assert f"`--{option.replace('=', ' ')}`" in cell, name
    install = (ROOT / "docs" / "install.md").read_text()
    for extra in EXTRAS:
        packages = ", ".join(sorted(packages_of(PROJECT["optional-dependencies"][extra])))
        assert f"| `{extra}` | {packages} |" in install
    core = ", ".join(sorted(packages_of(PROJECT["dependencies"])))
    assert f"| none | {core} |" in install


# What is missing is said before any work

ARGUMENTS = {
    "alarm": ["check"],
    "catalog": ["folder"],
    "certs": ["folder"],
    "check": ["source"],
    "export": ["source", "--to", "folder"],
    "fuse": ["results.json"],
    "gateway": ["ros2", "--ros", "tcp/127.0.0.1:7447", "--site", "site.toml"],
    "identify": ["source"],
    "import": ["source", "--site", "site.toml", "-o", "out.mcap"],
    "report": ["results.json", "-o", "report.html"],
    "simulate": ["--scenario", "6", "-o", "out.mcap"],
    "survey": ["--site", "site.toml"],
    "view": ["results.json"],
    "worker": ["--site", "site.toml"],
}
VALUES = {"figure": ["plan.png"], "view": [], "web": [], "format=parquet": ["parquet"]}
"""Values of options; others take a name."""
LACKING = [
    (command, option)
    for command, needs in COMMANDS.items()
    for option in ([None] if needs.always else []) + list(needs.by_option)
]


@pytest.mark.parametrize(("command", "option"), LACKING)
def test_a_missing_extra_is_one_line_before_any_work(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    command: str,
    option: str | None,
) -> None:
    needs = COMMANDS[command]
    wanted = needs.always if option is None else needs.by_option[option]
    there = {module for extra in {*EXTRAS} - {*wanted} for module in EXTRAS[extra]}
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "services.common.extras.find_spec", lambda name: find(name) if name in there else None
    )
    monkeypatch.chdir(tmp_path)
    arguments = [command, *ARGUMENTS.get(command, [])]
    if option is not None:
        arguments += [f"--{option.partition('=')[0]}", *VALUES.get(option, ["name"])]
    assert cli.main(arguments) == 2
    out, error = capsys.readouterr()
    assert (out, error.count("\n")) == ("", 1)
    assert error.startswith(f"driveby: driveby {command} needs ")
    extras = [extra for extra in EXTRAS if extra in wanted]
    assert sorted(re.findall(r"\[(.*)\]", error)[0].split(",")) == sorted(extras)
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_not_missing() -> None:
    check_extras("it", EXTRAS)
    with pytest.raises(InputError, match="it needs no_such_module, which is not installed"):
        check_installed("it", "no_such_module", "numpy")


# Commands with their extras and no others


def write_files(folder: Path) -> Path:
    """Write a recording, results beside the drive that they come from, and a history."""
    (folder / "recordings").mkdir()
    shutil.copy(SAMPLE, folder / "recordings" / "crossing.mcap")
    (before, *_) = sorted((ROOT / "tests" / "data" / "before").iterdir())
    (folder / "results.json").write_bytes(
        gzip.decompress((before / "pre-result.json.gz").read_bytes())
    )
    shutil.copy(before / "drive.mcap", folder / "drive.mcap")
    shutil.copytree(before / "history", folder / "history")
    return folder


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_files(tmp_path_factory.mktemp("files"))


def run(extras: str, *words: str, code: int = 0) -> str:
    """Run `driveby` (or python) with these extras only."""
    what = [] if words[0] == "python" else ["driveby"]
    command = [sys.executable, "-m", "tests.builders.without", extras, *what, *words]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout + done.stderr


RUNS = {
    "": (
        "info {}/recordings/crossing.mcap",
        "info {}/recordings",
        "export {}/recordings/crossing.mcap --to {}/csv",
        "export {}/results.json --to {}/tables",
        "recover {}/recordings/crossing.mcap -o {}/recovered.mcap",
        "certs {}/certs",
        f"import {CSV_EXAMPLE} --site {CSV_EXAMPLE}/site.toml -o {{}}/csv.mcap",
    ),
    "history": (
        "export {}/recordings/crossing.mcap --to {}/pq --format parquet",
        "catalog {}/recordings",
    ),
    "view": ("report {}/results.json -o {}/report.html",),
    "identify": (
        "check --template {}/template.toml",
        "simulate --scenario 6 --rate 200 -o {}/simulated.mcap",
        "fuse {}/results.json",
        "validate --scenarios 6 --particles 5 --steps 2",
        "identify {}/recordings/crossing.mcap --json {}/found.json",
    ),
    "identify,view": (
        "identify {}/recordings/crossing.mcap --method least-squares --rrd {}/a.rrd --figures {}/a",
    ),
    "identify,history": (
        "identify {}/recordings --method least-squares --into {}/identified",
        "history bridge-2 --history {}/history --csv {}/history.csv",
        "alarm check --history {}/history",
    ),
}
"""Commands by the extras that they need, each set in one process."""


@pytest.mark.parametrize("extras", RUNS)
def test_commands_run_with_their_extras_only(files: Path, extras: str) -> None:
    commands = [command.replace("{}", str(files)).split() for command in RUNS[extras]]
    run(extras, "python", IN_ORDER.format(commands))


def test_an_import_of_ros_2_needs_its_extra_only(tmp_path: Path) -> None:
    site, out = tmp_path / "site.toml", str(tmp_path / "out.mcap")
    site.write_text(site_toml(paper_site()) + ros2.ROS2)
    source = ros2.record(tmp_path / "bag", drive(1.0), StoragePlugin.MCAP)
    words = ("import", str(source), "--site", str(site), "-o", out)
    assert install_command("ros2") in run("", *words, code=2)
    run("ros2", *words)
    assert Path(out).is_file()


def test_a_cluster_needs_two_extras(tmp_path: Path) -> None:
    printed = run("identify,cluster", "cluster", "--tls", f"{tmp_path}/none", code=2)
    assert f"{tmp_path}/none" in printed


def test_tables_need_the_extra_of_notebooks() -> None:
    code = f"import driveby; (one,) = driveby.read({str(SAMPLE)!r}); print(len(one.positions()))"
    assert int(run("notebook", "python", code)) > 10


@pytest.mark.parametrize(
    ("name", "extra"), [("identify", "identify"), ("simulate", "identify"), ("plot", "view")]
)
def test_notebook_names_the_missing_package(name: str, extra: str) -> None:
    code = (
        "import driveby\n"
        f"try:\n    driveby.{name}\n"
        "except driveby.InputError as error:\n    print(error)"
    )
    extras = "identify" if extra == "view" else ""
    assert install_command(extra) in run(extras, "python", code)


@contextmanager
def started(extras: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "tests.builders.without", extras, "driveby", *words]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "ready" in line, process.communicate()[1]
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            process.communicate()


@pytest.mark.process
def test_truck_logger_worker_and_replay_run_with_what_they_need(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    folder, at = tmp_path / "recordings", ("--endpoint", endpoint)
    site = ("--site", str(ROOT / "docs" / "site.example.toml"))
    logger = ("logger", "--listen", endpoint, "--folder", str(folder), "--realm", "*")
    with started("", *logger) as process:
        with started("identify", "worker", *at, *site, "--folder", str(tmp_path)) as worker:
            stop(worker)
        run("", "truck", str(SAMPLE), *at, "--speed", "1000", "--realm", "sim-extras")
        run("", "replay", str(SAMPLE), *at, "--speed", "0", "--name", "extras")
        assert "logger" in run("", "health", "logger", *at)
        log = stop(process)
    assert log.count(f"{install_command('history')}; recording without it") == 1
    recorded = {path.relative_to(folder).parts[0] for path in folder.rglob("*.mcap")}
    assert {"sim-extras", "replay-extras"} <= recorded
