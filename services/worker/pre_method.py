"""Method `pre` on one crossing: posterior, verdict, and the result with its uncertainty.

What the numbers are is in `pre_core.pre` and `pre_core.mcmc`; this is where a site file becomes
priors, draws become parameters, and diagnostics become a verdict (docs/contract.md).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import mcmc, parameters, posterior, pre
from pre_core.bridge import natural_frequencies_hz
from pre_core.search import Ending
from pre_core.simulate import Motion
from schemas import results
from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from services.worker.crossing_data import (
    CrossingData,
    Floats,
    Passing,
    beam_of,
    caveats,
    header,
    nominal_parameters,
    rejected,
    road_result,
)

_MICRO_G = 9.80665e-6
_LEARNING_SHARE = 3
_LEARNING_STAGES = 2
_FINITE_ELEMENTS = 14
"""At least so many, whatever the number of elements: quicker sensors would see a coarser mesh."""
_SMALLEST_NOISE_UG = 0.1
"""A declared noise of zero cannot whiten anything; below this, model error dominates."""
_GOOD_CHI2 = 1.25
_USABLE_CHI2 = 4.0
_LARGEST_R_HAT = 1.05
_SMALLEST_ESS = 100.0
_LARGEST_VEHICLE_Z = 4.0
_LARGEST_POSITION_Z = 4.0
_ROAD_DRAWS = 40
_FREQUENCY_DRAWS = 200

Report = Callable[[str, float], None]


class _Chain(NamedTuple):
    draws: Floats  # (n, chains, f)
    r_hat: float
    ess: float
    acceptance: float


def inputs_of(
    data: CrossingData, settings: IdentificationSettings, acceleration: Floats, start_s: float
) -> pre.Inputs:
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
    density = np.maximum(np.array(sensor.noise_density_ug_per_rthz), _SMALLEST_NOISE_UG) * _MICRO_G
    return pre.Inputs(
        acceleration,
        start_s,
        step_s,
        direction,
        bridge.span_m,
        np.array(bridge.lengths_m),
        vehicle.total_mass_kg,
        vehicle.cg_height_m or 0.0,
        density,
        min(sensor.rate_hz),
        fixes,
        _priors(data),
        max(1, -(-_FINITE_ELEMENTS // bridge.elements)),
        settings.threads,
    )


def _priors(data: CrossingData) -> posterior.Priors:
    vehicle, bridge = data.vehicle, data.bridge
    pairs = (
        "suspension_damping_ns_per_m",
        "suspension_stiffness_n_per_m",
        "unsprung_mass_kg",
        "tyre_stiffness_n_per_m",
    )
    springs = [bridge.support_spread_nm_per_rad] * 2
    spread = [
        vehicle.spread("front_axle_to_cg_m"),
        *(vehicle.spread(key) for key in pairs for _ in range(2)),
        vehicle.spread("pitch_inertia_ratio"),
        *[bridge.spread("flexural_rigidity_nm2")] * bridge.elements,
        bridge.spread("mass_per_length_kg_per_m"),
        bridge.spread("rayleigh_alpha_per_s"),
        bridge.spread("rayleigh_beta_s"),
        *springs,
    ]
    return posterior.Priors(
        nominal_parameters(vehicle, bridge),
        np.array(spread),
        vehicle.wheelbase_m,
        vehicle.spread("wheelbase_m"),
        data.sensor.gain_spread,
        data.sensor.common_gain_spread,
        data.sensor.delay_spread_s,
    )


def scale_error(data: CrossingData) -> float:
    """Relative error common to all EI that no residual shows: total mass and common gain.

    Four independent gains have a mean whose spread is half of theirs.
    """
    return float(
        np.sqrt(
            data.vehicle.spread("total_mass_kg") ** 2
            + data.sensor.common_gain_spread**2
            + (0.5 * data.sensor.gain_spread) ** 2
        )
    )


def identify_pre(
    data: CrossingData,
    settings: IdentificationSettings,
    passing: Passing,
    acceleration: Floats,
    start_s: float,
    motion: Motion,
    report: Report,
    elapsed: Callable[[], float],
) -> results.Crossing:
    """The posterior of one crossing as a result; a fit that explains nothing is rejected."""
    found = pre.find_optimum(inputs_of(data, settings, acceleration, start_s), report)
    if found.ending is Ending.NOT_FINITE:
        return rejected(data, settings, passing, [Reason.NOT_FINITE])
    problem, y = found.problem, found.state.y
    diagnostics = {
        "iterations": float(found.evaluations),
        "starts": float(found.starts),
        "position_shift_m": _offset_m(problem, y),
    }
    if found.chi2_per_dof > _USABLE_CHI2:
        diagnostics["seconds"] = elapsed()
        return rejected(
            data,
            settings,
            passing,
            [Reason.MODEL_MISFIT],
            chi2_per_dof=found.chi2_per_dof,
            diagnostics=diagnostics,
        )
    inflation = float(np.sqrt(max(1.0, found.chi2_per_dof)))
    chain = _sample(found, settings, inflation, report)
    diagnostics |= {"r_hat": chain.r_hat, "ess": chain.ess, "acceptance": chain.acceptance}
    reasons = _reasons(data, problem, found, chain, motion)
    values = _values(data, problem, chain, settings)
    diagnostics["seconds"] = elapsed()
    return results.Crossing(
        **header(data, settings, passing),
        verdict="suspect",
        reasons=tuple(reasons),
        chi2_per_dof=found.chi2_per_dof,
        diagnostics=diagnostics,
        scale_error=scale_error(data),
        **values,
    )


def _offset_m(problem: posterior.Problem, y: Floats) -> float:
    """How far the receiver's fixes lie from the trajectory that fits, on the mean."""
    return float(y[posterior.layout(problem).offset])


def _sample(
    found: pre.Optimum, settings: IdentificationSettings, inflation: float, report: Report
) -> _Chain:
    """Markov chains on the posterior; where the fit is imperfect, of noise so much larger."""
    problem = found.problem
    where = posterior.layout(problem)
    springs = np.arange(where.theta.stop - 2, where.theta.stop)
    centre, covariance = pre.normal_approximation(found)
    normal = mcmc.approximation(centre, inflation**2 * covariance, springs, settings.seed)

    def target(points: Floats) -> Floats:
        rows = posterior.all_rows(problem, points)
        return np.asarray(-0.5 / inflation**2 * np.sum(rows * rows, axis=1))

    wanted = max(len(mcmc.RHO), settings.draws // mcmc.CHAINS)
    learning = max(len(mcmc.RHO), wanted // _LEARNING_SHARE)
    state = mcmc.init(target, normal)
    for stage in range(_LEARNING_STAGES):
        seen = []
        for count in range(learning):
            report("learning the posterior's shape", 0.6 + 0.1 * (stage + count / learning))
            state, _ = mcmc.step(target, normal, state)
            seen.append(state.v)
        better = mcmc.adapted(normal, np.stack(seen[learning // 3 :]))
        state = mcmc.moved(target, normal, better, state)
        normal = better
    draws, acceptance = [], []
    for count in range(wanted):
        report("sampling the posterior", 0.8 + 0.2 * count / wanted)
        state, info = mcmc.step(target, normal, state)
        draws.append(state.y)
        acceptance.append(info.acceptance)
    kept = np.stack(draws)
    of_interest = kept[:, :, where.theta]
    return _Chain(
        kept,
        float(mcmc.split_r_hat(of_interest).max()),
        float(mcmc.effective_sample_size(of_interest).min()),
        float(np.mean(acceptance)),
    )


def _reasons(
    data: CrossingData,
    problem: posterior.Problem,
    found: pre.Optimum,
    chain: _Chain,
    motion: Motion,
) -> list[Reason]:
    """Why the crossing is not good.

    The method has not been calibrated on many crossings yet: until then none of its answers is.
    """
    reasons = [Reason.NOT_VALIDATED]
    y = found.state.y
    where = posterior.layout(problem)
    if found.ending is not Ending.CONVERGED:
        reasons.append(Reason.NOT_CONVERGED)
    if found.chi2_per_dof > _GOOD_CHI2:
        reasons.append(Reason.MODEL_MISFIT)
    if chain.r_hat > _LARGEST_R_HAT or chain.ess < _SMALLEST_ESS:
        reasons.append(Reason.SAMPLER_DIAGNOSTICS)
    vehicle = y[: len(parameters.VEHICLE_NAMES)]
    if np.abs(vehicle).max() > _LARGEST_VEHICLE_Z or abs(y[where.wheelbase]) > _LARGEST_VEHICLE_Z:
        reasons.append(Reason.IMPLAUSIBLE_VEHICLE)
    offset_z = problem.receiver_rows[-1, -1] * y[where.offset]
    if abs(offset_z) > _LARGEST_POSITION_Z:
        reasons.append(Reason.POSITION_INCONSISTENT)
    return reasons + caveats(data, motion)


def _values(
    data: CrossingData,
    problem: posterior.Problem,
    chain: _Chain,
    settings: IdentificationSettings,
) -> dict[str, Any]:
    """Parameters, covariance, derived quantities and road from the draws."""
    flat = chain.draws.reshape(-1, chain.draws.shape[2])
    at = posterior.points(problem, flat)
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(10**9,)))
    # Mass and common gain scale every force and stiffness of truck and bridge alike.
    scale = np.exp(scale_error(data) * rng.standard_normal(flat.shape[0]))
    names = parameters.names(data.bridge.elements)
    theta = at.theta.copy()
    scaled = [
        i
        for i, name in enumerate(names)
        if name.startswith(("c_", "k_", "m_", "EI_")) or name == "rhoA"
    ]
    theta[:, scaled] *= scale[:, None]
    kept = [i for i in range(len(names)) if problem.estimated[i]]
    values = {
        names[i]: _parameter(parameters.unit(names[i]), theta[:, i], _prior(problem, i))
        for i in kept
    }
    masses = parameters.body_masses(at.theta, data.vehicle.total_mass_kg, data.vehicle.wheelbase_m)
    for k, name in enumerate(("m_s", "m_s1", "m_s2")):
        values[name] = _parameter("kg", masses[:, k] * scale, None)
    covariance = np.cov(theta[:, kept].T)
    return {
        "parameters": values,
        "covariance": results.Covariance(
            names=tuple(names[i] for i in kept),
            matrix=tuple(tuple(row) for row in np.atleast_2d(covariance).tolist()),
        ),
        "derived": _derived(data, problem, at.theta, flat, rng),
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
    if i >= priors.theta.size - 2:
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
    flat: Floats,
    rng: np.random.Generator,
) -> results.Derived:
    some = _chosen(theta.shape[0], _FREQUENCY_DRAWS, rng)
    frequencies = np.empty(some.size)
    for k, i in enumerate(some):
        frequencies[k] = natural_frequencies_hz(beam_of(data, theta[i]), 1)[0]
    few = _chosen(flat.shape[0], _ROAD_DRAWS, rng)
    deflections = posterior.largest_deflections_m(problem, flat[few])
    return results.Derived(
        f1_hz=_parameter("Hz", frequencies, None),
        max_deflection_m=_parameter("m", deflections, None),
    )


def _road(
    data: CrossingData, problem: posterior.Problem, flat: Floats, rng: np.random.Generator
) -> results.Road:
    """The profile at the posterior's mean point, and its spread over some draws."""
    few = _chosen(flat.shape[0], _ROAD_DRAWS, rng)
    centre = flat.mean(axis=0)
    x, front, rear = posterior.roads(problem, centre)
    road = road_result(data, x, front, rear)
    grid = np.array(road.x_m)
    profiles = []
    for i in few:
        own_x, own_front, own_rear = posterior.roads(problem, flat[i])
        drawn = road_result(data, own_x, own_front, own_rear)
        profiles.append(np.interp(grid, np.array(drawn.x_m), np.array(drawn.mean_m)))
    spread = np.std(profiles, axis=0)
    return road.model_copy(update={"std_m": tuple(spread.tolist())})
