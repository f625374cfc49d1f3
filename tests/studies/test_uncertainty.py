"""The truth of the independent simulator, in the names of the method; the scenarios' draws."""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from pre_core import parameters
from schemas.settings import IdentificationSettings
from services.simulation.drive import DrivenRoad, Measurement
from studies.validation import uncertainty


def test_truth_has_a_value_for_every_parameter(shared: Path) -> None:
    path = shared / "crossings" / "d1_clean_const_speed" / "truth.json"
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    known = json.loads(path.read_text())
    values = uncertainty._values(known)
    assert set(parameters.names(len(known["EI"]))) == set(values)
    assert np.all(np.isfinite(list(values.values())))


def test_each_scenario_has_a_road_and_noise_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    class DrawnError(Exception):
        pass

    seeds: list[int] = []

    def simulate(_: object, __: object, road: DrivenRoad, measured: Measurement) -> None:
        assert measured.seed is None  # the road's
        seeds.append(road.seed)
        raise DrawnError

    monkeypatch.setattr(uncertainty, "simulate_drive", simulate)
    for number in range(1, 13):
        with suppress(DrawnError):
            uncertainty.one_scenario(number, 25.0, IdentificationSettings(method="pre"))
    assert len(set(seeds)) == 12
