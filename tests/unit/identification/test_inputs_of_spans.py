"""Inputs of method `pre` for a continuous bridge."""

import numpy as np

from schemas.settings import IdentificationSettings
from services.finding.streams import Samples
from services.identification.pre_method import inputs_of
from services.identification.result_parts import beam_of, nominal_parameters
from services.simulation.drive import paper_site
from studies.simulation.out_of_model import continuous
from tests.verdicts.steady import steady_crossing


def test_supports_and_a_mesh_fine_enough_for_every_span() -> None:
    """Three elements in each of four spans: cut so that a span has eight finite elements at
    least."""
    bridge = continuous(paper_site().bridges[0], np.array([15.0, 15.0, 15.0, 15.0]))
    data = steady_crossing(np.arange(0.0, 12.0, 0.1))._replace(
        bridge=bridge,
        samples=Samples(0.0, 200.0, {}, 200.0),
    )
    inputs = inputs_of(data, IdentificationSettings(method="pre"), np.zeros((4, 2400)), 0.0)
    assert inputs.interior_supports == (3, 6, 9)
    assert inputs.parts == 3
    np.testing.assert_allclose(inputs.element_lengths_m, 5.0)
    beam = beam_of(data, nominal_parameters(data.vehicle, bridge))
    assert beam.interior_supports == (3, 6, 9)
    single = steady_crossing(np.arange(0.0, 9.0, 0.1))._replace(samples=data.samples)
    assert inputs_of(single, IdentificationSettings(method="pre"), np.zeros((4, 9)), 0.0).parts == 2
