"""The truth of the independent simulator, in the names of the method."""

import json
from pathlib import Path

import numpy as np
import pytest

from pre_core import parameters
from studies.validation import uncertainty


def test_truth_has_a_value_for_every_parameter(shared: Path) -> None:
    path = shared / "crossings" / "d1_clean_const_speed" / "truth.json"
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    known = json.loads(path.read_text())
    values = uncertainty._values(known)
    assert set(parameters.names(len(known["EI"]))) == set(values)
    assert np.all(np.isfinite(list(values.values())))
