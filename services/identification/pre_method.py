"""Method `pre` on one crossing: posterior, verdict, and the result with its uncertainty.

What the numbers are is in `pre_core.crossing.optimum` and `pre_core.crossing.sampling`; this is
where a site file becomes priors, draws become parameters, and diagnostics become a verdict
(docs/contract.md).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pre_core import unknowns
from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.crossing import optimum, posterior
from pre_core.crossing.mismatch import as_two_numbers
from pre_core.crossing.preparation import Inputs
from pre_core.crossing.sampling import Sampled, sample
from pre_core.physics.beam_basis import first_frequencies_hz
from pre_core.physics.models import body_masses
from pre_core.physics.simulate import Motion
from pre_core.search.loop import Ending, Report
from schemas import results
from schemas.reasons import Reason, texts
from schemas.settings import IdentificationSettings
from schemas.site import Bridge
from services.identification.checks import stiffer_elements, undeclared_axles
from services.identification.crossing_data import (
    CrossingData,
    Floats,
    Passing,
    caveats,
    detrended,
    header,
    nominal_parameters,
    part_of_elements,
    rejected,
    road_result,
)
from services.identification.fit_reasons import reasons_of_fit
from services.identification.footprints import footprints_of
from services.identification.fusing import stored
from services.identification.lane import lane_factor

_FINITE_ELEMENTS, _FINITE_ELEMENTS_OF_SPAN = 14, 8
"""At least so many in all, and in each of several spans on average, whatever the number of
elements: quicker sensors would see a coarser mesh. A load between nodes sags by 1/(4 n^3) less of a
span's deflection on n elements than it should: 1 % on three, 0.05 % on eight. Five spans on three
elements each: chi2 1.16 and an EI 3.3 standard deviations off; on nine: 0.96 and 1.9."""
_SMALLEST_NOISE_UG = 0.1
"""A declared noise of zero cannot whiten anything; below this, model error dominates."""
_SMALLEST_SPREAD = 1e-6
"""Of a prior, relative: what a site file says is known exactly is a coordinate all the same."""
_SMALLEST_DELAY_S = 1e-9
_USABLE_CHI2 = 2.0
"""Intervals that are widened by the square root of this are wide; a model that fits worse is wrong,
unless it is only the noise that is larger than declared."""
_LARGEST_CHI2 = 25.0
"""Whatever the pattern: noise five times the declared is another sensor, or a broken one, and how
far an interval that is widened by so much can be trusted nobody has measured."""
_EVEN = 0.5
"""Probability before the crossing that a support has no spring, or that a bearing is rigid."""
_ROAD_DRAWS = 80
"""Standard deviations of a road from so many are right to 8 %, and each draw is an evaluation."""
_DEFLECTION_DRAWS = 400
"""Ends of a 95 % interval rest on ten draws at either side; each draw is an evaluation."""
_FREQUENCY_DRAWS = 1000
"""An eigenvalue problem each: cheap enough for 25 draws beyond each end of the interval."""

Keep = Callable[[str, dict[str, Floats]], None]
"""Takes the draws of a crossing: its identifier, and (chains, draws) of every unknown by name."""


def inputs_of(
    data: CrossingData, settings: IdentificationSettings, acceleration: Floats, start_s: float
) -> Inputs:
    """The crossing and the site's knowledge as method `pre` takes them."""
    vehicle, bridge, sensor, receiver = data.vehicle, data.bridge, data.sensor, data.receiver
    assert data.samples is not None  # noqa: S101 - it was checked before
    step_s = 1.0 / data.samples.rate_hz
    stop_s = start_s + step_s * (acceleration.shape[1] - 1)
    time_s = data.fixes.time_s - receiver.latency_s
    near = (time_s > start_s - 1.0) & (time_s < stop_s + 1.0)
    direction = data.stay.direction
    speed = np.abs(data.fixes.speed_m_per_s[near])
    fixes = posterior.Fixes(
        time_s[near],
        data.chainage_m[near] + direction * vehicle.gps_antenna_to_front_axle_m,
        direction * speed,
        max(receiver.position_noise_m, 0.01),
        max(receiver.speed_noise_m_per_s, 0.003),
        float(
            np.hypot(
                max(receiver.position_spread_m, 0.01), receiver.latency_spread_s * speed.mean()
            )
        ),
    )
    density = (
        np.maximum(np.array(sensor.noise_density_ug_per_rthz), _SMALLEST_NOISE_UG)
        * MICRO_G_M_PER_S2
    )
    return Inputs(
        acceleration,
        start_s,
        step_s,
        direction,
        bridge.span_m,
        np.array(bridge.lengths_m),
        bridge.interior_support_nodes,
        vehicle.total_mass_kg,
        vehicle.cg_height_m or 0.0,
        density,
        min(*sensor.rate_hz, data.samples.slowest_rate_hz),
        fixes,
        _priors(data),
        _parts(bridge),
        settings.threads,
        footprints_of(vehicle),
        bridge.torsional_wave_speed_m_per_s,
        lane_factor(data),
    )


def _parts(bridge: Bridge) -> int:
    """Into how many finite elements each element is cut."""
    spans = len(bridge.lengths_of_spans_m)
    wanted = max(_FINITE_ELEMENTS, _FINITE_ELEMENTS_OF_SPAN * spans if spans > 1 else 0)
    return max(1, -(-wanted // bridge.elements))


def _priors(data: CrossingData) -> posterior.Priors:
    """What the site file knows of every unknown of the table."""
    vehicle, bridge = data.vehicle, data.bridge
    of = {unknowns.TRUCK: vehicle, unknowns.BRIDGE: bridge}
    rows = unknowns.table(bridge.elements)
    nominal = nominal_parameters(vehicle, bridge)
    at_zero = (nominal == 0.0) & np.array([row.may_be_zero for row in rows])
    spread = [
        of[row.part].scale_at_zero(row.key) if zero else of[row.part].spread(row.key)
        for row, zero in zip(rows, at_zero, strict=True)
    ]
    spreads = np.array(spread)
    return posterior.Priors(
        nominal,
        np.where(at_zero, spreads, np.maximum(spreads, _SMALLEST_SPREAD)),
        at_zero,
        (at_zero & (spreads > 0.0)) | (nominal > 0.0),
        np.array([absence(bridge, row) for row in rows]),
        vehicle.wheelbase_m,
        max(vehicle.spread("wheelbase_m"), _SMALLEST_SPREAD),
        max(data.sensor.gain_spread, _SMALLEST_SPREAD),
        max(data.sensor.common_gain_spread, _SMALLEST_SPREAD),
        max(data.sensor.delay_spread_s, _SMALLEST_DELAY_S),
    )


def absence(bridge: Bridge, row: unknowns.Unknown) -> float:
    """Probability before the crossing that an unknown is nothing: the site file may know."""
    if not row.may_be_absent:
        return 0.0
    if row.key == "support_rotational_stiffness_nm_per_rad":
        return {"free": 1.0, "sprung": 0.0}.get(bridge.bearings[row.which], _EVEN)
    if row.key == "torsional_flexibility_per_n" and bridge.is_lane_off_axis:
        return 0.0
    return _EVEN


def identify_pre(
    data: CrossingData,
    settings: IdentificationSettings,
    passing: Passing,
    acceleration: Floats,
    start_s: float,
    motion: Motion,
    report: Report,
    elapsed: Callable[[], float],
    keep: Keep,
) -> results.Crossing:
    """The posterior of one crossing as a result; a fit that explains nothing is rejected."""
    inputs = inputs_of(data, settings, acceleration, start_s)
    found = optimum.find_optimum(inputs, report)
    if found.noise_power > optimum.HOPELESS_NOISE:
        return rejected(
            data,
            settings,
            passing,
            [Reason.NOISE_ABOVE_DECLARED],
            chi2_per_dof=found.noise_power,
            diagnostics={
                "iterations": float(found.evaluations),
                "starts": float(found.starts),
                "seconds": elapsed(),
            },
        )
    if found.ending is Ending.NOT_FINITE:
        named = undeclared_axles(data.vehicle, acceleration, inputs.step_s, is_doubted=True)
        return rejected(data, settings, passing, [Reason.NOT_FINITE, *named], named)
    problem, y = found.problem, found.state.y
    diagnostics = {
        "iterations": float(found.evaluations),
        "starts": float(found.starts),
        "position_shift_m": float(y[posterior.layout(problem).offset]),
    }
    against = reasons_of_fit(data, found, acceleration, inputs.step_s)
    reasons, about = list(against.reasons), against.about
    usable = _LARGEST_CHI2 if Reason.NOISE_ABOVE_DECLARED in reasons else _USABLE_CHI2
    # Elsewhere than at the optimum neither values nor widths mean anything.
    if against.forbids or found.ending is not Ending.CONVERGED or found.chi2_per_dof > usable:
        diagnostics["seconds"] = elapsed()
        return rejected(
            data,
            settings,
            passing,
            reasons,
            about,
            chi2_per_dof=found.chi2_per_dof,
            diagnostics=diagnostics,
        )
    inflation = float(np.sqrt(max(1.0, found.chi2_per_dof)))
    chain = sample(found, settings.draws, settings.seed, inflation=inflation, report=report)
    diagnostics |= {
        "r_hat": chain.r_hat,
        "ess": chain.ess,
        "acceptance": chain.acceptance,
        "draws": float(chain.draws.shape[0] * chain.draws.shape[1]),
        "chain_evaluations": float(chain.evaluations),
    }
    if chain.pareto_k is not None:
        diagnostics["pareto_k"] = chain.pareto_k
    if chain.ending is not Ending.STEPS_DONE:
        reasons.append(Reason.SAMPLER_DIAGNOSTICS)
    implausible = _implausible_elements(data.bridge, problem, chain)
    if implausible:
        reasons.append(Reason.IMPLAUSIBLE_BRIDGE)
    reasons += caveats(data, motion)
    values = _values(data, problem, chain, settings, keep)
    diagnostics["seconds"] = elapsed()
    once = tuple(dict.fromkeys(reasons))
    return results.Crossing(
        **header(data, settings, passing),
        verdict="suspect" if once else "good",
        reasons=once,
        reason_texts=tuple(texts(once, {**about, Reason.IMPLAUSIBLE_BRIDGE: implausible})),
        chi2_per_dof=found.chi2_per_dof * found.noise_power,
        diagnostics=diagnostics,
        fusion_likelihood=stored(data, found),
        **values,
    )


def _implausible_elements(bridge: Bridge, problem: posterior.Problem, chain: Sampled) -> str:
    """Return the names of the elements that are stiffer than damage of the others explains."""
    flat = chain.draws.reshape(-1, chain.draws.shape[2])
    rigidity = posterior.values_of(problem, flat).theta[:, unknowns.EI_1 :]
    found = stiffer_elements(rigidity / np.array(bridge.nominal_flexural_rigidity_nm2))
    return ", ".join(f"EI_{e + 1}" for e in found)


def _values(
    data: CrossingData,
    problem: posterior.Problem,
    chain: Sampled,
    settings: IdentificationSettings,
    keep: Keep,
) -> dict[str, Any]:
    """Scale error, parameters, covariance, derived quantities and road from the draws."""
    flat = chain.draws.reshape(-1, chain.draws.shape[2])
    at = posterior.values_of(problem, flat)
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(10**9,)))
    # The total mass scales every force and stiffness of truck and bridge alike; no residual shows
    # its error. That of the common gain is among the unknowns.
    mass_spread = data.vehicle.spread("total_mass_kg")
    scale = np.exp(mass_spread * rng.standard_normal(flat.shape[0]))
    names = unknowns.names(data.bridge.elements)
    theta = at.theta * scale[:, None] ** unknowns.mass_powers(data.bridge.elements)
    kept = np.flatnonzero(problem.priors.estimated)
    values = {
        names[i]: _parameter(unknowns.unit(names[i]), theta[:, i], _prior(problem, int(i)))
        for i in kept
    }
    masses = body_masses(at.theta, data.vehicle.total_mass_kg, data.vehicle.wheelbase_m)
    for k, name in enumerate(("m_s", "m_s1", "m_s2")):
        values[name] = _parameter("kg", masses[:, k] * scale, None)
    covariance = np.cov(theta[:, kept].T)
    draws = {names[i]: theta[:, i] for i in kept}
    draws |= {
        "wheelbase_m": at.wheelbase_m,
        "position_offset_m": flat[:, posterior.layout(problem).offset],
    }
    steps, chains = chain.draws.shape[:2]
    keep(
        data.crossing_id,
        {name: np.ascontiguousarray(x.reshape(steps, chains).T) for name, x in draws.items()},
    )
    return {
        "scale_error": float(np.hypot(mass_spread, np.log(at.common_gain).std())),
        "parameters": values,
        "covariance": results.Covariance(
            names=tuple(names[i] for i in kept),
            matrix=tuple(tuple(row) for row in np.atleast_2d(covariance).tolist()),
        ),
        "derived": _derived(data, problem, at.theta, theta, flat, rng),
        "road": _road(data, problem, flat, rng),
    }


def _parameter(unit: str, draws: Floats, prior: results.Prior | None) -> results.Parameter:
    low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975])
    return results.Parameter(
        unit=unit,
        mean=float(draws.mean()),
        std=float(draws.std()),
        q025=float(low),
        q50=float(middle),
        q975=float(high),
        prior=prior,
    )


def _prior(problem: posterior.Problem, i: int) -> results.Prior:
    priors = problem.priors
    if priors.half_normal[i]:
        return results.Prior(
            distribution="half_normal", location=0.0, scale=float(priors.spread[i])
        )
    return results.Prior(
        distribution="log_normal", location=float(priors.theta[i]), scale=float(priors.spread[i])
    )


def _chosen(count: int, wanted: int, rng: np.random.Generator) -> NDArray[np.int64]:
    return rng.choice(count, min(count, wanted), replace=False)


def _derived(
    data: CrossingData,
    problem: posterior.Problem,
    theta: Floats,
    scaled: Floats,
    flat: Floats,
    rng: np.random.Generator,
) -> results.Derived:
    """What follows from draws of truck and bridge; `scaled` (k, p) has the total mass's error."""
    some = _chosen(theta.shape[0], _FREQUENCY_DRAWS, rng)
    frequencies = first_frequencies_hz(problem.crossing.basis, theta[some])
    few = _chosen(flat.shape[0], _DEFLECTION_DRAWS, rng)
    deflections = posterior.largest_deflections_m(problem, flat[few])
    return results.Derived(
        f1_hz=_parameter("Hz", frequencies, None),
        max_deflection_m=_parameter("m", deflections, None),
        probability_sprung=_probability_of(theta, unknowns.K_ROT),
        probability_giving=_probability_of(theta, unknowns.F),
        probability_torsion=float((theta[:, unknowns.TORSION] > 0.0).mean()),
        springs_believed=posterior.belief_in_springs(problem, flat.mean(axis=0)),
        ei_level=_parameter("1", _level(data.bridge, scaled, 0.0, 1.0), None),
        ei_thirds=results.Thirds(
            **{
                name: _parameter("1", _level(data.bridge, scaled, k / 3.0, (k + 1) / 3.0), None)
                for k, name in enumerate(results.Thirds.model_fields)
            }
        ),
    )


def _level(bridge: Bridge, theta: Floats, begin: float, end: float) -> Floats:
    """Geometric mean of EI over nominal, by length, between two parts of the bridge: (k,)."""
    share = part_of_elements(np.array(bridge.lengths_m), begin, end)
    ratio = theta[:, unknowns.EI_1 :] / np.array(bridge.nominal_flexural_rigidity_nm2)
    return np.asarray(np.exp(np.log(ratio) @ share))


def _probability_of(theta: Floats, place: int) -> results.AtEnds:
    """How often a pair of unknowns, one for each end, is there at all in the draws (k, p)."""
    start, end = (theta[:, place : place + 2] > 0.0).mean(axis=0)
    return results.AtEnds(start=float(start), end=float(end))


def _road(
    data: CrossingData, problem: posterior.Problem, flat: Floats, rng: np.random.Generator
) -> results.Road:
    """The profile at the posterior's mean point, and its spread over some draws.

    Both wheels feel the same road with errors of their own. The posterior knows of their difference
    alone; their mean's is drawn from the sensors' noise.
    """
    few = _chosen(flat.shape[0], _ROAD_DRAWS, rng)
    centre = flat.mean(axis=0)
    x, front, rear = posterior.roads(problem, centre)
    road = road_result(data, x, front, rear)
    grid = np.array(road.x_m)
    noise = posterior.road_noise(problem, centre, few.size, rng)
    profiles = []
    for i, error in zip(few, noise, strict=True):
        own_x, own_front, own_rear = posterior.roads(problem, flat[i])
        mean = np.interp(grid, *_rising(own_x, 0.5 * (own_front + own_rear)))
        error = np.interp(grid, *_rising(x, error))
        profiles.append(detrended(grid, mean + error))
    spread = np.std(profiles, axis=0)
    mismatch = None
    if problem.mismatch.level_m3.any():
        level, corner = as_two_numbers(problem.mismatch)
        mismatch = results.RoadMismatch(A_m3=level, n_0_per_m=corner)
    return road.model_copy(update={"std_m": tuple(spread.tolist()), "mismatch": mismatch})


def _rising(x: Floats, values: Floats) -> tuple[Floats, Floats]:
    return (x, values) if x[0] < x[-1] else (x[::-1], values[::-1])
