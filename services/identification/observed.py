"""Observation of ln EI in a stored result, for the history of its bridge."""

import hashlib

import numpy as np

from pre_core.monitoring.observation import Observation, observation
from schemas.results import CrossingResult
from services.identification.fusing import fusion_input
from services.identification.usable import source_of


def observation_of(result: CrossingResult) -> Observation | None:
    """Return the observation of a result with a valid likelihood; None for others."""
    source = source_of(result)
    if source is None or result.parameters is None:
        return None
    part, priors = fusion_input(source)
    names = [f"EI_{n}" for n in range(1, priors.elements + 1)]
    if not all(name in result.parameters for name in names):
        return None
    ei = np.array([result.parameters[name].q50 for name in names])
    if not np.all(ei > 0.0):
        return None
    mismatch = None if result.road is None else result.road.mismatch
    share = 0.0 if mismatch is None or mismatch.common_share is None else mismatch.common_share
    try:
        found = observation(part, priors, ei, share)
    except np.linalg.LinAlgError:
        return None
    sound = np.all(np.isfinite(found.value)) and np.all(np.linalg.eigvalsh(found.own) > 0.0)
    return _named_shortly(found) if sound else None


def _named_shortly(observation: Observation) -> Observation:
    """Return the observation with short names: a truck's key identifies it completely, in 1 kB."""
    shared = tuple(
        one._replace(name=f"{one.name.split(' ', 1)[0]}-{_digest(one.name)}")
        for one in observation.shared
    )
    return observation._replace(shared=shared)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]
