"""A lorry whose springs and tyres are known to 30 % only, over a plain bridge."""

from pathlib import Path

import numpy as np
import pytest

from schemas.settings import IdentificationSettings
from schemas.site_file import load_site
from schemas.validation_records import VehicleBridgePair
from services.simulation.drawn import drive, identify_simulated
from services.simulation.trial_truth import drawn_truth
from services.simulation.validation_trial import conditions_of, single_pair_site

FIRST_SEED = 1000


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 4, 8])
def test_is_good_and_true(project: Path, number: int) -> None:
    """Two searches had ended at another frequency, the draws of the other had not converged."""
    known = load_site(project / "studies" / "scripts" / "lorry_24_m.toml")
    pair = VehicleBridgePair(known.vehicles[0].id, known.bridges[0].id)
    site = single_pair_site(known, pair)
    conditions = conditions_of(site.vehicles[0], site.bridges[0], site)
    seed = FIRST_SEED + number
    truth, weak = drawn_truth(site, conditions, seed, number)
    driven = drive(site, truth, seed, noise_ug_per_rthz=conditions.noise_density_ug_per_rthz)
    settings = IdentificationSettings(method="pre", threads=1)
    (seen,) = identify_simulated([driven.run], driven.site, settings)
    assert seen.result.verdict == "good"
    assert seen.result.parameters is not None
    z = [
        (one.mean - true) / one.std
        for n, true in enumerate(truth.beam.flexural_rigidity_nm2, start=1)
        for one in [seen.result.parameters[f"EI_{n}"]]
        if n - 1 != weak
    ]
    assert np.abs(z).max() < 3.0
