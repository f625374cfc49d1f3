"""How an identification is done: what a user may choose, and what goes into every result."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from schemas.results import Method

NOT_OF_THE_RESULT = frozenset({"threads"})
"""Settings that change how long an identification takes, and nothing of its result."""


class IdentificationSettings(BaseModel):
    """Settings of one identification."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: Method = "pre"
    seed: Annotated[int, Field(ge=0, lt=1 << 64)] = 1
    parts: Annotated[int, Field(ge=1, le=8)] = 2
    """Finite elements in each element of the site file: with 1, its own mesh biases EI at the ends
    by several per cent (docs/reproduction.md)."""
    starts: Annotated[int, Field(ge=1, le=20)] = 3
    """Least squares begins at the nominal values and, where it does not converge, elsewhere."""
    particles: Annotated[int, Field(ge=4, le=100_000)] = 500
    steps: Annotated[int, Field(ge=1, le=100_000)] = 600
    draws: Annotated[int, Field(ge=100, le=1_000_000)] = 1200
    """Draws from the posterior of method `pre`, all chains together, before they are judged."""
    threads: Annotated[int, Field(ge=1, le=64)] = 2
