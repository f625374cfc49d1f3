"""What fits leave over, made again from results: the same as the fits themselves left over."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from pre_core.crossing.fitted_residuals import AFTER, BEFORE, ON, FittedResiduals
from pre_core.diagnostics import quality
from schemas.results import Results
from schemas.settings import IdentificationSettings
from services.execution.offline import site_of
from services.recordings.recording import read_messages
from services.viewer.panels.residuals import band_names
from services.viewer.rerun_file import RerunContent, write_rrd
from services.viewer.residuals import _by_band, residual_cells
from tests.identifications import identify_recordings

Cells = dict[tuple[int, int, int], quality.ResidualBin]


@pytest.fixture(scope="module")
def sample(project: Path) -> Path:
    return project / "recordings/sample/crossing.mcap"


@pytest.fixture(scope="module")
def fitted(sample: Path) -> tuple[Results, Cells]:
    """The sample's result, and the cells that its verdict was made from."""
    judged: list[Cells] = []

    of_rows = quality.residual_bins

    def kept(*arguments: Any) -> Cells:
        judged.append(of_rows(*arguments))
        return judged[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quality, "residual_bins", kept)
        found = identify_recordings(
            [sample], site_of([sample], None), IdentificationSettings(draws=400)
        )
    (cells,) = judged
    return found, cells


def test_cells_are_those_that_the_verdict_was_made_from(
    sample: Path, fitted: tuple[Results, Cells]
) -> None:
    found, judged = fitted
    (crossing,) = found.crossings
    left = residual_cells(found.crossings, read_messages(sample), site_of([sample], None))
    (cells,) = left.values()
    assert list(left) == [crossing.crossing_id]
    for place, cell in judged.items():
        # The result is the posterior's middle and not its optimum: less than a standard deviation
        # of chance in each cell.
        chance = np.sqrt(2.0 / cell.size)
        assert cells.mean_square[place] == pytest.approx(cell.mean_square, abs=0.5 * chance)
    together = [cells.mean_square[place] - cell.mean_square for place, cell in judged.items()]
    assert np.abs(together).mean() < 0.02


def test_nothing_is_shown_of_a_result_of_other_signals(
    sample: Path, fitted: tuple[Results, Cells]
) -> None:
    found, _ = fitted
    site = site_of([sample], None)
    louder = site.model_copy(
        update={"sensor": site.sensor.model_copy(update={"noise_density_ug_per_rthz": (60.0,) * 4})}
    )
    assert residual_cells(found.crossings, read_messages(sample), louder) == {}


def test_a_crossing_without_its_samples_has_none(
    sample: Path, fitted: tuple[Results, Cells]
) -> None:
    found, _ = fitted
    assert residual_cells(found.crossings, [], site_of([sample], None)) == {}


def test_a_tone_shows_where_and_in_which_band_it_was() -> None:
    rng = np.random.default_rng(4)
    white = rng.standard_normal((3000, 3))
    stretch = np.repeat([BEFORE, ON, AFTER], 1000)
    time_s = 0.01 * np.arange(1000)
    white[1000:2000, 1] += 2.0 * np.sin(2.0 * np.pi * 8.0 * time_s)  # front body, on the bridge
    cells = _by_band(FittedResiduals(white, stretch, 0.01, 1.0))
    assert band_names(cells) == ["0–6", "6–12", "12–30", "over 30"]
    loud = np.argwhere(cells.excess_std > 4.5).tolist()
    assert loud == [[1, ON, 1]]
    assert cells.mean_square[1, ON, 1] > 10.0
    quiet = np.delete(cells.mean_square.reshape(-1), 1 * 12 + ON * 4 + 1)
    assert quiet == pytest.approx(1.0, abs=0.4)


def test_the_table_is_in_the_rerun_file_and_only_of_what_is_known(
    sample: Path, fitted: tuple[Results, Cells], tmp_path: Path
) -> None:
    found, _ = fitted
    site = site_of([sample], None)
    left = residual_cells(found.crossings, read_messages(sample), site)
    for residuals in (left, {}):
        path = tmp_path / f"{len(residuals)}.rrd"
        write_rrd(path, RerunContent({}, found.crossings, site, residuals=residuals))
        entities = {c.entity_path: c for c in RrdReader(path).stream().to_chunks()}
        values = [name for name in entities if name.endswith("/residuals/value")]
        assert len(values) == len(residuals)
        for name in values:
            column = entities[name].to_record_batch().column("Points2D:labels")
            (labels,) = column.to_pylist()
            assert len(labels) == 36
            assert labels[0] == f"{left[found.crossings[0].crossing_id].mean_square[0, 0, 0]:.2f}"
