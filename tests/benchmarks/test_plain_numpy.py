"""The plain implementations, written apart from ours, agree with it: a check of both."""

from collections.abc import Callable

import numpy as np
import pytest

from pre_core.paper import experiment, residual
from tests.benchmarks import cases, plain_numpy


@pytest.mark.parametrize(
    "plain", [plain_numpy.objective, plain_numpy.objective_with_filters], ids=["nodal", "modal"]
)
def test_plain_numpy_agrees(plain: Callable[[plain_numpy.Prepared, cases.Floats], float]) -> None:
    window = cases.paper_window(cases.SCENARIO)
    work = residual.workspace(window)
    prepared = plain_numpy.prepare(window, experiment.ELEMENTS, experiment.SPAN_M)
    vectors = cases.particles(5)
    ours = np.array([residual.objective(window, work, theta) for theta in vectors])
    np.testing.assert_allclose([plain(prepared, theta) for theta in vectors], ours, rtol=1e-9)
    batch = np.empty(len(vectors))
    residual.objective_batch(window, work, vectors, np.full(len(vectors), np.inf), batch)
    np.testing.assert_allclose(batch, ours, rtol=1e-9)
