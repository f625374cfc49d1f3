"""Settings of an identification, chosen by the user and stored in every result."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from schemas.results import Method

NOT_OF_THE_RESULT = frozenset({"threads"})
"""Settings that change the duration of an identification but not its result."""


class IdentificationSettings(BaseModel):
    """Settings of one identification."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: Method = "pre"
    seed: Annotated[int, Field(ge=0, lt=1 << 64)] = 1
    parts: Annotated[int, Field(ge=1, le=8)] = 2
    """Finite elements in each element of the site file; with 1, the mesh biases EI at the ends by
    several per cent (studies/reproduction.md)."""
    starts: Annotated[int, Field(ge=1, le=20)] = 3
    """Number of starts of least squares: the nominal values, then others until it converges."""
    particles: Annotated[int, Field(ge=4, le=100_000)] = 500
    """Number of particles of method `random_walk`; the next is the number of their steps."""
    steps: Annotated[int, Field(ge=1, le=100_000)] = 600
    draws: Annotated[int, Field(ge=100, le=1_000_000)] = 1200
    """Posterior draws of method `pre`, all chains together, before convergence is assessed."""
    threads: Annotated[int, Field(ge=1, le=64)] = 2
