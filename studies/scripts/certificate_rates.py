"""Error rates of the rule of site validations: the table of studies/site-validation.md.

    python -m studies.scripts.certificate_rates [--trials 2000] [--elements 7]
    python -m studies.scripts.certificate_rates CERTIFICATE.json …

Synthetic crossings are judged by the rule itself (`validation_trial.judge_trial`), one after the
other. The errors of ln EI, in standard deviations that the method states, are normal; those of one
crossing are equally correlated, those of different crossings independent. With validation records
as arguments their correlation is printed.
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from scipy.stats import binom

from schemas.validation_records import ValidationCrossing, load_validation
from services.simulation.trial_truth import CROSSINGS, WEAK_RATIO
from services.simulation.validation_trial import (
    FEWEST_GOOD,
    errors_of,
    judge_trial,
)

_STD_LOG = 0.05
_NORMAL_975 = 1.959964


class Method(NamedTuple):
    """Error model of a method."""

    name: str
    good: float = 0.95
    """Share of good crossings; the others are rejected."""
    inflation: float = 1.0
    """Ratio of its errors to the stated ones."""
    bias: float = 0.0
    """Bias of every element, in its standard deviations."""
    wild: float = 0.0
    """Share of good crossings with an error of eight standard deviations in one element."""


METHODS = (
    Method("intervals true, 95 % good"),
    Method("intervals true, 90 % good", good=0.9),
    Method("errors 1.2 times as large as stated", inflation=1.2),
    Method("errors 1.5 times", inflation=1.5),
    Method("errors twice", inflation=2.0),
    Method("errors three times", inflation=3.0),
    Method("every element biased by 1 standard deviation", bias=1.0),
    Method("every element biased by 2", bias=2.0),
    Method("every tenth crossing wrong by 8, and called good", wild=0.1),
    Method("every fourth crossing so", wild=0.25),
    Method("intervals true, 50 % good", good=0.5),
    Method("intervals true, 25 % good", good=0.25),
)


def tried(
    method: Method, number: int, elements: int, correlation: float, rng: np.random.Generator
) -> ValidationCrossing:
    """Return a synthetic crossing."""
    weak = int(rng.integers(elements)) if number % 3 == 1 else None
    truth = np.ones(elements)
    if weak is not None:
        truth[weak] = WEAK_RATIO
    common, own = rng.standard_normal(), rng.standard_normal(elements)
    error = np.sqrt(correlation) * common + np.sqrt(1.0 - correlation) * own
    z = method.inflation * error + method.bias
    if rng.uniform() < method.wild:
        z[rng.integers(elements)] += 8.0 * rng.choice((-1.0, 1.0))
    is_good = rng.uniform() < method.good

    def answer(shift: float) -> tuple[float, ...]:
        return tuple((truth * np.exp(_STD_LOG * (z + shift))).tolist()) if is_good else ()

    return ValidationCrossing(
        seed=number,
        direction="start_to_end",
        weak_element=None if weak is None else weak + 1,
        ei_ratio=tuple(truth.tolist()),
        verdict="good" if is_good else "rejected",
        ei_ratio_q025=answer(-_NORMAL_975),
        ei_ratio_q50=answer(0.0),
        ei_ratio_q975=answer(_NORMAL_975),
    )


def passes(
    method: Method, elements: int, correlation: float, rng: np.random.Generator
) -> tuple[bool, int]:
    """Return whether the trial passes, and after how many crossings that was determined."""
    crossings: list[ValidationCrossing] = []
    judgement = None
    while judgement is None:
        crossings.append(tried(method, len(crossings), elements, correlation, rng))
        judgement = judge_trial(crossings)
    return judgement.passed, len(crossings)


def measured(paths: list[Path]) -> str:
    """Return the joint statistics of the crossings in passed validation records."""
    answered = [one for path in paths for one in load_validation(path).crossings if one.is_answered]
    errors = [errors_of(one) for one in answered]
    z = np.array([one.z for one in errors])
    covered = np.array([one.is_covered for one in errors]).mean(axis=1)
    pairs = np.corrcoef(z.T)[np.triu_indices(z.shape[1], 1)]
    return (
        f"{len(answered)} crossings: {100.0 * covered.mean():.1f} % "
        f"(± {100.0 * covered.std(ddof=1) / np.sqrt(covered.size):.1f} %) of the intervals hold "
        f"the truth, errors {np.sqrt(np.mean(z**2)):.2f} (root mean square), correlation of two "
        f"elements {pairs.min():.2f} to {pairs.max():.2f}, {np.abs(pairs).mean():.2f} in size"
    )


def main() -> int:
    """Print both tables, or the statistics of records; return 0."""
    p = argparse.ArgumentParser()
    p.add_argument("--trials", type=int, default=2000)
    p.add_argument("--elements", type=int, default=7)
    p.add_argument("certificates", type=Path, nargs="*")
    options = p.parse_args()
    rng = np.random.default_rng(1)
    write = partial(Console(soft_wrap=True).print, highlight=False, markup=False)
    if options.certificates:
        write(measured(options.certificates))
        return 0
    write(f"| {options.elements} elements | passes, correlation 0 | 0.3 | 0.6 | crossings (0.3) |")
    write("| --- | --- | --- | --- | --- |")
    for method in METHODS:
        cells = []
        for correlation in (0.0, 0.3, 0.6):
            found = [
                passes(method, options.elements, correlation, rng) for _ in range(options.trials)
            ]
            cells.append(f"{100.0 * np.mean([passed for passed, _ in found]):.1f} %")
            if correlation == 0.3:
                crossings = np.mean([number for _, number in found])
        write(f"| {method.name} | {' | '.join(cells)} | {crossings:.1f} |")
    write(f"\n| share good | at least {FEWEST_GOOD} of {CROSSINGS} |\n| --- | --- |")
    for share in (0.95, 0.9, 0.8, 0.7, 0.5, 0.25):
        enough = binom.sf(FEWEST_GOOD - 1, CROSSINGS, share)
        write(f"| {100.0 * share:.0f} % | {100.0 * enough:.2f} % |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
