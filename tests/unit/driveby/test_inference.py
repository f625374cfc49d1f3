"""Groups beside the posterior draws: priors as declared, diagnostics, units."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from schemas.results import CrossingResult, Results
from services.history.draws import DrawsOfCrossing, write_draws
from services.notebook.inference import prior_of, statistics_of

BEFORE = Path(__file__).parents[2] / "data/before/0.1.0/pre-result.json.gz"


@pytest.fixture
def crossing() -> CrossingResult:
    return Results.model_validate_json(gzip.decompress(BEFORE.read_bytes())).crossings[0]


def test_prior_draws_have_the_declared_quantiles_and_units(crossing: CrossingResult) -> None:
    drawn = prior_of([crossing])
    parameters = crossing.parameters
    assert parameters is not None
    for name, parameter in parameters.items():
        prior = parameter.prior
        if prior is None:
            continue
        values = drawn[name].to_numpy().ravel()
        assert drawn[name].attrs["units"] == parameter.unit
        if prior.distribution == "log_normal":
            logs = np.log(values / prior.location)
            assert np.std(logs) == pytest.approx(prior.scale, rel=0.08)
            assert np.mean(logs) == pytest.approx(0.0, abs=0.1 * prior.scale)
        elif prior.distribution == "half_normal":
            assert values.min() >= 0.0
            assert np.sqrt(np.mean(values**2)) == pytest.approx(prior.scale, rel=0.08)
    assert {"EI_1", "rhoA", "f_start"} <= set(drawn)


def test_prior_draws_have_the_zeros_of_the_spike(crossing: CrossingResult) -> None:
    assert crossing.parameters is not None
    for probability in (0.5, 1.0):
        f_start = crossing.parameters["f_start"]
        assert f_start.prior is not None
        spiked = f_start.prior.model_copy(update={"probability_zero": probability})
        parameters = crossing.parameters | {
            "f_start": f_start.model_copy(update={"prior": spiked}),
        }
        drawn = prior_of([crossing.model_copy(update={"parameters": parameters})])
        values = drawn["f_start"].to_numpy().ravel()
        assert np.mean(values == 0.0) == pytest.approx(probability, abs=0.04)
        others = values[values != 0.0]
        if others.size:
            assert np.sqrt(np.mean(others**2)) == pytest.approx(spiked.scale, rel=0.1)
        assert (drawn["rhoA"].to_numpy() > 0.0).all()


def test_file_holds_posterior_prior_and_diagnostics(
    crossing: CrossingResult, tmp_path: Path
) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    draws = {"EI_1": np.ones((2, 5)), "wheelbase_m": np.ones((2, 5))}
    one = DrawsOfCrossing(crossing.crossing_id, crossing.vehicle, crossing.bridge, draws)
    groups = {"prior": prior_of([crossing]), "sample_stats": statistics_of([crossing])}
    write_draws(tmp_path / "draws.nc", [one], groups)
    found = {
        name: xarray.load_dataset(tmp_path / "draws.nc", group=name, engine="h5netcdf")
        for name in ("posterior", "prior", "sample_stats")
    }
    assert found["posterior"]["EI_1"].attrs["units"] == "N·m²"
    assert found["posterior"]["wheelbase_m"].attrs["units"] == "m"
    assert found["prior"]["EI_1"].dims == ("chain", "draw", "crossing")
    stats = found["sample_stats"]
    assert float(stats["r_hat"][0]) == crossing.diagnostics["r_hat"]
    assert float(stats["chi2_per_dof"][0]) == crossing.chi2_per_dof
