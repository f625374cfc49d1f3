"""Figures of one crossing for researchers: residual road, posterior and chains."""

from collections.abc import Sequence
from typing import Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from schemas.results import Parameter, Prior
from services.common.arrays import Floats
from services.common.errors import InputError
from services.notebook.arguments import names_of
from services.notebook.inference import prior_density, prior_draws
from services.notebook.simulate import Simulation, check_truth
from services.notebook.solution import WITH_DRAWS, Identification, Solution, one_solution
from services.viewer.drawing import MUTED, STYLE, mark_bridge, simplify_axes
from services.viewer.residual_size import TREND_DEGREE, expected_reach_m

_BRIDGE: Final = "#e3ebf0"
_COLUMNS: Final = 4
_EXPECTED_OPACITY: Final = 0.2
_PRIOR: Final = "0.8"
_BELOW_ZERO: Final = 0.04
"""Part of the axis below zero for a parameter that is never negative."""
_VISIBLE: Final = 0.2
"""Height of a density over its maximum from which it is seen."""
_BINS: Final = 40
_ZERO_BAR: Final = 0.02
"""Part of a panel's width that a bar at zero has."""
_SMALL_UNITS: Final = {"m/N": "mm/MN", "1/N": "1/GN"}
"""Units in which compliances need no power of ten: 1e-9 of their own."""
_POINTS: Final = 400
"""Number of points of a prior's curve."""
_SHOWN: Final = 6.0
"""Posterior standard deviations on either side of the mean that are drawn."""
_POSTERIOR_OPACITY: Final = 0.6
"""Opacity through which the prior behind the posterior shows."""
_CUT: Final = (0.05, 99.95)
"""Percentiles of the prior draws that are drawn."""


def plot_residual(solution: Solution | Identification) -> Figure:
    """Draw the profile under the front wheel minus that under the rear wheel, over the chainage.

    Long waves, the drift of twice integrated accelerations, have little weight in the fit; a cubic
    trend shows them. The RMS is given with and without it. A band about the trend has the expected
    size: 95 % of the differences by the declared noise of the axles' sensors and the estimated
    profile mismatch. Raise InputError for a crossing without a road profile.
    """
    solution = one_solution("solution", solution, "plot_residual")
    road = solution.crossing.road
    if road is None:
        raise InputError(f"{solution.crossing.crossing_id}: has no road profile")
    x_m, bridge = np.asarray(road.x_m), solution.bridge
    difference_mm = 1e3 * (np.asarray(road.front_m) - np.asarray(road.rear_m))
    trend_mm = np.polynomial.Polynomial.fit(x_m, difference_mm, TREND_DEGREE)(x_m)
    reach_m = expected_reach_m(solution.crossing, road, solution.site)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.3), layout="constrained")
        axes = figure.add_subplot()
        mark_bridge(axes, (0.0, *bridge.interior_supports_m, bridge.span_m))
        axes.patches[0].set(label="bridge", facecolor=_BRIDGE)
        axes.axhline(0.0, color=MUTED, lw=0.8)
        if reach_m is not None:
            half_mm = 1e3 * reach_m
            axes.fill_between(
                x_m,
                trend_mm - half_mm,
                trend_mm + half_mm,
                color="C1",
                alpha=_EXPECTED_OPACITY,
                lw=0.0,
                label=f"expected range about the trend (95 %): {_causes(solution)}",
            )
        every, short = _rms(difference_mm), _rms(difference_mm - trend_mm)
        axes.plot(
            x_m,
            difference_mm,
            lw=0.8,
            label=f"difference: {every:.2g} mm RMS, {short:.2g} mm without trend",
        )
        label = "cubic trend: mostly drift, little weight in the fit"
        axes.plot(x_m, trend_mm, lw=1.2, ls="--", color="C1", label=label)
        axes.set_title("Road profile under the front wheels minus that under the rear wheels")
        axes.set_xlabel("chainage from the start of the bridge (m)")
        axes.set_ylabel("front − rear (mm)")
        simplify_axes(axes)
        figure.legend(loc="outside lower center", ncols=2)
    return figure


def _causes(solution: Solution) -> str:
    """Return the causes of the expected difference in words."""
    road = solution.crossing.road
    noise = [] if solution.site is None else ["sensor noise"]
    mismatch = [] if road is None or road.mismatch is None else ["profile mismatch"]
    return " and ".join(noise + mismatch)


def _rms(values: Floats) -> float:
    """Return the root mean square of values (n,)."""
    return float(np.sqrt(np.mean(values**2)))


def plot_posterior(
    solution: Solution | Identification,
    names: Sequence[str] | None = None,
    *,
    truth: Simulation | None = None,
) -> Figure:
    """Draw prior and posterior density of parameters, by default of all EI, with 95 % intervals.

    Each density is relative to its own maximum: a wide prior would be a flat line next to a narrow
    posterior. The axis reaches the prior where the posterior is far from it. Bars at zero are the
    probabilities of exactly zero, and the densities those of all other values. `truth`, of a
    simulated crossing, draws the true EI.

    Raise InputError for an unknown name or a crossing without draws.
    """
    check_truth(truth)
    solution = one_solution("solution", solution, "plot_posterior")
    true_ei = {} if truth is None else _true_rigidities(solution, truth)
    with matplotlib.rc_context(STYLE):
        figure, panels = _panels(_chosen(solution, names), 2.0)
        for name, axes in panels:
            _draw_densities(axes, solution.value[name], solution.draws[name], true_ei.get(name))
        figure.supylabel("density over its maximum", fontsize="medium")
        shown = {
            label: handle
            for axes in figure.axes
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=3)
    return figure


def _draw_densities(axes: Axes, found: Parameter, drawn: Floats, true: float | None) -> None:
    """Draw prior and posterior of one parameter in a panel."""
    divisor, unit = _shown_unit(_size(found), found.unit)
    draws = drawn.ravel() / divisor
    window = (found.mean + np.array([-_SHOWN, _SHOWN]) * found.std) / divisor
    if found.prior is not None:
        prior = found.prior.model_copy(update={"probability_zero": None})
        of_prior = prior_draws(prior) / divisor
        limits = np.percentile(of_prior, _CUT)
        if prior.distribution == "half_normal":
            limits[0] = 0.0
        at = np.linspace(limits[0], limits[1], _POINTS)
        heights = prior_density(prior, at * divisor)
        heights /= heights.max()
        if found.prior.probability_zero != 1.0:
            axes.fill_between(at, heights, color=_PRIOR, lw=0.0, label="prior")
        if window[0] == window[1]:
            window = np.array([-_BELOW_ZERO * limits[1], limits[1]])
        window = _reaching(window, of_prior, heights, at)
        if prior.distribution in ("half_normal", "log_normal"):
            window[0] = max(window[0], -_BELOW_ZERO * window[1])
    window = _with_width(window)
    others = draws[draws != 0.0]
    if others.size:
        limits = _with_width(np.array([others.min(), others.max()]), window)
        heights, edges = _density(others, limits)
        axes.stairs(
            heights, edges, fill=True, color="C0", alpha=_POSTERIOR_OPACITY, label="posterior"
        )
    for limit in (found.q025, found.q975):
        axes.axvline(limit / divisor, color="0.3", lw=0.8, ls="--")
    if true is not None:
        axes.axvline(true / divisor, color="C3", lw=1.2, label="truth")
        window = np.array([min(window[0], true / divisor), max(window[1], true / divisor)])
    _draw_zeros(axes, found.prior, 1.0 - others.size / draws.size, np.ptp(window))
    axes.set_xlim(*window)
    axes.set_ylim(0.0, 1.08)
    axes.set_xlabel(unit)
    axes.set_yticks([])


def _draw_zeros(axes: Axes, prior: Prior | None, share: float, width: float) -> None:
    """Draw bars at zero as high as its probabilities, and name them, if there are any.

    `share` is that of the posterior draws, `width` that of the panel.
    """
    of_prior = 0.0 if prior is None else prior.probability_zero or 0.0
    if max(of_prior, share) == 0.0:
        return
    bars = ((of_prior, 2.0, "0.55", "prior at zero"), (share, 1.0, "C0", "posterior at zero"))
    for height, times, color, label in bars:
        if height > 0.0:
            half = 0.5 * times * _ZERO_BAR * width
            axes.stairs([height], [-half, half], fill=True, color=color, label=label)
    known = f"prior {100.0 * of_prior:.3g} %"
    text = f"at zero: {known},\nposterior {100.0 * share:.3g} %"
    if share == 1.0:
        text = "zero in all draws" + (f"\n({known})" if of_prior else "")
    behind = {"facecolor": "white", "alpha": 0.7, "lw": 0.0, "pad": 1.0}
    axes.text(
        *(0.97, 0.96, text),
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize="small",
        bbox=behind,
    )


def _size(found: Parameter) -> float:
    """Return the size of the values to be drawn, by which a unit is chosen."""
    if found.mean != 0.0 or found.prior is None:
        return found.mean
    return max(abs(found.prior.location), found.prior.scale)


def _with_width(limits: Floats, within: Floats | None = None) -> Floats:
    """Return limits (2,), widened where they are one value, as of a torsion without effect."""
    if limits[0] < limits[1]:
        return limits
    half = max(abs(limits[0]), 1.0) if within is None else 0.5 * np.ptp(within) / _BINS
    return np.asarray(limits + np.array([-half, half]))


def _true_rigidities(solution: Solution, truth: Simulation) -> dict[str, float]:
    """Return the true EI of each element in N·m², by name."""
    nominal = solution.bridge.nominal_flexural_rigidity_nm2
    pairs = zip(nominal, truth.ei_ratios.tolist(), strict=True)
    return {f"EI_{number}": ei * ratio for number, (ei, ratio) in enumerate(pairs, 1)}


def _density(draws: Floats, limits: Floats) -> tuple[Floats, Floats]:
    """Return heights (bins,) of a histogram between limits, at most one, and its edges."""
    counts, edges = np.histogram(draws, bins=_BINS, range=(limits[0], limits[1]))
    return counts / max(counts.max(), 1), edges


def _reaching(window: Floats, prior: Floats, heights: Floats, at: Floats) -> Floats:
    """Return a window that reaches the middle half of a prior, unless it shows the prior anyway."""
    is_inside = (at >= window[0]) & (at <= window[1])
    if heights[is_inside].max(initial=0.0) >= _VISIBLE:
        return window
    low, high = np.percentile(prior, (25.0, 75.0))
    return np.array([min(window[0], low), max(window[1], high)])


def plot_chains(solution: Solution | Identification, names: Sequence[str] | None = None) -> Figure:
    """Draw the draws of parameters in their order, by default of all EI, a line for each chain.

    The title gives the crossing's largest R-hat and smallest effective sample size.

    Raise InputError for an unknown name or a crossing without draws.
    """
    solution = one_solution("solution", solution, "plot_chains")
    with matplotlib.rc_context(STYLE):
        figure, panels = _panels(_chosen(solution, names), 1.8)
        for name, axes in panels:
            divisor, unit = _shown_unit(solution.value[name].mean, solution.value[name].unit)
            for chain in solution.draws[name]:
                axes.plot(chain / divisor, lw=0.4, alpha=0.7)
            axes.set_xlabel("draw")
            axes.set_ylabel(unit)
        figure.suptitle(_convergence(solution), fontsize="medium")
    return figure


def _convergence(solution: Solution) -> str:
    """Return the diagnostics of a crossing's draws in words."""
    of = solution.crossing.diagnostics
    drawn = next(iter(solution.draws.values())).size
    return (
        f"of all parameters: largest R-hat {of['r_hat']:.3f}, smallest effective sample size "
        f"{of['ess']:.0f} of {drawn} draws"
    )


def _shown_unit(value: float, unit: str) -> tuple[float, str]:
    """Return a divisor and the unit with its prefix, such as 1e9 and GN·m²: ticks need no power."""
    for divisor, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if unit.startswith("N") and abs(value) >= divisor:
            return divisor, prefix + unit
    if unit in _SMALL_UNITS:
        return 1e-9, _SMALL_UNITS[unit]
    return 1.0, unit


def _chosen(solution: Solution, names: Sequence[str] | None) -> list[str]:
    known = [name for name in solution.draws if name in solution.value]
    if not known:
        raise InputError(f"{solution.crossing.crossing_id}: has no draws; {WITH_DRAWS}")
    chosen = [name for name in known if name.startswith("EI_")]
    if names is not None:
        chosen = names_of("names", names)
    for name in chosen:
        if name not in known:
            raise InputError(f"{name}: is unknown, it must be one of {', '.join(known)}")
    if not chosen:
        raise InputError("no names given, a parameter such as EI_1 is expected")
    return chosen


def _panels(names: Sequence[str], height_in: float) -> tuple[Figure, list[tuple[str, Axes]]]:
    """Return a figure and its panels, one below the name of each parameter."""
    columns = min(len(names), _COLUMNS)
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.6 * columns, height_in * rows + 0.2), layout="constrained")
    panels = []
    for number, name in enumerate(names, 1):
        axes = figure.add_subplot(rows, columns, number)
        axes.set_title(name)
        panels.append((name, axes))
    return figure, panels
