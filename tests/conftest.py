"""What several tests need."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from services.security.settings import CertsSettings
from tests.endpoints import free_endpoint

if TYPE_CHECKING:
    from services.simulation.drive import SimulatedDrive

# As the commands do, before anything imports numpy: see services/cli/main.py.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# No test depends on how quick the machine is.
settings.register_profile("project", deadline=None)
settings.load_profile("project")

PROJECT = Path(__file__).parents[1]
pytest_plugins = ["tests.groups", "tests.left_out", "tests.prepared"]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Search for garbage neither during the collection nor among the collected tests later.

    The tests live to the end, so each search would be in vain; a third of the collection was that.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session")
def project() -> Path:
    """The root of the repository."""
    return PROJECT


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with data that is not in the repository; skips where it is absent."""
    folder = PROJECT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("the folder ../shared with reference data and recordings is not there")
    return folder


@pytest.fixture(scope="session")
def shared_sites(shared: Path) -> list[Path]:
    """The site files of the independent crossings, but for what a site file cannot say yet."""
    paths = sorted((shared / "crossings").glob("*/site.toml"))
    known = [path for path in paths if "interior_supports_m" not in path.read_text()]
    assert known
    return known


@pytest.fixture
def endpoint() -> str:
    """An address at which nobody listens yet."""
    return free_endpoint()


@pytest.fixture
def tls_endpoint() -> str:
    """An address for TLS at which nobody listens yet."""
    return free_endpoint("tls")


@pytest.fixture(scope="session")
def credentials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `driveby certs` makes for two trucks; whoever changes something changes a copy."""
    from services.security.certs import certs_command

    folder = tmp_path_factory.mktemp("bus") / "certs"
    certs_command(CertsSettings(folder=folder, trucks=["truck-1", "truck-2"]))
    return folder


@pytest.fixture(scope="session")
def csv_example() -> Path:
    """A small folder with accel_00.csv, gps_00.csv and site.toml (tests/data)."""
    return PROJECT / "tests" / "data" / "csv_example"


@pytest.fixture(scope="session")
def scenario_6() -> "SimulatedDrive":
    """A crossing of the paper's scenario 6: fine mesh of 70 elements, 0.1 ms, no noise."""
    from pre_core.paper.experiment import scenario_ratios
    from services.simulation.drive import DrivenRoad, paper_site, simulate_drive

    return simulate_drive(paper_site(), scenario_ratios(6), DrivenRoad("A", 1))
