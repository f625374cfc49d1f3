"""Reading the model's signals between two samples: a windowed sinc from a table."""

import numpy as np
import pytest
import scipy.signal

from pre_core.arrays import FloatArray
from pre_core.crossing.channels import PASS_BAND, STOP
from pre_core.crossing.residuals import _read
from pre_core.crossing.step_tables import sinc_table
from pre_core.kernels.windowed_sinc import kaiser_beta, windowed_sinc

TABLE = sinc_table()
PHASES, TAPS = TABLE.shape[0] - 1, TABLE.shape[2]
AT = np.arange(TAPS) - (TAPS // 2 - 1.0)
"""Where the weighted samples are, from the one before the place that is read."""


def read(samples: FloatArray, place: float) -> float:
    """As `_compare` does it: samples (taps,) at `place`, 0 to 1, beyond the middle one."""
    wheels = np.stack([samples, samples])
    value, again = _read(TABLE, place, 0, 0, wheels, wheels)
    assert value == again
    return float(value)


def places() -> FloatArray:
    """Rows of the table, between them, and at both ends."""
    rng = np.random.default_rng(3)
    return np.concatenate([[0.0, 1.0], np.arange(PHASES) / PHASES, rng.random(200)])


@pytest.mark.parametrize(
    ("share", "error"), [(0.05, 2e-5), (0.125, 2e-5), (0.2, 1e-4), (PASS_BAND, 2e-4)]
)
def test_sines_of_the_pass_band(share: float, error: float) -> None:
    """Cycles per sample: rows see up to an eighth."""
    for phase in np.linspace(0.0, np.pi, 7):
        samples = np.sin(2.0 * np.pi * share * AT + phase)
        for place in places():
            truth = np.sin(2.0 * np.pi * share * place + phase)
            assert read(samples, place) == pytest.approx(truth, abs=error)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_parabolas_are_exact(degree: int) -> None:
    """Integrated accelerations drift far: metres, of which a millionth would be noise."""
    for begin in (0.0, 400.0):
        samples = (AT + begin) ** degree
        for place in places():
            assert read(samples, place) == pytest.approx((place + begin) ** degree, rel=1e-12)


def test_continuous_from_one_sample_to_the_next() -> None:
    """The last place of one stretch and the first of the next weigh every sample alike.

    White samples have all frequencies, those above the pass band too.
    """
    samples = np.random.default_rng(1).standard_normal(TAPS + 1)
    assert read(samples[:-1], 1.0) == pytest.approx(read(samples[1:], 0.0), abs=1e-12)


def test_slope_from_one_sample_to_the_next() -> None:
    """Of what is below PASS, up to the error with which it is read."""
    step = 1e-5
    k = np.arange(TAPS + 1) - (TAPS // 2 - 1.0)
    for share in (0.05, 0.125, 0.2):
        samples = np.sin(2.0 * np.pi * share * k + 0.4)
        left = (read(samples[:-1], 1.0) - read(samples[:-1], 1.0 - step)) / step
        right = (read(samples[1:], step) - read(samples[1:], 0.0)) / step
        assert left == pytest.approx(right, abs=5e-4), share


def test_between_rows_of_the_table_value_and_slope_are_continuous() -> None:
    samples = np.random.default_rng(2).standard_normal(TAPS)
    step = 1e-6
    for row in (1, 20, PHASES - 1):
        at = row / PHASES
        before, here, after = (read(samples, at + shift) for shift in (-step, 0.0, step))
        assert here - before == pytest.approx(after - here, abs=1e-9)


def test_images_are_gone() -> None:
    """Between samples a sine of f has images at 1 - f, 1 + f, 2 - f, … of the rate.

    Those of the pass band vanish; of what lies between PASS and STOP, which rows do not see, a
    fiftieth is left: the price of reading parabolas exactly.
    """
    place = np.arange(0.0, 1.0, 1.0 / PHASES)
    offsets = (AT[None, :] - place[:, None]).ravel()
    weight = TABLE[:-1, 0].ravel() / PHASES
    for share in np.linspace(1.0 - STOP, 2.0 + PASS_BAND, 100):
        response = abs(weight @ np.exp(2j * np.pi * share * offsets))
        of = abs(share - round(share))
        assert response < (5e-5 if of <= PASS_BAND else 0.025), (share, response)


@pytest.mark.parametrize("stop_band_db", [60.0, 90.0])
def test_the_window_is_kaisers(stop_band_db: float) -> None:
    """At whole distances, and with a cutoff that makes the sinc one in the middle alone."""
    reach = 20
    beta = kaiser_beta(stop_band_db)
    assert beta == pytest.approx(scipy.signal.kaiser_beta(stop_band_db), rel=1e-14)
    distance = np.arange(-reach, reach + 1.0)
    ours = windowed_sinc(distance, 0.1, reach, beta)
    expected = np.sinc(0.2 * distance) * scipy.signal.windows.kaiser(2 * reach + 1, beta)
    np.testing.assert_allclose(ours / ours[reach], expected, atol=1e-15)
    ends = windowed_sinc(distance[[0, -1]], 0.1, reach, beta, pedestal=1.0)
    np.testing.assert_allclose(ends, 0.0, atol=1e-15)
