"""Crossings of bridges in OpenSees: a beam, and plates that a beam describes more or less."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.results import CrossingResult
from schemas.settings import IdentificationSettings
from services.drives.csv_import import read_folder
from services.drives.runs import normalised
from services.simulation.drawn import identify_simulated
from services.simulation.drive import declared_site, paper_site
from tests.verdicts import opensees
from tests.verdicts.faults import errors_of
from tests.verdicts.opensees import Deck

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

RATIOS = np.array([1.0, 1.0, 1.0, 0.4, 1.0, 1.0, 1.0])
SITE = declared_site(paper_site(), (25.0,) * 4, 1000.0)
NOMINAL_NM2 = np.array(SITE.bridges[0].nominal_flexural_rigidity_nm2)
LARGEST_Z = 4.0


@pytest.fixture(scope="module")
def ops() -> Any:
    """Return the module of OpenSees."""
    try:
        from openseespy import opensees as found
    except (ImportError, RuntimeError):
        pytest.skip(
            'OpenSeesPy is not there (pip install -e ".[opensees]"; Debian: apt install libblas3 '
            "liblapack3 libgfortran5)"
        )
    return found


def crossing(ops: Any, deck: Deck, folder: Path) -> CrossingResult:
    """Simulate a crossing of the deck, import its files and identify it."""
    opensees.crossing_files(ops, deck, SITE, folder, seed=1)
    (run,) = read_folder(folder)
    settings = IdentificationSettings(threads=1)
    (found,) = identify_simulated([normalised(run, SITE.sensor)], SITE, settings)
    return found.result


def errors(result: CrossingResult) -> np.ndarray:
    """Return the error of every element (n,) over its standard deviation."""
    return errors_of(result, RATIOS * NOMINAL_NM2)


def test_beam_is_identified(ops: Any, tmp_path: Path) -> None:
    result = crossing(ops, opensees.beam(ops, SITE, RATIOS), tmp_path)
    assert result.verdict == "good", result.reasons
    assert np.abs(errors(result)).max() < LARGEST_Z
    assert result.parameters is not None
    assert result.parameters["EI_4"].std < 0.02 * NOMINAL_NM2[3]


@pytest.mark.parametrize("width_m", [4.0, 8.0])
def test_plate_is_identified_as_a_beam(ops: Any, tmp_path: Path, width_m: float) -> None:
    result = crossing(ops, opensees.plate(ops, SITE, RATIOS, width_m), tmp_path)
    assert result.verdict == "good", result.reasons
    assert np.abs(errors(result)).max() < LARGEST_Z


def test_lane_beside_the_axis_of_a_plate_is_never_good_and_wrong(ops: Any, tmp_path: Path) -> None:
    """One wheel rolls on the axis; the plate bends across, which neither beam nor torsion has."""
    result = crossing(ops, opensees.plate(ops, SITE, RATIOS, 8.0, lane_m=1.0), tmp_path)
    assert result.verdict != "good" or np.abs(errors(result)).max() < LARGEST_Z
