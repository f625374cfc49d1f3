"""False alarms, and how soon a loss is found: bridges drawn from the method's own statistics.

    python -m tests.benchmarks.alarms [--figure docs/images/alarm-delay.png]

Weeks of three crossings by three trucks over a bridge of seven elements (the likelihoods of
tests/fleet.py), with seasons of which the temperature is known. What is stated is the number of
false alarms in a year of a bridge; measured are sound bridges over two years each. A loss of one
element, at midspan or at an end, begins half a year in.
"""

import argparse
from pathlib import Path

import numpy as np

from pre_core.monitoring.baseline import Period
from pre_core.monitoring.observation import Observation, fused
from pre_core.monitoring.watch import Rules, watch
from services.common.files import write_atomically
from services.execution.blas import one_blas_thread
from services.identification.observed import observation_of
from tests.fleet import bridge_of, crossing_of, season_deg_c, templates, trucks_of

WEEK_S = 7.0 * 86_400.0
CHANGE = 0.005
LOSSES = (0.03, 0.05, 0.07, 0.10, 0.15, 0.20, 0.30)
LOST_AT, LAST = 26, 104


def main() -> None:
    """Print both tables, and draw the second if asked to."""
    parser = argparse.ArgumentParser(description="false alarms and delays")
    parser.add_argument("--bridges", type=int, default=600)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    with one_blas_thread():
        kinds = _observations(rng)
        sound = [_periods(rng, kinds, 104) for _ in range(options.bridges)]
        print("| stated, a year of a bridge | threshold | bridges with an alarm | measured |")
        print("| --: | --: | --: | --: |")
        for stated in (1.0, 0.5, 0.2, 0.1, 0.01):
            rules = Rules(stated)
            found = [watch(periods, rules) for periods in sound]
            alarms = sum(one.change is not None for one in found)
            years = sum(
                (96 if one.change is None else one.change.raised_at - 7) / 52.0 for one in found
            )
            print(
                f"| {stated:g} | {found[0].threshold:.2f} | {alarms} of {len(sound)} | "
                f"{alarms / years:.3f} |"
            )
        print()
        print(
            "| loss | element 4: found | weeks: median | 90 % | element 1: found | median | 90 % |"
        )
        print("| --: | --: | --: | --: | --: | --: | --: |")
        told: dict[int, list[list[float]]] = {3: [], 0: []}
        for loss in LOSSES:
            cells = []
            for element, rows in told.items():
                some = [_delay(rng, kinds, element, loss) for _ in range(options.bridges // 6)]
                delays = [d for d in some if np.isfinite(d)]
                rows.append(some)
                middle, late = np.quantile(some, [0.5, 0.9], method="higher")
                cells.append(f"{len(delays)} of {len(some)} | {_weeks(middle)} | {_weeks(late)}")
            print(f"| {100 * loss:.0f} % | {' | '.join(cells)} |")
    if options.figure is not None:
        _draw(options.figure, told)


def _weeks(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "–"


def _observations(rng: np.random.Generator) -> list[list[Observation]]:
    """What three trucks tell, by truck and kind of crossing: covariances and loadings."""
    bridge = bridge_of(rng, "bridge-1")
    out = []
    for truck in trucks_of(rng, 3):
        some = [
            observation_of(crossing_of(rng, kind, truck, bridge, 0.0, bridge.ei_nm2))
            for kind in templates()
        ]
        of = [one for one in some if one is not None]
        # The stored likelihoods are by one truck: these are three.
        out.append(
            [
                one._replace(
                    shared=tuple(
                        s._replace(name=f"{s.name} {truck.name}" if "truck" in s.name else s.name)
                        for s in one.shared
                    )
                )
                for one in of
            ]
        )
    return out


def _periods(
    rng: np.random.Generator,
    kinds: list[list[Observation]],
    weeks: int,
    element: int = 0,
    loss: float = 0.0,
) -> list[Period]:
    n = kinds[0][0].value.size
    level, slope = 23.5 + 0.1 * rng.standard_normal(n), -0.003 + 0.0005 * rng.standard_normal(n)
    z = {
        s.name: rng.standard_normal(s.loading.shape[1])
        for of in kinds
        for one in of
        for s in one.shared
    }
    first = float(rng.integers(52))
    out = []
    for week in range(weeks):
        warm = season_deg_c((first + week) * WEEK_S) + 4.0 * float(rng.standard_normal())
        truth = level + slope * (warm - 10.0)
        if week >= LOST_AT:
            truth[element] += np.log(1.0 - loss)
        some = []
        for _ in range(3):
            of = kinds[int(rng.integers(3))]
            one = of[int(rng.integers(len(of)))]
            value = truth + np.linalg.cholesky(one.own) @ rng.standard_normal(n)
            value = value + CHANGE * rng.standard_normal(n)
            value = value + sum((s.loading @ z[s.name] for s in one.shared), np.zeros(n))
            some.append(one._replace(value=value))
        out.append(Period(fused(some, n), warm))
    return out


def _delay(
    rng: np.random.Generator, kinds: list[list[Observation]], element: int, loss: float
) -> float:
    """Weeks from the loss to the alarm; infinite if there is none, or it names another element."""
    change = watch(_periods(rng, kinds, LAST, element, loss), Rules()).change
    if change is None or change.element != element or change.direction != "weaker":
        return float("inf")
    return float(change.raised_at - LOST_AT + 1)


def _draw(path: Path, told: dict[int, list[list[float]]]) -> None:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from services.viewer.drawing import BAR_EDGE, GRID, STYLE, WEAK_EDGE, figure_bytes

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 3.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        kinds = ((3, "element at midspan", BAR_EDGE, "o"), (0, "element at an end", WEAK_EDGE, "s"))
        for element, label, colour, marker in kinds:
            x = 100.0 * np.array(LOSSES)
            rows = told[element]
            low, middle, high = (
                np.array([np.quantile(r, q, method="higher") for r in rows])
                for q in (0.1, 0.5, 0.9)
            )
            is_there = np.isfinite(middle)
            axes.fill_between(
                x[is_there], low[is_there], np.minimum(high, LAST - LOST_AT)[is_there],
                color=colour, alpha=0.15, linewidth=0.0,
            )  # fmt: skip
            axes.plot(x[is_there], middle[is_there], color=colour, marker=marker, label=label)
        axes.set_yscale("log")
        axes.set_yticks([2, 5, 10, 20, 50], labels=["2", "5", "10", "20", "50"])
        axes.set_xlabel("loss of EI of one element (%)")
        axes.set_ylabel("weeks until the alarm")
        axes.set_title("Median and the middle 80 %, three crossings a week")
        axes.grid(color=GRID)
        axes.legend()
    write_atomically(path, figure_bytes(figure, path.suffix.removeprefix(".")))


if __name__ == "__main__":
    main()
