"""How the time of an evaluation grows with the size of the problem; and what it is made of."""

import time
from typing import NamedTuple

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

from pre_core.paper import experiment, residual
from pre_core.paper.window import PaperWindow
from tests.benchmarks import cases

_ROUNDS = 15


class _Size(NamedTuple):
    window: PaperWindow
    elements: int = experiment.ELEMENTS
    particles: int = 64


def _seconds(sizes: list[_Size]) -> list[float]:
    """Processor time of one batch of each size, single thread: the least of several rounds.

    Every round takes all sizes in turn, so that other work disturbs them alike.
    """
    bound = []
    for window, elements, particles in sizes:
        limit, total = np.full(particles, np.inf), np.empty(particles)
        vectors = cases.noise_particles(particles, elements)
        bound.append((window, residual.workspace(window), vectors, limit, total))
    rounds = np.empty((_ROUNDS, len(sizes)))
    for times in rounds:
        for i, arguments in enumerate(bound):
            began = time.thread_time()
            residual.objective_batch(*arguments)
            times[i] = time.thread_time() - began
    assert all(np.all(np.isfinite(total)) for *_, total in bound)
    least: list[float] = rounds[1:].min(axis=0).tolist()
    return least


def _record(
    benchmark: BenchmarkFixture, sizes: list[int], batches: list[float], evaluations: int = 64
) -> None:
    seconds = [batch / evaluations for batch in batches]
    benchmark.extra_info |= {
        "sizes": sizes,
        "seconds": seconds,
        "exponent": cases.slope(sizes, seconds),
        "last_exponent": cases.slope(sizes[-2:], seconds[-2:]),
    }


def test_growth_with_steps(benchmark: BenchmarkFixture) -> None:
    """A longer crossing: the same bridge at 40 to 2.5 m/s, each at 1 ms."""
    windows = [cases.noise_window(speed_m_per_s=v) for v in (40.0, 20.0, 10.0, 5.0, 2.5)]
    seconds = benchmark.pedantic(_seconds, args=([_Size(w) for w in windows],), rounds=1)
    _record(benchmark, [w.signals.shape[2] for w in windows], seconds)


def test_growth_with_modes(benchmark: BenchmarkFixture) -> None:
    """Seven elements of four parts each, as a basis of 7 to 56 coordinates, at 10 m/s."""
    counts = [7, 14, 28, 56]
    windows = [cases.noise_window(parts=4, coordinates=c) for c in counts]
    seconds = benchmark.pedantic(_seconds, args=([_Size(w) for w in windows],), rounds=1)
    _record(benchmark, counts, seconds)


def test_growth_with_elements(benchmark: BenchmarkFixture) -> None:
    """More unknown rigidities in a basis of 14 coordinates, at 10 m/s."""
    counts = [7, 14, 28, 56]
    windows = [cases.noise_window(elements=n, coordinates=14) for n in counts]
    sizes = [_Size(w, elements=n) for w, n in zip(windows, counts, strict=True)]
    seconds = benchmark.pedantic(_seconds, args=(sizes,), rounds=1)
    _record(benchmark, counts, seconds)


def test_growth_with_elements_and_all_modes(benchmark: BenchmarkFixture) -> None:
    """More elements with all their 2 n degrees of freedom, at 10 m/s."""
    counts = [4, 7, 14, 28]
    windows = [cases.noise_window(elements=n) for n in counts]
    sizes = [_Size(w, elements=n) for w, n in zip(windows, counts, strict=True)]
    seconds = benchmark.pedantic(_seconds, args=(sizes,), rounds=1)
    _record(benchmark, counts, seconds)


def test_growth_with_particles(benchmark: BenchmarkFixture) -> None:
    """The paper's crossing for 125 to 2000 particles."""
    counts = [125, 250, 500, 1000, 2000]
    window = cases.noise_window()
    sizes = [_Size(window, particles=n) for n in counts]
    seconds = benchmark.pedantic(_seconds, args=(sizes,), rounds=1)
    _record(benchmark, counts, seconds, evaluations=1)


def test_parts_of_an_evaluation(benchmark: BenchmarkFixture) -> None:
    """What does not grow with the steps, what does, and how much of that each mode costs.

    From four evaluations: at 10 and 5 m/s (twice the steps), with 14 and with 7 coordinates.
    """

    sizes = [
        _Size(cases.noise_window(coordinates=m, speed_m_per_s=v)) for m in (14, 7) for v in (10, 5)
    ]
    batches = benchmark.pedantic(_seconds, args=(sizes,), rounds=1)
    fast, slow, fast_half, slow_half = (seconds / sizes[0].particles for seconds in batches)
    march, march_half = slow - fast, slow_half - fast_half
    modes = 2.0 * (march - march_half)
    benchmark.extra_info |= {
        "whole": fast,
        "before_the_steps": fast - march,
        "modes": modes,
        "without_modes": march - modes,
    }
