"""Method `pre` on one crossing: posterior, verdict, and the result with its uncertainty.

`pre_core.crossing.optimum` and `pre_core.crossing.sampling` compute the numbers. This module
converts a site file into priors, draws into parameters, and diagnostics into a verdict
(docs/contract.md).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import parameters
from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.crossing import optimum, posterior
from pre_core.crossing.fit import Optimum
from pre_core.crossing.mismatch import pavement_ratio, two_parameter_spectrum
from pre_core.crossing.preparation import CrossingInputs, lines_hz
from pre_core.crossing.sampling import PosteriorDraws, sample
from pre_core.physics.beam_basis import first_frequencies_hz
from pre_core.physics.models import body_masses
from pre_core.search.loop import Report, Termination
from schemas import results
from schemas.reasons import Reason, texts
from schemas.settings import IdentificationSettings
from schemas.site import Bridge
from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData
from services.finding.placed import first_axle
from services.identification.checks import stiffer_elements, undeclared_axles
from services.identification.fit_reasons import contradictions, reasons_of_fit
from services.identification.footprints import (
    displaced_trucks_of,
    footprints_of,
    front_footprints_of,
    tandem_truck_of,
)
from services.identification.fusing import stored
from services.identification.lane import lane_factor
from services.identification.result_parts import (
    CrossingSamples,
    CrossingTimes,
    caveats,
    detrended,
    element_shares,
    header,
    nominal_parameters,
    rejected,
    road_result,
    summary_of,
)

_FINITE_ELEMENTS, _FINITE_ELEMENTS_OF_SPAN = 14, 8
"""Smallest number of finite elements, in all and on average for each of several spans, whatever the
number of elements of the site file; fast sensors resolve a coarser mesh. With n elements the
deflection under a load between nodes is too small by 1/(4 n^3) of the span's: 1 % on three, 0.05 %
on eight. Five spans of three elements each: chi2 1.16 and an EI off by 3.3 standard deviations; of
nine: 0.96 and 1.9."""
_SMALLEST_NOISE_UG = 0.1
"""Smallest noise density used. Zero would make whitening impossible; below this value the error of
the model dominates."""
_SMALLEST_SPREAD = 1e-6
"""Smallest relative spread of a prior. A value that a site file declares exact remains a
coordinate."""
_SMALLEST_DELAY_S = 1e-9
_USABLE_CHI2 = 2.0
"""Largest chi2 per degree of freedom of a fit whose numbers are published, with intervals widened
by its square root. A model that fits worse is wrong, unless noise alone explains it."""
_LARGEST_CHI2 = 25.0
"""Limit where noise alone explains the residuals. Noise of five times the declared comes from
another sensor, or a broken one, and no measurement supports intervals widened by more."""
_ABSENCE = 0.5
"""Prior probability that a support has no spring, or that a bearing is rigid."""
_ROAD_DRAWS = 80
"""Draws from which the road's standard deviation is computed, to 8 %; each costs an evaluation."""
_DEFLECTION_DRAWS = 400
"""Draws for deflections: ten beyond each end of a 95 % interval; each costs an evaluation."""
_FREQUENCY_DRAWS = 1000
"""Draws for frequencies: 25 beyond each end of the interval; each costs an eigenvalue problem."""

Keep = Callable[[str, dict[str, Floats]], None]
"""Receiver of the draws of a crossing: its identifier and, by name, each parameter's (chains,
draws)."""


class MethodRun(NamedTuple):
    """Callbacks of a run of a method."""

    report: Report
    elapsed: Callable[[], float]
    """Time in s since the identification began."""
    keep: Keep


def inputs_of(
    data: CrossingData, settings: IdentificationSettings, acceleration: Floats, start_s: float
) -> CrossingInputs:
    """Return the crossing and the site file's knowledge as inputs of method `pre`.

    `acceleration` is (4, n) in m/s², `start_s` the time of its first sample.
    """
    vehicle, bridge, sensor, receiver = data.vehicle, data.bridge, data.sensor, data.receiver
    assert data.samples is not None  # noqa: S101 - it was checked before
    step_s = 1.0 / data.samples.rate_hz
    stop_s = start_s + step_s * (acceleration.shape[1] - 1)
    truck = tandem_truck_of(vehicle)
    antenna_m = vehicle.gps_antenna_to_front_axle_m - truck.front.ahead_m.max(initial=0.0)
    time_s = data.fixes.time_s - receiver.latency_s
    near = (time_s > start_s - 1.0) & (time_s < stop_s + 1.0)
    direction = data.stay.direction
    speed = np.abs(data.fixes.speed_m_per_s[near])
    fixes = posterior.ChainageFixes(
        time_s[near],
        data.chainage_m[near] + direction * antenna_m,
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
    return CrossingInputs(
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
        truck,
        front_footprints_of(vehicle),
        displaced_trucks_of(vehicle),
    )


def _parts(bridge: Bridge) -> int:
    """Return the number of finite elements in each element of the site file."""
    spans = len(bridge.lengths_of_spans_m)
    wanted = max(_FINITE_ELEMENTS, _FINITE_ELEMENTS_OF_SPAN * spans if spans > 1 else 0)
    return max(1, -(-wanted // bridge.elements))


def _priors(data: CrossingData) -> posterior.Priors:
    """Return the priors of all parameters of the table."""
    vehicle, bridge = data.vehicle, data.bridge
    of = {parameters.TRUCK: vehicle, parameters.BRIDGE: bridge}
    rows = parameters.table(bridge.elements)
    nominal = nominal_parameters(vehicle, bridge)
    tandem = vehicle.tandem
    # No equation contains the springs of a truck with an equalised tandem.
    is_equalised = tandem is not None and tandem.is_equalised
    unused = np.array([is_equalised and row.key in parameters.SPRINGS for row in rows])
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
        ((at_zero & (spreads > 0.0)) | (nominal > 0.0)) & ~unused,
        np.array([absence(bridge, row) for row in rows]),
        vehicle.wheelbase_m if tandem is None else tandem.gap_m,
        max(vehicle.spread("wheelbase_m"), _SMALLEST_SPREAD),
        max(data.sensor.gain_spread, _SMALLEST_SPREAD),
        max(data.sensor.common_gain_spread, _SMALLEST_SPREAD),
        max(data.sensor.delay_spread_s, _SMALLEST_DELAY_S),
    )


def absence(bridge: Bridge, row: parameters.ParameterSpec) -> float:
    """Return the prior probability that a parameter is exactly zero; a site file may fix it."""
    if not row.may_be_absent:
        return 0.0
    if row.key == "support_rotational_stiffness_nm_per_rad":
        return {"free": 1.0, "sprung": 0.0}.get(bridge.bearings[row.pair_index], _ABSENCE)
    if row.key == "torsional_flexibility_per_n" and bridge.is_lane_off_axis:
        return 0.0
    return _ABSENCE


def identify_pre(
    data: CrossingData,
    settings: IdentificationSettings,
    passing: CrossingTimes,
    cut: CrossingSamples,
    run: MethodRun,
) -> results.CrossingResult:
    """Return the posterior of one crossing as a result; a fit that explains nothing is rejected."""
    inputs = inputs_of(data, settings, cut.acceleration, cut.start_s)
    found = optimum.find_optimum(inputs, run.report)
    reject = partial(rejected, data, settings, passing)
    if found.noise_power > optimum.HOPELESS_NOISE:
        counted = {"iterations": float(found.evaluations), "starts": float(found.starts)}
        return reject(
            [Reason.NOISE_ABOVE_DECLARED],
            chi2_per_dof=found.noise_power,
            diagnostics=counted | {"seconds": run.elapsed()},
        )
    if found.ending is Termination.NOT_FINITE:
        named = undeclared_axles(data.vehicle, cut.acceleration, inputs.step_s, has_reasons=True)
        return reject([Reason.NOT_FINITE, *named], named)
    diagnostics = _diagnostics_of_search(found)
    against = reasons_of_fit(data, found, cut.acceleration, inputs.step_s)
    reasons, about = list(against.reasons), against.about
    usable = _LARGEST_CHI2 if Reason.NOISE_ABOVE_DECLARED in reasons else _USABLE_CHI2
    # Away from the optimum neither values nor widths have a meaning.
    if against.forbids or found.ending is not Termination.CONVERGED or found.chi2_per_dof > usable:
        diagnostics["seconds"] = run.elapsed()
        return reject(reasons, about, chi2_per_dof=found.chi2_per_dof, diagnostics=diagnostics)
    inflation = float(np.sqrt(max(1.0, found.chi2_per_dof)))
    chain = sample(found, settings.draws, settings.seed, inflation=inflation, report=run.report)
    diagnostics |= _diagnostics_of_draws(chain)
    if chain.ending is not Termination.STEPS_DONE:
        reasons.append(Reason.SAMPLER_DIAGNOSTICS)
    implausible = _implausible_elements(data.bridge, found.problem, chain)
    if implausible:
        reasons.append(Reason.IMPLAUSIBLE_BRIDGE)
    reasons += caveats(data, cut.motion)
    values = _values(data, found.problem, chain, settings, run.keep)
    diagnostics |= contradictions(data.bridge, found.problem, chain.draws, values["derived"])
    diagnostics["seconds"] = run.elapsed()
    once = tuple(dict.fromkeys(reasons))
    return results.CrossingResult(
        **header(data, settings, passing),
        verdict="suspect" if once else "good",
        reasons=once,
        reason_texts=tuple(texts(once, {**about, Reason.IMPLAUSIBLE_BRIDGE: implausible})),
        chi2_per_dof=found.chi2_per_dof * found.noise_power,
        diagnostics=diagnostics,
        fusion_likelihood=stored(data, found, chain.points),
        **values,
    )


def _diagnostics_of_search(found: Optimum) -> dict[str, float]:
    shift_m = found.state.y[posterior.layout(found.problem).offset]
    return {
        "iterations": float(found.evaluations),
        "starts": float(found.starts),
        "position_shift_m": float(shift_m),
        **dict(zip(results.HUM, lines_hz(found.problem), strict=False)),
    }


def _diagnostics_of_draws(chain: PosteriorDraws) -> dict[str, float]:
    diagnostics = {
        "r_hat": chain.r_hat,
        "ess": chain.ess,
        "acceptance": chain.acceptance,
        "draws": float(chain.draws.shape[0] * chain.draws.shape[1]),
        "chain_evaluations": float(chain.evaluations),
    }
    # One draw with all the weight makes it infinite, which no number of a result may be.
    if chain.pareto_k is not None and np.isfinite(chain.pareto_k):
        diagnostics["pareto_k"] = chain.pareto_k
    return diagnostics


def _implausible_elements(
    bridge: Bridge, problem: posterior.PosteriorProblem, chain: PosteriorDraws
) -> str:
    """Return the names of the elements that are stiffer than damage of the others explains."""
    flat = chain.draws.reshape(-1, chain.draws.shape[2])
    rigidity = posterior.values_of(problem, flat).theta[:, parameters.EI_1 :]
    found = stiffer_elements(rigidity / np.array(bridge.nominal_flexural_rigidity_nm2))
    return ", ".join(f"EI_{e + 1}" for e in found)


def _values(
    data: CrossingData,
    problem: posterior.PosteriorProblem,
    chain: PosteriorDraws,
    settings: IdentificationSettings,
    keep: Keep,
) -> dict[str, Any]:
    """Return common scale uncertainty, parameters, covariance, derived quantities and road."""
    flat = chain.draws.reshape(-1, chain.draws.shape[2])
    at = posterior.values_of(problem, flat)
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(10**9,)))
    # The total mass scales every force and stiffness of truck and bridge alike; no residual shows
    # its error. The common gain, in contrast, is an estimated parameter.
    mass_spread = data.vehicle.spread("total_mass_kg")
    scale = np.exp(mass_spread * rng.standard_normal(flat.shape[0]))
    names = parameters.names(data.bridge.elements, first_axle(data.vehicle))
    theta = at.theta * scale[:, None] ** parameters.mass_powers(data.bridge.elements)
    kept = np.flatnonzero(problem.priors.estimated)
    values = {
        names[i]: summary_of(parameters.unit(names[i]), theta[:, i], _prior(problem, int(i)))
        for i in kept
    }
    behind_kg = data.vehicle.total_mass_kg - problem.crossing.tandem.front.unsprung_mass_kg.sum()
    masses = body_masses(at.theta, behind_kg, data.vehicle.wheelbase_m)
    for k, name in enumerate(("m_s", "m_s1", "m_s2")):
        values[name] = summary_of("kg", masses[:, k] * scale, None)
    offset_m = flat[:, posterior.layout(problem).offset]
    placement = {"wheelbase_m": at.wheelbase_m, "position_offset_m": offset_m}
    for name, prior in _placement_priors(problem).items():
        values[name] = summary_of(parameters.unit(name), placement[name], prior)
    covariance = np.cov(theta[:, kept].T)
    draws = {names[i]: theta[:, i] for i in kept}
    draws |= placement
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


def _prior(problem: posterior.PosteriorProblem, i: int) -> results.Prior:
    priors = problem.priors
    if priors.half_normal[i]:
        return results.Prior(
            distribution="half_normal",
            location=0.0,
            scale=float(priors.spread[i]),
            probability_zero=float(priors.absence[i]) or None,
        )
    return results.Prior(
        distribution="log_normal", location=float(priors.theta[i]), scale=float(priors.spread[i])
    )


def _placement_priors(problem: posterior.PosteriorProblem) -> dict[str, results.Prior]:
    """Return the priors of the wheelbase and of the receiver's slow error along the chainage."""
    priors = problem.priors
    receiver_m = float(1.0 / problem.receiver_rows[-1, -1])
    return {
        "wheelbase_m": results.Prior(
            distribution="log_normal", location=priors.wheelbase_m, scale=priors.wheelbase_spread
        ),
        "position_offset_m": results.Prior(distribution="normal", location=0.0, scale=receiver_m),
    }


def _chosen(count: int, wanted: int, rng: np.random.Generator) -> NDArray[np.int64]:
    return rng.choice(count, min(count, wanted), replace=False)


def _derived(
    data: CrossingData,
    problem: posterior.PosteriorProblem,
    theta: Floats,
    scaled: Floats,
    flat: Floats,
    rng: np.random.Generator,
) -> results.Derived:
    """Return the quantities derived from draws of truck and bridge, `theta` (k, p).

    `scaled` (k, p) includes the error of the total mass.
    """
    some = _chosen(theta.shape[0], _FREQUENCY_DRAWS, rng)
    frequencies = first_frequencies_hz(problem.crossing.basis, theta[some])
    few = _chosen(flat.shape[0], _DEFLECTION_DRAWS, rng)
    deflections = posterior.largest_deflections_m(problem, flat[few])
    return results.Derived(
        f1_hz=summary_of("Hz", frequencies, None),
        max_deflection_m=summary_of("m", deflections, None),
        probability_sprung=_probability_of(theta, parameters.K_ROT),
        probability_giving=_probability_of(theta, parameters.F),
        probability_torsion=float((theta[:, parameters.TORSION] > 0.0).mean()),
        springs_believed=posterior.suspension_equation_weight(problem, flat.mean(axis=0)),
        ei_level=summary_of("1", _level(data.bridge, scaled, 0.0, 1.0), None),
        ei_thirds=results.Thirds(
            **{
                name: summary_of("1", _level(data.bridge, scaled, k / 3.0, (k + 1) / 3.0), None)
                for k, name in enumerate(results.Thirds.model_fields)
            }
        ),
    )


def _level(bridge: Bridge, theta: Floats, begin: float, end: float) -> Floats:
    """Return the geometric mean (k,) of EI over nominal, weighted by length, between two places.

    `begin` and `end` are fractions of the span.
    """
    share = element_shares(np.array(bridge.lengths_m), begin, end)
    ratio = theta[:, parameters.EI_1 :] / np.array(bridge.nominal_flexural_rigidity_nm2)
    return np.asarray(np.exp(np.log(ratio) @ share))


def _probability_of(theta: Floats, place: int) -> results.AtEnds:
    """Return the share of draws (k, p) in which each of a pair of parameters is not zero."""
    start, end = (theta[:, place : place + 2] > 0.0).mean(axis=0)
    return results.AtEnds(start=float(start), end=float(end))


def _road(
    data: CrossingData, problem: posterior.PosteriorProblem, flat: Floats, rng: np.random.Generator
) -> results.RoadResult:
    """Return the profile at the posterior's mean point, and its spread over some draws.

    Both wheels follow the same profile with separate errors. The posterior constrains only their
    difference; the error of their mean is drawn from the sensors' noise.
    """
    few = _chosen(flat.shape[0], _ROAD_DRAWS, rng)
    centre = flat.mean(axis=0)
    x, front, rear = posterior.wheel_profiles(problem, centre)
    road = road_result(data, x, front, rear)
    grid = np.array(road.x_m)
    noise = posterior.road_noise(problem, centre, few.size, rng)
    profiles = []
    for i, error in zip(few, noise, strict=True):
        own_x, own_front, own_rear = posterior.wheel_profiles(problem, flat[i])
        mean = np.interp(grid, *_rising(own_x, 0.5 * (own_front + own_rear)))
        error = np.interp(grid, *_rising(x, error))
        profiles.append(detrended(grid, mean + error))
    spread = np.std(profiles, axis=0)
    mismatch = None
    if problem.mismatch.level_m3.any():
        level, corner = two_parameter_spectrum(problem.mismatch)
        ratio = pavement_ratio(problem.mismatch)
        mismatch = results.RoadMismatch(A_m3=level, n_0_per_m=corner, bridge_ratio=ratio)
    return road.model_copy(update={"std_m": tuple(spread.tolist()), "mismatch": mismatch})


def _rising(x: Floats, values: Floats) -> tuple[Floats, Floats]:
    return (x, values) if x[0] < x[-1] else (x[::-1], values[::-1])
