"""Results of identifications as the JSON file of docs/contract.md.

Times are seconds since 1970 UTC. A model refuses numbers that are not finite, so NaN is never
written; a value that may be unknown is None. `results_on_the_wire` converts to messages.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple, get_args

from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

from schemas.errors import InputError
from schemas.fusion import FusionLikelihood
from schemas.json_file import load_json
from schemas.reasons import BRIDGE_REASON_TEXTS, BridgeReason, Reason, texts
from schemas.strict_model import Finite, StrictModel

SCHEMA_VERSION: Final = 1

Method = Literal["pre", "least_squares", "random_walk"]
Verdict = Literal["good", "suspect", "rejected"]
VERDICTS: Final[tuple[Verdict, ...]] = get_args(Verdict)
Direction = Literal["start_to_end", "end_to_start"]


class Prior(StrictModel):
    """The prior distribution of a parameter."""

    distribution: Literal["normal", "log_normal", "half_normal", "uniform"]
    location: Finite
    """Nominal value."""
    scale: Finite
    """Relative standard deviation of log_normal, half width of uniform; otherwise the standard
    deviation, or that of the normal of half_normal, in the parameter's unit."""
    probability_zero: Annotated[Finite, Field(ge=0, le=1)] | None = None
    """Probability of exactly zero, where the prior has a spike there; the distribution is that of
    all other values. None without a spike, and in older results."""


class Parameter(StrictModel):
    """A quantity with its uncertainty, all in `unit`."""

    unit: str
    mean: Finite
    std: Finite
    q025: Finite
    q50: Finite
    q975: Finite
    prior: Prior | None = None
    """None for a quantity derived from other parameters."""


class Covariance(StrictModel):
    """Covariance of the parameters, in products of their units."""

    names: tuple[str, ...] = ()
    matrix: tuple[tuple[Finite, ...], ...] = ()

    @model_validator(mode="after")
    def _is_square(self) -> "Covariance":
        size = len(self.names)
        if len(self.matrix) != size or any(len(row) != size for row in self.matrix):
            raise ValueError(f"matrix must be {size} × {size}, as there are {size} names")
        return self


class AtEnds(StrictModel):
    """A probability for each end of the bridge."""

    start: Annotated[Finite, Field(ge=0, le=1)]
    end: Annotated[Finite, Field(ge=0, le=1)]


class Thirds(StrictModel):
    """Overall stiffness of each third of the bridge, from its start."""

    left: Parameter
    middle: Parameter
    right: Parameter


class Derived(StrictModel):
    """Quantities that follow from the parameters."""

    f1_hz: Parameter
    max_deflection_m: Parameter
    probability_sprung: AtEnds | None = None
    """Probability of a rotational restraint at each support; None where a method does not model it.
    """
    probability_giving: AtEnds | None = None
    """Probability that each bearing is compliant."""
    probability_torsion: Annotated[Finite, Field(ge=0, le=1)] | None = None
    """Probability that the deck twists under the truck."""
    springs_believed: Annotated[Finite, Field(ge=0, le=1)] | None = None
    """Weight of the body equations: 1 if linear within sensor noise, near 0 with friction."""
    ei_level: Parameter | None = None
    """Overall stiffness: length-weighted geometric mean of EI over nominal. Known even where single
    elements are unresolved."""
    ei_thirds: Thirds | None = None
    """Overall stiffness of each third of the bridge."""
    probability_below_90_percent_of_baseline: dict[str, Finite] | None = None
    """Probability for each element; None without a stored baseline."""


class RoadMismatch(StrictModel):
    """Spectrum of the profile mismatch: S_d(n) = A/(1 + (n/n_0)²)² in m³, one-sided."""

    A_m3: Annotated[Finite, Field(gt=0)]
    n_0_per_m: Annotated[Finite, Field(gt=0)]
    common_share: Annotated[Finite, Field(ge=0, le=1)] | None = None
    """Share of its power common to all runs of a wheel-path group; None for a single run."""
    bridge_ratio: Annotated[Finite, Field(gt=0)] | None = None
    """Ratio of its amplitude on the bridge to that off it, in waves of 1 m; None in older
    results."""


class RoadResult(StrictModel):
    """The road profile over chainage: of each axle's wheel path, and their mean.

    Each profile is without its own straight line: level and slope are unknown.
    """

    x_m: tuple[Finite, ...]
    front_m: tuple[Finite, ...]
    rear_m: tuple[Finite, ...]
    mean_m: tuple[Finite, ...]
    std_m: tuple[Finite, ...] | None = None
    """Standard deviation of the error of `mean_m` without offset, tilt and bend, that is of the
    error less its least-squares parabola over `x_m`. Twice integrated accelerations do not
    determine the bend, and no spread covers it; nor does it cover waves below a metre at more than
    10 m/s, which are interpolated between samples. None without a noise model."""
    iri_m_per_km: Finite | None = None
    iso_class: str | None = None
    mismatch: RoadMismatch | None = None
    """None where both axles follow one profile within sensor noise."""

    @model_validator(mode="after")
    def _has_one_length(self) -> "RoadResult":
        profiles = (self.front_m, self.rear_m, self.mean_m, self.std_m or self.x_m)
        if any(len(profile) != len(self.x_m) for profile in profiles):
            raise ValueError("all profiles of a road must be as long as x_m")
        return self


_RETIRED_REASONS: Final = frozenset({"tyre_damping_ignored"})
"""Reasons that only older programs gave, always together with another reason."""


def _drop_retired_reasons(values: object) -> object:
    if not isinstance(values, Mapping) or _RETIRED_REASONS.isdisjoint(values.get("reasons") or ()):
        return values
    kept = [code for code in values["reasons"] if code not in _RETIRED_REASONS]
    left = {key: value for key, value in values.items() if key != "reason_texts"}
    return {**left, "reasons": kept}


HUM = ("line_hz", "line_2_hz", "line_3_hz")
"""Names of the diagnostics with the frequencies of removed hum."""


class CrossingResult(StrictModel):
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
    """Hash of the validation record of vehicle and bridge; None without one."""
    verdict: Verdict
    reasons: tuple[Reason, ...] = ()
    reason_texts: tuple[str, ...] = ()
    """Derived from `reasons` if not given."""
    chi2_per_dof: Finite | None = None
    diagnostics: dict[str, Finite] = {}  # noqa: RUF012 - Pydantic copies it
    parameters: dict[str, Parameter] | None
    """None if rejected."""
    scale_error: Finite | None = None
    """Relative standard deviation of the EI error that all elements share."""
    covariance: Covariance | None = None
    derived: Derived | None = None
    road: RoadResult | None = None
    fusion_likelihood: FusionLikelihood | None = None
    """Input of fusion; None where the method provides no likelihood."""
    element_edges_m: tuple[Finite, ...] | None = None
    """Chainages of the elements' ends, from the start on: one more than elements. None in older
    results."""
    nominal_ei_nm2: tuple[Finite, ...] | None = None
    """Nominal EI of each element; None in older results."""

    @model_validator(mode="before")
    @classmethod
    def _sentences(cls, values: object) -> object:
        values = _drop_retired_reasons(values)
        if isinstance(values, Mapping) and values.get("reasons") and "reason_texts" not in values:
            return {**values, "reason_texts": texts(Reason(code) for code in values["reasons"])}
        return values

    @model_validator(mode="after")
    def _verdict_fits(self) -> "CrossingResult":
        if (self.verdict == "rejected") != (self.parameters is None):
            raise ValueError("a rejected crossing has no parameters, every other one has")
        if self.verdict == "rejected" and not self.reasons:
            raise ValueError("a rejected crossing has at least one reason")
        if len(self.reason_texts) != len(self.reasons):
            raise ValueError("reason_texts must have one sentence for each reason")
        return self

    def hum_hz(self) -> tuple[float, ...]:
        """Return the frequencies of the hum that was removed from the signals."""
        return tuple(self.diagnostics[name] for name in HUM if name in self.diagnostics)


class ElementState(StrictModel):
    """Flexural rigidity of one element in N·m²."""

    mean: Finite
    std: Finite
    q025: Finite
    q975: Finite


class LeftOut(StrictModel):
    """A crossing that is excluded from the fused estimate."""

    crossing_id: str
    reason: str


class ThirdsState(StrictModel):
    """Overall stiffness of each third of the bridge from its start, relative to nominal."""

    left: ElementState
    middle: ElementState
    right: ElementState


class Track(StrictModel):
    """The shared part of the profile mismatch in a wheel-path group."""

    vehicle: str
    direction: Direction
    common_share: Annotated[Finite, Field(ge=0, le=1)]
    """Share of its power at waves of 20 m."""
    wander_m: Finite | None = None
    """Lateral wander of the runs; None for a single run."""


LOSSES_PERCENT: Final = (10, 20, 30)


class BridgeResult(BaseModel):
    """The fused estimate of one bridge; its elements are the fields EI_1 … EI_n.

    `verdict` judges the measurement only, `finding` is about the bridge.
    """

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)
    __pydantic_extra__: dict[Annotated[str, Field(pattern=r"^EI_[1-9]\d?$")], ElementState]

    between_crossing_std: Finite | None = None
    """Relative standard deviation of EI between crossings, beyond their own uncertainty."""
    between_crossing_std_q025: Finite | None = None
    between_crossing_std_q975: Finite | None = None
    verdict: Verdict | None = None
    """None from programs without fusion."""
    reasons: tuple[BridgeReason, ...] = ()
    reason_texts: tuple[str, ...] = ()
    """Derived from `reasons` if not given."""
    finding: str | None = None
    weakest_element: str | None = None
    """Name of the element with the smallest EI relative to the baseline or nominal; None if none is
    resolved."""
    probability_of_loss: dict[str, dict[str, Finite]] | None = None
    """Probability of a loss of EI above each percentage, by element that is resolved now and in the
    baseline; None without a baseline."""
    level: ElementState | None = None
    """Overall stiffness: length-weighted geometric mean of EI over nominal."""
    thirds: ThirdsState | None = None
    tracks: tuple[Track, ...] = ()
    crossings_used: tuple[str, ...] = ()
    crossings_left_out: tuple[LeftOut, ...] = ()
    """Excluded crossings; the newest if there are many."""
    crossings_left_out_count: Annotated[int, Field(ge=0)] = 0
    """Number of excluded crossings; counted where an older program listed all without a number."""
    element_edges_m: tuple[Finite, ...] | None = None
    """Chainages of the elements' ends, from the start on: one more than elements. None without
    elements, and in older results."""
    nominal_ei_nm2: tuple[Finite, ...] | None = None
    """Nominal EI of each element, as the newest crossing has it; None like `element_edges_m`."""

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


class Results(StrictModel):
    """A results file."""

    program: str = "driveby"
    version: str
    created: Finite
    """Time at which the computation started, s since 1970 UTC."""
    site_hash: str
    settings: dict[str, JsonValue]
    seed: Annotated[int, Field(ge=0, lt=1 << 64)]
    crossings: tuple[CrossingResult, ...] = ()
    bridges: dict[str, BridgeResult] = {}  # noqa: RUF012 - Pydantic copies it


class ResultHeader(NamedTuple):
    """The fields that a results file has once and every message on the wire repeats."""

    version: str
    created: float
    site_hash: str
    settings: dict[str, JsonValue]
    seed: int
    program: str = "driveby"


RESOLVED = 0.25
"""Largest relative standard deviation of EI of a resolved element: a loss of half of its EI is then
beyond chance."""


def is_torsion_declared(crossing: CrossingResult) -> bool:
    """Return whether the site file places the lane off the axis, so that the deck must twist."""
    torsion = (crossing.parameters or {}).get("torsion")
    prior = None if torsion is None else torsion.prior
    return prior is not None and prior.distribution == "log_normal"


def first_compared_axle(crossing: CrossingResult) -> int:
    """Return the number of the first of the two axles whose profiles were compared.

    The tyres of these axles have parameters; without parameters it is 1.
    """
    names = crossing.parameters or {}
    return min((int(name[3:]) for name in names if name.startswith("k_u")), default=1)


def unresolved_names(crossing: CrossingResult) -> list[str]:
    """Return the names of the elements that a crossing could not resolve."""
    return [
        name
        for name, one in (crossing.parameters or {}).items()
        if name.startswith("EI_") and one.std > RESOLVED * abs(one.mean)
    ]


def unresolved_note(crossing: CrossingResult) -> str | None:
    """Return which elements a crossing could not resolve, in words; None if it resolved all."""
    if crossing.parameters is None or crossing.derived is None or crossing.derived.ei_level is None:
        return None
    open_ones = unresolved_names(crossing)
    if not open_ones:
        return None
    level = crossing.derived.ei_level
    spread = 100.0 * level.std / level.mean
    elements = sum(name.startswith("EI_") for name in crossing.parameters)
    which = f"{len(open_ones)} of {elements} elements"
    return f"overall stiffness / nominal {level.mean:.2f} ± {spread:.0f} %, {which} not resolved"


class LowestElement(NamedTuple):
    """The element with the smallest EI over nominal, and its 95 % interval if there is one."""

    name: str
    ratio: float
    low: float | None
    high: float | None

    def __str__(self) -> str:
        """Return the text, such as EI_4 0.404 of nominal (95 % interval 0.394 to 0.415)."""
        if self.low is None:
            return f"{self.name} {self.ratio:.3f} of nominal"
        interval = f"95 % interval {self.low:.3f} to {self.high:.3f}"
        return f"{self.name} {self.ratio:.3f} of nominal ({interval})"


def lowest_element(crossing: CrossingResult) -> LowestElement | None:
    """Return the element with the smallest EI relative to its prior's nominal value, or None."""
    found = [
        LowestElement(name, value.mean / nominal, value.q025 / nominal, value.q975 / nominal)
        for name, value in (crossing.parameters or {}).items()
        if name.startswith("EI_") and value.prior and (nominal := value.prior.location) > 0.0
    ]
    if not found:
        return None
    lowest = min(found, key=lambda one: one.ratio)
    has_interval = Reason.NO_NOISE_MODEL not in crossing.reasons
    return lowest if has_interval else lowest._replace(low=None, high=None)


def verdict_line(crossing: CrossingResult) -> str:
    """Return verdict, reason codes and lowest element in one line, for logs and lists."""
    against = f" ({', '.join(crossing.reasons)})" if crossing.reasons else ""
    lowest = lowest_element(crossing)
    return f"{crossing.verdict}{against}{'' if lowest is None else f', lowest {lowest}'}"


def results(
    header: ResultHeader, crossings: list[CrossingResult], bridges: dict[str, BridgeResult]
) -> Results:
    """Return a results file with the fields of its header."""
    return Results(**header._asdict(), crossings=tuple(crossings), bridges=bridges)


def results_json(content: Results) -> str:
    """Return the text of a results file."""
    return content.model_dump_json(indent=1) + "\n"


def load_results(path: Path) -> Results:
    """Read a results file; raise InputError in one line if it is not one."""
    if path.suffix == ".mcap" and path.is_file():
        raise InputError(
            f"{path}: is a recording, results are expected: "
            f"driveby identify {path} --json RESULTS.json computes them"
        )
    if path.is_dir():
        raise InputError(
            f"{path}: is a folder, results files are expected: those of a worker are "
            f"{path}/results-*.json, and driveby identify --into writes one with --json"
        )
    return load_json(Results, path, "a results file")
