"""How often the rule of certificates errs: the table of docs/certificates.md.

    python docs/scripts/certificate_rates.py [--trials 2000] [--elements 7]
    python docs/scripts/certificate_rates.py CERTIFICATE.json …

Made-up crossings go through the rule itself (`services.simulation.certificate.judged`), one after
the other as it would take them. The errors of ln EI, in standard deviations as the method tells
them, are normal; those of one crossing have the same correlation with each other, that of
different crossings none. With certificates, which correlation that is in theirs.
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from scipy.stats import binom

from schemas.certificates import Tried, load_certificate
from services.simulation.certificate import CROSSINGS, FEWEST_GOOD, WEAK_RATIO, errors_of, judged

_STD_LOG = 0.05
_NORMAL_975 = 1.959964


class Method(NamedTuple):
    """How a method answers."""

    name: str
    good: float = 0.95
    """Share of crossings; the others are rejected."""
    inflation: float = 1.0
    """Its errors over what it says of them."""
    bias: float = 0.0
    """Of every element, in its standard deviations."""
    wild: float = 0.0
    """Share of crossings, called good, that are wrong by eight standard deviations in one place."""


METHODS = (
    Method("intervals true, 95 % good"),
    Method("intervals true, 90 % good", good=0.9),
    Method("errors 1.2 times as large as told", inflation=1.2),
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
) -> Tried:
    """Make up a crossing."""
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
    answers = {
        f"ei_ratio_{key}": tuple((truth * np.exp(_STD_LOG * (z + shift))).tolist())
        for key, shift in (("q025", -_NORMAL_975), ("q50", 0.0), ("q975", _NORMAL_975))
    }
    return Tried(
        seed=number,
        direction="start_to_end",
        weak_element=None if weak is None else weak + 1,
        ei_ratio=tuple(truth.tolist()),
        verdict="good" if is_good else "rejected",
        **(answers if is_good else {}),
    )


def passes(
    method: Method, elements: int, correlation: float, rng: np.random.Generator
) -> tuple[bool, int]:
    """Whether it passes, and after how many crossings that was known."""
    crossings: list[Tried] = []
    judgement = None
    while judgement is None:
        crossings.append(tried(method, len(crossings), elements, correlation, rng))
        judgement = judged(crossings)
    return judgement.passed, len(crossings)


def measured(paths: list[Path]) -> str:
    """What the crossings of certificates with an answer say together."""
    answered = [
        one for path in paths for one in load_certificate(path).crossings if one.is_answered
    ]
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
    """Print both tables, or what certificates say; return 0."""
    p = argparse.ArgumentParser()
    p.add_argument("--trials", type=int, default=2000)
    p.add_argument("--elements", type=int, default=7)
    p.add_argument("certificates", type=Path, nargs="*")
    options = p.parse_args()
    rng = np.random.default_rng(1)
    say = partial(Console(soft_wrap=True).print, highlight=False, markup=False)
    if options.certificates:
        say(measured(options.certificates))
        return 0
    say(f"| {options.elements} elements | passes, correlation 0 | 0.3 | 0.6 | crossings (0.3) |")
    say("| --- | --- | --- | --- | --- |")
    for method in METHODS:
        cells = []
        for correlation in (0.0, 0.3, 0.6):
            found = [
                passes(method, options.elements, correlation, rng) for _ in range(options.trials)
            ]
            cells.append(f"{100.0 * np.mean([passed for passed, _ in found]):.1f} %")
            if correlation == 0.3:
                crossings = np.mean([number for _, number in found])
        say(f"| {method.name} | {' | '.join(cells)} | {crossings:.1f} |")
    say(f"\n| share good | at least {FEWEST_GOOD} of {CROSSINGS} |\n| --- | --- |")
    for share in (0.95, 0.9, 0.8, 0.7, 0.5, 0.25):
        enough = binom.sf(FEWEST_GOOD - 1, CROSSINGS, share)
        say(f"| {100.0 * share:.0f} % | {100.0 * enough:.2f} % |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
