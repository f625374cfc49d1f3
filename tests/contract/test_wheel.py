"""An installed wheel brings one name, `driveby`, and lives beside other people's packages."""

import json
import os
import runpy
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from typing import Any

import pytest

INNER = ("pre_core", "schemas", "services")
DECOY = "raise RuntimeError('the package of somebody else was imported')\n"


@pytest.fixture(scope="module")
def built() -> dict[str, Any]:
    return runpy.run_path(str(Path(__file__).parents[2] / "setup.py"), run_name="setup")


@pytest.fixture(scope="module")
def wheel(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("source")
    for name in ("driveby", *INNER):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(project / name, source / name, ignore=ignored)
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(project / name, source / name)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--wheel-dir", str(source / "dist"), str(source)]
    subprocess.run(command, check=True, capture_output=True)
    (found,) = (source / "dist").glob("*.whl")
    return found


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


def run(environment: Path, program: str, *arguments: str, cwd: Path) -> str:
    without = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    command = [str(environment / "bin" / program), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=without)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_one_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        top = {name.split("/")[0] for name in names}
        (about,) = (name for name in top if name.endswith(".dist-info"))
        assert top == {"driveby", about}
        assert file.read(f"{about}/top_level.txt") == b"driveby\n"
    for name in ("py.typed", "services/data/paper.toml", "schemas/proto/driveby.proto"):
        assert f"driveby/{name}" in names


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
