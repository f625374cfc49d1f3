"""Measures what studies/faults.md says.

python -m tests.verdicts.measure            every fault: verdict, reasons, worst EI (an hour)
python -m tests.verdicts.measure signals N  checks of signals over N drawn sound crossings
python -m tests.verdicts.measure sound N    verdict and worst EI of N drawn sound crossings
"""

import sys

import numpy as np

from services.simulation.drawn import of_any_bridge
from tests.verdicts import faults
from tests.verdicts.test_faults import TABLE
from tests.verdicts.test_signals import reasons


def table() -> None:
    """One line for each fault, as the page has them."""
    print("| fault | verdict | χ²/dof | reasons | largest error of EI, std |")
    print("| --- | --- | --- | --- | --- |")
    for name, row in TABLE.items():
        case = faults.crossing(row.truth, row.fault)
        result = faults.identified(case)
        chi2 = "" if result.chi2_per_dof is None else f"{result.chi2_per_dof:.3g}"
        worst = ""
        if result.parameters is not None:
            worst = f"{np.abs(faults.z_scores(case, result)).max():.1f}"
        outcome = ", ".join(f"`{r}`" for r in result.reasons)
        print(f"| {name} | {result.verdict} | {chi2} | {outcome} | {worst} |", flush=True)


def signals(count: int) -> None:
    """Sound crossings of which something is said."""
    accused = {seed: found for seed in range(count) if (found := reasons(seed))}
    print(f"{len(accused)} of {count} sound crossings accused: {accused}")


def sound(count: int) -> None:
    """Verdicts of crossings that nothing is wrong with."""
    for seed in range(count):
        fault = faults.Fault(site=faults.believed_nearly(seed))
        case = faults.crossing(faults.drawn(seed), fault)
        result = of_any_bridge(faults.identified(case))
        worst = ""
        if result.parameters is not None:
            worst = f", worst EI {np.abs(faults.z_scores(case, result)).max():.1f} std"
        outcome = ", ".join(result.reasons)
        print(f"{seed}: {result.verdict} {outcome} chi2 {result.chi2_per_dof}{worst}", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["sound"]:
        sound(int(sys.argv[2]))
    elif sys.argv[1:2] == ["signals"]:
        signals(int(sys.argv[2]))
    else:
        table()
