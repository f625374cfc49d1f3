"""Search over twin tyres that first ends at a wrong bridge, metres from the right place."""

import numpy as np
import pytest

from schemas.settings import IdentificationSettings
from services.simulation.drawn import identify_simulated
from studies.simulation.out_of_model import draw_out_of_model, drive_out_of_model
from studies.simulation.truths import default_site
from tests.verdicts.faults import errors_of

LARGEST_Z = 4.0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_wrong_bridge_at_a_wrong_place_is_left() -> None:
    """Five metres off, with the weak element at a wrong place, it was `good` with z 18."""
    world = draw_out_of_model(default_site(), "pavement", 52)
    run = drive_out_of_model(world, 52).run
    (found,) = identify_simulated([run], world.site, IdentificationSettings(threads=1))
    z = errors_of(found.result, world.truth.beam.flexural_rigidity_nm2)
    assert np.abs(z).max() < LARGEST_Z
