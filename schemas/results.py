"""Results of identifications: the JSON file of docs/contract.md; `results_on_the_wire`: messages.

Times are seconds since 1970 UTC. A number that is not finite is refused when the model is made, so
NaN is never written; where a value may be unknown it is None.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

from schemas.fusion import FusionLikelihood
from schemas.json_file import load_json
from schemas.reasons import BRIDGE_REASON_TEXTS, BridgeReason, Reason, texts

SCHEMA_VERSION: Final = 1

Method = Literal["pre", "least_squares", "random_walk"]
Verdict = Literal["good", "suspect", "rejected"]
Direction = Literal["start_to_end", "end_to_start"]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Fields(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Prior(_Fields):
    """What was known before the crossing."""

    distribution: Literal["normal", "log_normal", "half_normal", "uniform"]
    location: Finite
    """Nominal value."""
    scale: Finite
    """Relative standard deviation of log_normal, half width of uniform, else in the unit."""


class Parameter(_Fields):
    """A quantity with its uncertainty, all in `unit`."""

    unit: str
    mean: Finite
    std: Finite
    q025: Finite
    q50: Finite
    q975: Finite
    prior: Prior | None = None
    """None for what is derived from other parameters."""


class Covariance(_Fields):
    """Covariance of the parameters, in products of their units."""

    names: tuple[str, ...] = ()
    matrix: tuple[tuple[Finite, ...], ...] = ()

    @model_validator(mode="after")
    def _is_square(self) -> "Covariance":
        size = len(self.names)
        if len(self.matrix) != size or any(len(row) != size for row in self.matrix):
            raise ValueError(f"matrix must be {size} × {size}, as there are {size} names")
        return self


class AtEnds(_Fields):
    """A probability for each end of the bridge."""

    start: Annotated[Finite, Field(ge=0, le=1)]
    end: Annotated[Finite, Field(ge=0, le=1)]


class Thirds(_Fields):
    """The level of each third of the bridge, from its start."""

    left: Parameter
    middle: Parameter
    right: Parameter


class Derived(_Fields):
    """What follows from the parameters."""

    f1_hz: Parameter
    max_deflection_m: Parameter
    probability_sprung: AtEnds | None = None
    """That a rotational spring is at the support at all; None from methods that know of none."""
    probability_giving: AtEnds | None = None
    """That the bearing gives under load at all."""
    probability_torsion: Annotated[Finite, Field(ge=0, le=1)] | None = None
    """That the deck twists under the truck at all."""
    springs_believed: Annotated[Finite, Field(ge=0, le=1)] | None = None
    """How much of what the body's motion says through the truck's springs was believed: 1 if they
    are as linear as the sensors can tell, near 0 where they rub."""
    ei_level: Parameter | None = None
    """The factor common to all elements: geometric mean of EI over nominal, by length. Known where
    single elements are not."""
    ei_thirds: Thirds | None = None
    """The same of each third of the bridge."""
    probability_below_90_percent_of_baseline: dict[str, Finite] | None = None
    """By element; None without a stored baseline."""


class RoadMismatch(_Fields):
    """By how much the axles' roads differ: S_d(n) = A/(1 + (n/n_0)²)² in m³, one-sided."""

    A_m3: Annotated[Finite, Field(gt=0)]
    n_0_per_m: Annotated[Finite, Field(gt=0)]
    common_share: Annotated[Finite, Field(ge=0, le=1)] | None = None
    """What all runs of the truck in one track have in common, a share of its power; of one run
    unknown."""


class Road(_Fields):
    """The road profile over chainage, as each axle felt it and both together."""

    x_m: tuple[Finite, ...]
    front_m: tuple[Finite, ...]
    rear_m: tuple[Finite, ...]
    mean_m: tuple[Finite, ...]
    std_m: tuple[Finite, ...] | None = None
    iri_m_per_km: Finite | None = None
    iso_class: str | None = None
    mismatch: RoadMismatch | None = None
    """None where both axles feel one road, as far as the sensors tell."""

    @model_validator(mode="after")
    def _has_one_length(self) -> "Road":
        profiles = (self.front_m, self.rear_m, self.mean_m, self.std_m or self.x_m)
        if any(len(profile) != len(self.x_m) for profile in profiles):
            raise ValueError("all profiles of a road must be as long as x_m")
        return self


_OLD_REASONS: Final = frozenset({"tyre_damping_ignored"})
"""That older programs gave, always beside another one."""


def _without_old_reasons(values: object) -> object:
    if not isinstance(values, Mapping) or _OLD_REASONS.isdisjoint(values.get("reasons") or ()):
        return values
    kept = [code for code in values["reasons"] if code not in _OLD_REASONS]
    left = {key: value for key, value in values.items() if key != "reason_texts"}
    return {**left, "reasons": kept}


class Crossing(_Fields):
    """The result of one crossing by one method."""

    crossing_id: str
    realm: str
    vehicle: str
    bridge: str
    direction: Direction
    entry_time: Finite
    exit_time: Finite
    speed_m_per_s: Finite
    method: Method
    certificate: str | None = None
    verdict: Verdict
    reasons: tuple[Reason, ...] = ()
    reason_texts: tuple[str, ...] = ()
    """Filled in from `reasons` if not given."""
    chi2_per_dof: Finite | None = None
    diagnostics: dict[str, Finite] = {}
    parameters: dict[str, Parameter] | None
    """None if rejected."""
    scale_error: Finite | None = None
    covariance: Covariance | None = None
    derived: Derived | None = None
    road: Road | None = None
    fusion_likelihood: FusionLikelihood | None = None
    """What fusion needs of the crossing; None from methods that know of none."""

    @model_validator(mode="before")
    @classmethod
    def _sentences(cls, values: object) -> object:
        values = _without_old_reasons(values)
        if isinstance(values, Mapping) and values.get("reasons") and "reason_texts" not in values:
            return {**values, "reason_texts": texts(Reason(code) for code in values["reasons"])}
        return values

    @model_validator(mode="after")
    def _verdict_fits(self) -> "Crossing":
        if (self.verdict == "rejected") != (self.parameters is None):
            raise ValueError("a rejected crossing has no parameters, every other one has")
        if self.verdict == "rejected" and not self.reasons:
            raise ValueError("a rejected crossing has at least one reason")
        if len(self.reason_texts) != len(self.reasons):
            raise ValueError("reason_texts must have one sentence for each reason")
        return self


class ElementState(_Fields):
    """Flexural rigidity of one element in N·m²."""

    mean: Finite
    std: Finite
    q025: Finite
    q975: Finite


class LeftOut(_Fields):
    """A crossing that is not in the fused estimate."""

    crossing_id: str
    reason: str


class ThirdsState(_Fields):
    """The level of each third of the bridge, from its start, relative to nominal."""

    left: ElementState
    middle: ElementState
    right: ElementState


class Track(_Fields):
    """What the runs of a truck in one direction share of the mismatch of its axles' roads."""

    vehicle: str
    direction: Direction
    common_share: Annotated[Finite, Field(ge=0, le=1)]
    """Of its power at waves of 20 m."""
    wander_m: Finite | None = None
    """How far the runs lie beside each other; None of a single run."""


LOSSES_PERCENT: Final = (10, 20, 30)


class BridgeResult(BaseModel):
    """The fused estimate of one bridge; its elements are fields EI_1 … EI_n.

    `verdict` judges the measurement and nothing else, `finding` is about the bridge.
    """

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)
    __pydantic_extra__: dict[Annotated[str, Field(pattern=r"^EI_[1-9]\d?$")], ElementState]

    between_crossing_std: Finite | None = None
    """Relative standard deviation of EI from crossing to crossing, beyond what each can tell."""
    between_crossing_std_q025: Finite | None = None
    between_crossing_std_q975: Finite | None = None
    verdict: Verdict | None = None
    """None from programs that did not fuse."""
    reasons: tuple[BridgeReason, ...] = ()
    reason_texts: tuple[str, ...] = ()
    """Filled in from `reasons` if not given."""
    finding: str | None = None
    weakest_element: str | None = None
    """Of which EI is smallest, relative to the baseline or to nominal."""
    probability_of_loss: dict[str, dict[str, Finite]] | None = None
    """By element and per cent: that it lost more of the baseline's EI; None without a baseline."""
    level: ElementState | None = None
    """Geometric mean of EI over nominal, by length."""
    thirds: ThirdsState | None = None
    tracks: tuple[Track, ...] = ()
    crossings_used: tuple[str, ...] = ()
    crossings_left_out: tuple[LeftOut, ...] = ()
    """The newest of them, if there are many."""
    crossings_left_out_count: Annotated[int, Field(ge=0)] = 0
    """How many there are; filled in where an older program did not say it, and listed all."""

    @model_validator(mode="before")
    @classmethod
    def _counted(cls, values: object) -> object:
        if not isinstance(values, Mapping):
            return values
        filled = dict(values)
        if values.get("crossings_left_out_count") is None:
            filled["crossings_left_out_count"] = len(values.get("crossings_left_out", ()))
        if values.get("reasons") and not values.get("reason_texts"):
            codes = [BridgeReason(code) for code in values["reasons"]]
            filled["reason_texts"] = [BRIDGE_REASON_TEXTS[code] for code in codes]
        return filled

    @property
    def elements(self) -> dict[str, ElementState]:
        """EI_1 … EI_n in the order of their numbers."""
        extra = self.__pydantic_extra__
        return {name: extra[name] for name in sorted(extra, key=lambda n: int(n[3:]))}


class Results(_Fields):
    """A results file."""

    program: str = "driveby"
    version: str
    created: Finite
    site_hash: str
    settings: dict[str, JsonValue]
    seed: Annotated[int, Field(ge=0, lt=1 << 64)]
    crossings: tuple[Crossing, ...] = ()
    bridges: dict[str, BridgeResult] = {}


class Header(NamedTuple):
    """What a results file says once and a message on the wire says each time."""

    version: str
    created: float
    site_hash: str
    settings: dict[str, JsonValue]
    seed: int
    program: str = "driveby"


RESOLVED = 0.25
"""Relative standard deviation of EI up to which an element is called resolved: a loss of half of it
is then beyond chance."""


def resolution(crossing: Crossing) -> str | None:
    """In words what a crossing could not tell; None where it resolves every element."""
    if crossing.parameters is None or crossing.derived is None or crossing.derived.ei_level is None:
        return None
    elements = [p for name, p in crossing.parameters.items() if name.startswith("EI_")]
    open_ones = sum(p.std > RESOLVED * abs(p.mean) for p in elements)
    if open_ones == 0:
        return None
    level = crossing.derived.ei_level
    spread = 100.0 * level.std / level.mean
    which = "elements" if open_ones == len(elements) else f"{open_ones} of {len(elements)} elements"
    return f"mean level {level.mean:.2f} of nominal ± {spread:.0f} %, {which} not resolved"


class Lowest(NamedTuple):
    """The element of least EI over nominal, with its 95 % interval where the method knows one."""

    name: str
    ratio: float
    low: float | None
    high: float | None

    def __str__(self) -> str:
        """As EI_4 0.404 of nominal (0.394 to 0.415)."""
        interval = "" if self.low is None else f" ({self.low:.3f} to {self.high:.3f})"
        return f"{self.name} {self.ratio:.3f} of nominal{interval}"


def lowest_element(crossing: Crossing) -> Lowest | None:
    """The element of least EI over nominal, which is that of its prior; None without any."""
    found = [
        Lowest(name, value.mean / nominal, value.q025 / nominal, value.q975 / nominal)
        for name, value in (crossing.parameters or {}).items()
        if name.startswith("EI_") and value.prior and (nominal := value.prior.location) > 0.0
    ]
    if not found:
        return None
    lowest = min(found, key=lambda one: one.ratio)
    has_interval = Reason.NO_NOISE_MODEL not in crossing.reasons
    return lowest if has_interval else lowest._replace(low=None, high=None)


def verdict_line(crossing: Crossing) -> str:
    """Verdict, codes of its reasons and the lowest element: one line for logs and lists."""
    against = f" ({', '.join(crossing.reasons)})" if crossing.reasons else ""
    lowest = lowest_element(crossing)
    return f"{crossing.verdict}{against}{'' if lowest is None else f', lowest {lowest}'}"


def results(header: Header, crossings: list[Crossing], bridges: dict[str, BridgeResult]) -> Results:
    """Put a results file together."""
    return Results(**header._asdict(), crossings=tuple(crossings), bridges=bridges)


def results_json(content: Results) -> str:
    """Return the text of a results file."""
    return content.model_dump_json(indent=1) + "\n"


def load_results(path: Path) -> Results:
    """Read a results file; raise InputError with one line if it is none."""
    return load_json(Results, path, "a results file")
