"""The wheel on several Pythons, with the lowest and the newest versions of what it depends on.

    python -m tests.matrix WHEEL --python python3.11 --python python3.13 [--versions newest lowest]

`make matrix` builds the wheel and runs it with every Python that it finds. The interpreter that
runs this module needs setuptools, each Python its pip, and nothing else, so that a container of
another distribution can run it, too (tests/containers/test_wheels.py).

For each Python an empty environment gets the wheel with all extras and the tests' own packages.
Then `driveby demo` runs in it, and a selection of the tests, copied to a folder in which the
project's sources are not: they are rewritten as the wheel's modules are (setup.py), because
`services` is called `driveby.services` there. `lowest` are the lowest versions that pyproject.toml
allows of the packages that it names and that have a wheel for this Python. The exit code is 1 if
anything failed.
"""

import argparse
import os
import re
import runpy
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSIONS = ("newest", "lowest")
RUNNERS = ("hypothesis", "pytest", "pytest-benchmark", "pytest-timeout", "pytest-xdist")
"""Packages that run the tests; the newest in every environment."""
NEEDED_BY_TESTS = ("jsonschema", "pyyaml")
"""Packages that the selected tests import. Moto, the S3 server, and s3fs allow no common version of
botocore at times, ArviZ and the lowest versions none of xarray."""
NOT_INSTALLED = ("dev", "docs", "opensees")
"""Extras that are not in `all`."""
SELECTION = (
    "tests/contract/test_decoders.py",
    "tests/contract/test_topics.py",
    "tests/unit/bus",
    "tests/unit/common",
    "tests/unit/execution",
    "tests/unit/export",
    "tests/unit/finding",
    "tests/unit/history",
    "tests/unit/identification",
    "tests/unit/ledger",
    "tests/unit/recordings",
    "tests/unit/schemas",
    "tests/verdicts/test_rows.py",
)
READS_SOURCES = (
    "tests/contract/test_decoders.py::test_importing_signals_is_cheap",
    "tests/unit/schemas/test_toml_text.py::test_only_one_place_parses_toml",
    "tests/unit/common/test_child_process.py",
    "tests/unit/execution/test_content.py::test_another_process_finds_the_same",
    "tests/unit/execution/test_content.py::test_the_sources_that_decide_about_a_result_are_of_its_program",
    "tests/unit/execution/test_processes.py::test_no_process_outlives_its_parent",
    "tests/unit/history/test_bridge_history.py::test_view_opens_the_viewer_with_what_was_asked_for",
    "tests/unit/history/test_draws.py",
    "tests/unit/identification/test_footprints.py",
    "tests/unit/identification/test_inputs_of_spans.py",
    "tests/unit/identification/test_tandem_signals.py",
)
"""Tests that need sources or studies as they lie in a checkout, or ArviZ."""
COPIED = ("docs", "pyproject.toml", "recordings/sample", "tests")


class Environment(NamedTuple):
    """A Python and the versions to install into it."""

    name: str
    python: str
    is_lowest: bool


class Outcome(NamedTuple):
    """What came out of one environment."""

    environment: Environment
    version: str
    demo: str
    tests: str
    is_good: bool


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--python", action="append", default=[], help="default: this one")
    parser.add_argument("--versions", nargs="+", choices=VERSIONS, default=["newest"])
    parser.add_argument("-o", "--out", type=Path, default=Path("build/matrix"))
    parser.add_argument("--again", action="store_true", help="use environments that are there")
    parser.add_argument("-k", default="", help="only the selected tests that match, as in pytest")
    options = parser.parse_args()
    pythons = options.python or [sys.executable]
    wanted = [
        Environment(f"{versions}-{number}", python, versions == "lowest")
        for versions in options.versions
        for number, python in enumerate(pythons)
    ]
    outcomes = []
    for one in wanted:
        folder = options.out.resolve() / one.name
        is_there = options.again and (folder / "venv").is_dir()
        if not is_there:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        outcomes.append(tried(one, options.wheel.resolve(), folder, options.k, is_there))
        print(row(outcomes[-1]), flush=True)
    print("\n| Python | versions | `driveby demo` | tests |\n| --- | --- | --- | --- |")
    for outcome in outcomes:
        print(row(outcome))
    sys.exit(0 if all(outcome.is_good for outcome in outcomes) else 1)


def row(outcome: Outcome) -> str:
    versions = "lowest" if outcome.environment.is_lowest else "newest"
    return f"| {outcome.version} | {versions} | {outcome.demo} | {outcome.tests} |"


def bounds_of_project() -> Iterator[tuple[str, str]]:
    """Yield each package that pyproject.toml names, with the lowest version that it allows."""
    extras = PROJECT["optional-dependencies"]
    named = [*PROJECT["dependencies"]]
    named += [one for extra in extras if extra not in NOT_INSTALLED for one in extras[extra]]
    for requirement in named:
        found = re.match(r"([\w-]+)(?:\[\w+\])?\s*>=\s*([\w.]+)", requirement)
        if found:
            yield found[1], found[2]


def lowest(pip: list[str | Path]) -> Iterator[str]:
    """Yield a pin of each package that pyproject.toml names to its lowest version.

    For Pythons newer than a package it is the first version that installs from wheels alone.
    """
    wheels = [*pip, "install", "--dry-run", "--quiet", "--only-binary", ":all:"]
    for package, bound in bounds_of_project():
        listed = output([*pip, "index", "versions", package])
        found = re.search(r"^Available versions: (.*)$", listed, re.MULTILINE)
        versions = sorted(found[1].split(", ") if found else [], key=numbers_of)
        allowed = [one for one in versions if numbers_of(one) >= numbers_of(bound)]
        pins = (f"{package}=={version}" for version in allowed or [bound])
        yield next((pin for pin in pins if succeeds([*wheels, pin])), f"{package}=={bound}")


def output(command: list[str | Path]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def succeeds(command: list[str | Path]) -> bool:
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def numbers_of(version: str) -> list[int]:
    """Return the numbers of a version without the zeros at its end."""
    numbers = [int(one) for one in re.findall(r"\d+", version.partition(".post")[0])]
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return numbers


def tried(one: Environment, wheel: Path, folder: Path, matching: str, is_there: bool) -> Outcome:
    """Install the wheel into an empty environment, and run demo and tests in it."""
    python = folder / "venv" / "bin" / "python"
    variables = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    variables["NUMBA_CACHE_DIR"] = str(folder / "kernels")
    with (folder / "log.txt").open("w") as log:

        def run(*command: str | Path, cwd: Path = folder) -> tuple[int, float]:
            began_s = time.monotonic()
            done = subprocess.run(command, stdout=log, stderr=log, cwd=cwd, env=variables)
            return done.returncode, time.monotonic() - began_s

        make: list[str | Path] = [one.python, "-m", "venv", "--without-pip", folder / "venv"]
        if not is_there and run(*make)[0]:
            return Outcome(one, one.python, "", "no environment", False)
        pip: list[str | Path] = [one.python, "-m", "pip", "--python", python]
        version = subprocess.run(
            [python, "--version"], capture_output=True, text=True, check=True
        ).stdout.split()[1]
        bounds = folder / "lowest.txt"
        bounds.write_text("\n".join(lowest(pip)) if one.is_lowest else "")
        install = [
            *pip,
            "install",
            "--quiet",
            "-c",
            bounds,
            f"{wheel}[all]",
            *RUNNERS,
            *NEEDED_BY_TESTS,
        ]
        if not is_there and run(*install)[0]:
            return Outcome(one, version, "", f"cannot be installed: {folder / 'log.txt'}", False)
        run(*pip, "freeze")  # into the log
        checkout = folder / "tests-only"
        shutil.rmtree(checkout, ignore_errors=True)
        copied(checkout)
        demo, demo_s = run(python.with_name("driveby"), "demo", cwd=folder)
        command: list[str | Path] = [python, "-m", "pytest", "-n", "2", "--dist", "loadgroup", "-q"]
        command += [*SELECTION, *(left_out(name) for name in READS_SOURCES)]
        # The lowest version of a package may use what a newer one of its own packages deprecates.
        command += ["-W", "default::DeprecationWarning"] if one.is_lowest else []
        code, _ = run(*command, *(["-k", matching] if matching else []), cwd=checkout)
    last = (folder / "log.txt").read_text().strip().splitlines()[-1].strip("= ")
    output = f"{'runs' if demo == 0 else f'exit code {demo}'} ({demo_s:.0f} s)"
    return Outcome(one, version, output, last, code == 0 and demo == 0)


def left_out(name: str) -> str:
    """Return pytest's option that leaves out a test, or a file without importing it."""
    return f"--deselect={name}" if "::" in name else f"--ignore={name}"


def copied(checkout: Path) -> None:
    """Copy the tests and what they read, importing the modules under the wheel's names."""
    setup = runpy.run_path(str(ROOT / "setup.py"), run_name="setup")
    rewritten: Callable[[bytes, str], bytes] = setup["moved_inside"]
    for name in COPIED:
        source, target = ROOT / name, checkout / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, target)
    for path in (checkout / "tests").rglob("*.py"):
        path.write_bytes(rewritten(path.read_bytes(), str(path)))


if __name__ == "__main__":
    main()
