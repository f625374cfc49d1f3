"""How the time of an evaluation grows with the size of the problem; and what it is made of."""

import time

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

from pre_core import residual
from pre_core.residual import Window
from tests.benchmarks import cases

_ROUNDS = 9


def _seconds(window: Window, elements: int, particles: int = 64) -> float:
    """The least of several times of one batch, single thread: its own time on the processor."""
    work = residual.workspace(window)
    vectors = cases.noise_particles(particles, elements)
    limit, total = np.full(particles, np.inf), np.empty(particles)
    seconds = []
    for _ in range(_ROUNDS):
        began = time.thread_time()
        residual.objective_batch(window, work, vectors, limit, total)
        seconds.append(time.thread_time() - began)
    assert np.all(np.isfinite(total))
    return min(seconds[1:])


def _record(benchmark: BenchmarkFixture, sizes: list[int], seconds: list[float]) -> None:
    benchmark.extra_info |= {
        "sizes": sizes,
        "seconds": seconds,
        "exponent": cases.slope(sizes, seconds),
        "last_exponent": cases.slope(sizes[-2:], seconds[-2:]),
    }


def test_growth_with_steps(benchmark: BenchmarkFixture):
    """A longer crossing: the same bridge at 40 to 2.5 m/s, each at 1 ms."""
    windows = [cases.noise_window(speed_m_per_s=v) for v in (40.0, 20.0, 10.0, 5.0, 2.5)]
    seconds = benchmark.pedantic(lambda: [_seconds(w, 7) / 64 for w in windows], rounds=1)
    _record(benchmark, [w.signals.shape[2] for w in windows], seconds)


def test_growth_with_modes(benchmark: BenchmarkFixture):
    """Seven elements of four parts each, as a basis of 7 to 56 coordinates, at 10 m/s."""
    counts = [7, 14, 28, 56]
    windows = [cases.noise_window(parts=4, coordinates=c) for c in counts]
    seconds = benchmark.pedantic(lambda: [_seconds(w, 7) / 64 for w in windows], rounds=1)
    _record(benchmark, counts, seconds)


def test_growth_with_elements(benchmark: BenchmarkFixture):
    """More unknown rigidities in a basis of 14 coordinates, at 10 m/s."""
    counts = [7, 14, 28, 56]
    windows = [cases.noise_window(elements=n, coordinates=14) for n in counts]
    seconds = benchmark.pedantic(
        lambda: [_seconds(w, n) / 64 for w, n in zip(windows, counts, strict=True)], rounds=1
    )
    _record(benchmark, counts, seconds)


def test_growth_with_elements_and_all_modes(benchmark: BenchmarkFixture):
    """More elements with all their 2 n degrees of freedom, at 10 m/s."""
    counts = [4, 7, 14, 28]
    windows = [cases.noise_window(elements=n) for n in counts]
    seconds = benchmark.pedantic(
        lambda: [_seconds(w, n) / 64 for w, n in zip(windows, counts, strict=True)], rounds=1
    )
    _record(benchmark, counts, seconds)


def test_growth_with_particles(benchmark: BenchmarkFixture):
    """The paper's crossing for 125 to 2000 particles."""
    counts = [125, 250, 500, 1000, 2000]
    window = cases.noise_window()
    seconds = benchmark.pedantic(
        lambda: [_seconds(window, 7, particles=n) for n in counts], rounds=1
    )
    _record(benchmark, counts, seconds)


def test_parts_of_an_evaluation(benchmark: BenchmarkFixture):
    """What does not grow with the steps, what does, and how much of that each mode costs.

    From four evaluations: at 10 and 5 m/s (twice the steps), with 14 and with 7 coordinates.
    """

    def four() -> list[float]:
        return [
            _seconds(cases.noise_window(coordinates=m, speed_m_per_s=v), 7) / 64
            for m in (14, 7)
            for v in (10.0, 5.0)
        ]

    fast, slow, fast_half, slow_half = benchmark.pedantic(four, rounds=1)
    march, march_half = slow - fast, slow_half - fast_half
    modes = 2.0 * (march - march_half)
    benchmark.extra_info |= {
        "whole": fast,
        "before_the_steps": fast - march,
        "modes": modes,
        "without_modes": march - modes,
    }
