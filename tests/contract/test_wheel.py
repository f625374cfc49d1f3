"""An installed wheel brings one name, `driveby`, and lives beside other people's packages."""

import ast
import email
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest

from tests import matrix
from tests.builders.wheels import INNER, distribution

LARGEST_TRUCK_MB = 120.0
"""Site-packages of a truck's computer, with compiled bytecode."""
DECOY = "raise RuntimeError('the package of somebody else was imported')\n"


@pytest.fixture(scope="module")
def built() -> dict[str, Any]:
    return runpy.run_path(str(Path(__file__).parents[2] / "setup.py"), run_name="setup")


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel, our dependencies, and decoys that refuse to be imported."""
    environment = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin" / "python"
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    command += ["--no-deps", "--no-index", str(wheel)]
    subprocess.run(command, check=True, capture_output=True)
    (packages,) = environment.glob("lib/*/site-packages")
    # A path named in a .pth file is searched, but the .pth files in it are not: so the checkout,
    # which is installed there, is not found.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    for name in INNER:
        assert not (packages / name).exists()
        (packages / name).mkdir()
        (packages / name / "__init__.py").write_text(DECOY)
    return environment


def ended(
    environment: Path, program: str, *arguments: str, cwd: Path
) -> subprocess.CompletedProcess[str]:
    without = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    command = [str(environment / "bin" / program), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=without)


def run(environment: Path, program: str, *arguments: str, cwd: Path) -> str:
    done = ended(environment, program, *arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_one_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        top = {name.split("/")[0] for name in names}
        (about,) = (name for name in top if name.endswith(".dist-info"))
        assert top == {"driveby", about}
        assert file.read(f"{about}/top_level.txt") == b"driveby\n"
    assert not [name for name in names if "studies" in name]
    data = ("services/data/paper.toml", "schemas/proto/driveby.proto")
    for name in ("py.typed", *data, "schemas/json/site.schema.json"):
        assert f"driveby/{name}" in names


def test_tests_can_be_run_against_the_wheel(built: dict[str, Any], project: Path) -> None:
    for path in (project / "tests").rglob("*.py"):
        built["moved_inside"](path.read_bytes(), str(path))


def test_tests_of_the_matrix_import_no_studies(project: Path) -> None:
    """Not even through other tests: `make matrix` copies no studies beside them."""
    found = [path for name in matrix.SELECTION for path in files_below(project / name)]
    waiting = {path for path in found if str(path.relative_to(project)) not in matrix.READS_SOURCES}
    seen: set[Path] = set()
    while waiting:
        path = waiting.pop()
        seen.add(path)
        modules = modules_imported_by(path)
        assert not {one for one in modules if one.partition(".")[0] == "studies"}, path
        places = {project / f"{module.replace('.', '/')}.py" for module in modules}
        waiting |= {place for place in places if place.is_file() and "tests" in place.parts} - seen
    assert len(seen) > 50


def files_below(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(path.rglob("test_*.py"))


def modules_imported_by(path: Path) -> set[str]:
    """Return the modules that a file imports when it is imported, and what it takes from each."""
    names = set()
    for node in ast.parse(path.read_bytes()).body:
        if isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
    return names


@pytest.fixture(scope="module")
def distributions(
    first_distribution: Path, project: Path, tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    """Two builds of the same sources, in checkouts of other times and modes."""
    folder = tmp_path_factory.mktemp("second")
    return [first_distribution, distribution(project, folder, 1.5e9, 0o600, 0o077)]


def test_two_builds_give_the_same_bytes(distributions: list[Path]) -> None:
    first, second = ({p.name: p.read_bytes() for p in out.iterdir()} for out in distributions)
    assert sorted(name.rpartition(".")[2] for name in first) == ["gz", "whl"]
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


def test_source_archive_holds_sources_and_nothing_of_the_machine(distributions: list[Path]) -> None:
    (archive,) = distributions[0].glob("*.tar.gz")
    with tarfile.open(archive) as file:
        members = file.getmembers()
    names = {member.name.partition("/")[2] for member in members}
    assert {"setup.py", "pyproject.toml", "README.md", "LICENSE", "driveby/py.typed"} <= names
    assert {"services/data/paper.toml", "schemas/proto/driveby.proto"} <= names
    assert {member.mode for member in members if member.isfile()} == {0o644}
    assert {(one.uid, one.gid, one.uname, one.gname, one.mtime) for one in members} == {
        (0, 0, "", "", 1_750_000_000)
    }


def test_metadata_describe_the_project(distributions: list[Path], project: Path) -> None:
    (wheel,) = distributions[0].glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        (name,) = (name for name in file.namelist() if name.endswith(".dist-info/METADATA"))
        about = email.message_from_bytes(file.read(name))
        assert name.replace("METADATA", "licenses/LICENSE") in file.namelist()
    settings = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    assert (about["Name"], about["Version"]) == ("driveby", settings["version"])
    assert about["License-Expression"] == "Apache-2.0"
    assert about["Description-Content-Type"] == "text/markdown"
    assert about.get_payload(decode=True) == (project / "README.md").read_bytes()
    classifiers = about.get_all("Classifier", [])
    assert "Typing :: Typed" in classifiers
    assert "Programming Language :: Python :: 3.11" in classifiers
    for url in about.get_all("Project-URL", []):
        assert not re.search(r"example\.|TODO|OWNER|USER", url), url


def test_every_module_is_imported_from_inside(installed: Path, tmp_path: Path) -> None:
    code = (
        "import importlib, pkgutil, driveby\n"
        "names = [m.name for m in pkgutil.walk_packages(driveby.__path__, 'driveby.')]\n"
        "for name in names:\n"
        "    if not name.endswith(('__main__', '.generate')):\n"
        "        importlib.import_module(name)\n"
        "print(len(names), driveby.__file__)"
    )
    count, place = run(installed, "python", "-c", code, cwd=tmp_path).split()
    assert int(count) > 100
    assert Path(place).is_relative_to(installed)


def test_a_recording_is_read_beside_packages_of_the_same_name(
    installed: Path, tmp_path: Path, project: Path
) -> None:
    sample = project / "recordings" / "sample" / "crossing.mcap"
    code = (
        f"import driveby; (run,) = driveby.read({str(sample)!r})\n"
        "print(run.vehicle, len(run.channels), driveby.__version__)"
    )
    assert run(installed, "python", "-c", code, cwd=tmp_path).startswith("truck-1 4 ")
    for module in (["-m", "driveby"], ["-m", "driveby.services"]):
        assert "identify" in run(installed, "python", *module, "--help", cwd=tmp_path)


def test_studies_are_refused_in_one_line(installed: Path, tmp_path: Path) -> None:
    done = ended(installed, "driveby", "validate", "--scenarios", "6", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "driveby validate runs from a checkout" in done.stderr


@pytest.mark.slow
@pytest.mark.process
def test_the_installed_command_identifies_and_starts_processes(
    installed: Path, tmp_path: Path, project: Path
) -> None:
    """All kernels are compiled anew: numba's cache lies beside the installed sources."""
    sample = project / "recordings" / "sample" / "crossing.mcap"
    run(installed, "driveby", "identify", str(sample), "--json", "out.json", cwd=tmp_path)
    (crossing,) = json.loads((tmp_path / "out.json").read_text())["crossings"]
    assert crossing["verdict"] == "good"
    assert list(installed.glob("lib/*/site-packages/driveby/pre_core/**/*.nbi"))
    run(installed, "driveby", "demo", "--speed", "8", "--out", "demo", cwd=tmp_path)
    assert (tmp_path / "demo").is_dir()


@pytest.mark.slow
def test_a_trucks_computer_holds_what_it_needs_and_no_more(
    wheel: Path, tmp_path: Path, project: Path
) -> None:
    """The wheel with the packages that it requires itself, in an empty environment."""
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(environment / "bin" / "python")]
    install = [*pip, "install", "--quiet"]
    pinned = project / "requirements" / "truck.txt"
    done = subprocess.run(
        [*install, "--require-hashes", "-r", str(pinned)], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"no package index: {done.stderr.strip().splitlines()[-1]}")
    subprocess.run([*install, "--no-index", str(wheel)], check=True)
    sample = project / "recordings" / "sample" / "crossing.mcap"
    example = project / "tests" / "data" / "csv_example"

    def driveby(*arguments: object) -> str:
        return run(environment, "driveby", *map(str, arguments), cwd=tmp_path)

    def run_all() -> None:
        for command in ("truck", "logger", "replay", "watch", "health", "gateway"):
            assert f"usage: driveby {command}" in driveby(command, "--help")
        assert "truck-1" in driveby("info", sample)
        driveby("import", example, "--site", example / "site.toml", "-o", "a.mcap", "--force")
        driveby("export", sample, "--to", "csv")
        lacking = ended(environment, "driveby", "identify", str(sample), cwd=tmp_path)
        assert (lacking.returncode, lacking.stderr.count("\n")) == (2, 1)
        assert f'pip install "{wheel}[identify]"' in lacking.stderr

    (packages,) = environment.glob("lib/*/site-packages")
    as_installed_mb = size_mb(packages)
    run_all()
    slim = project / "docs" / "scripts" / "slim_environment.sh"
    if shutil.which("strip") is None:
        pytest.skip("the image of a truck is made with strip of binutils")
    subprocess.run(["sh", slim, environment], check=True)
    slim_mb = size_mb(packages)
    run_all()
    print(f"a truck's packages: {as_installed_mb:.0f} MB, {slim_mb:.0f} MB as in its image")
    assert slim_mb <= LARGEST_TRUCK_MB


def size_mb(folder: Path) -> float:
    files = (path for path in folder.rglob("*") if path.is_file())
    return sum(path.stat().st_size for path in files) / 1e6


def test_what_names_a_module_is_moved_inside(built: dict[str, Any]) -> None:
    moved = built["moved_inside"]
    for before, after in (
        ("from services.cli import main\n", "from driveby.services.cli import main\n"),
        ("if x:\n    from schemas import a, b\n", "if x:\n    from driveby.schemas import a, b\n"),
        ("é = 1; from pre_core import y\n", "é = 1; from driveby.pre_core import y\n"),
        ("import os, schemas.x as y\n", "import os, driveby.schemas.x as y\n"),
        ('run("-m", "services.a.b")\n', 'run("-m", "driveby.services.a.b")\n'),
        ("x = 'services'\n", "x = 'driveby.services'\n"),
        ("from .services import x\n", "from .services import x\n"),
        ("from servicesx import y\n", "from servicesx import y\n"),
        ('"""services of all kinds"""\n', '"""services of all kinds"""\n'),
        ("x = 'schemas/proto/driveby.proto'\n", "x = 'schemas/proto/driveby.proto'\n"),
    ):
        assert moved(before.encode(), "x.py").decode() == after


@pytest.mark.parametrize("source", ["import services.x\n", "import os, schemas\n"])
def test_an_import_that_would_bind_another_name_is_refused(
    built: dict[str, Any], source: str
) -> None:
    with pytest.raises(SyntaxError, match=r"x\.py:1: import .* as … expected"):
        built["moved_inside"](source.encode(), "x.py")
