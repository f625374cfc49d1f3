"""Validation records: results of simulated crossings of one truck on one bridge.

A record is a JSON file named by the hash of everything that it covers (`pair_hash`): another truck,
bridge, sensor, receiver or method is another file.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import Field, JsonValue, model_validator

from schemas.errors import InputError
from schemas.json_file import load_json
from schemas.settings import NOT_OF_THE_RESULT, IdentificationSettings
from schemas.site import Site
from schemas.strict_model import Finite, StrictModel

METHOD_EDITION: Final = 14
"""Version of the crossings' estimates of method `pre`. Raise it with every change that may alter
values, intervals or verdict of a crossing; earlier validation records become void. It is
independent of the program's version, because most versions leave the method unchanged and it may
change between two versions."""

LIKELIHOOD_EDITION: Final = 2
"""Version of the likelihoods that results keep for fusion. Raise it with every change that may
alter one; those of earlier versions are still fused."""

LEAST_COVERAGE: Final = 0.85
"""Smallest coverage of all 95 % intervals that passes. Those of one crossing are dependent: see
studies/site-validation.md."""

_NOT_OF_A_CERTIFICATE: Final = NOT_OF_THE_RESULT | {"seed"}
"""Settings that do not change the method. The seed is chance, which the validation itself varies.
"""
NOT_OF_A_BRIDGE: Final = frozenset({"owner_id", "baseline"})
"""Keys that describe a bridge but not its motion."""


class VehicleBridgePair(NamedTuple):
    """A vehicle and a bridge by their ids."""

    vehicle: str
    bridge: str

    def __str__(self) -> str:
        return f"{self.vehicle} on {self.bridge}"


ValidationHashes = Mapping[VehicleBridgePair, str]
"""Hash of the validation record of each pair that has passed."""


class ValidationConditions(StrictModel):
    """Conditions under which the crossings of a validation are simulated, from the site file."""

    speed_m_per_s: Finite
    road_class: Literal["A", "B", "C", "D", "E"]
    road: Literal["groove", "surface"]
    """Road model: one profile for both axles, or a 2-D surface on which their wheel paths differ.
    """
    rate_hz: Finite
    noise_density_ug_per_rthz: tuple[Finite, Finite, Finite, Finite]


class ValidationCrossing(StrictModel):
    """One simulated crossing: truth and estimate of each element, from the start of the bridge."""

    seed: Annotated[int, Field(ge=0, lt=1 << 64)]
    direction: Literal["start_to_end", "end_to_start"]
    weak_element: Annotated[int, Field(ge=1)] | None = None
    """Number of the element with half its nominal rigidity, all others nominal; None: all are
    drawn."""
    ei_ratio: tuple[Finite, ...]
    """True EI over its nominal value."""
    verdict: Literal["good", "suspect", "rejected", "not_found", "not_simulated"]
    reasons: tuple[str, ...] = ()
    ei_ratio_q025: tuple[Finite, ...] = ()
    ei_ratio_q50: tuple[Finite, ...] = ()
    ei_ratio_q975: tuple[Finite, ...] = ()
    """The three quantiles are of the estimate over nominal; empty where there is none."""
    evaluations: Annotated[int, Field(ge=0)] | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> "ValidationCrossing":
        answers = (self.ei_ratio_q025, self.ei_ratio_q50, self.ei_ratio_q975)
        size = len(self.ei_ratio) if self.is_answered else 0
        if any(len(answer) != size for answer in answers):
            raise ValueError("good and suspect crossings have one answer for each element")
        if min((value for values in (self.ei_ratio, *answers) for value in values), default=1) <= 0:
            raise ValueError("ratios of EI are positive")
        if self.weak_element is not None and self.weak_element > len(self.ei_ratio):
            raise ValueError("weak_element is none of the elements")
        return self

    @property
    def is_answered(self) -> bool:
        """Whether there are intervals."""
        return self.verdict in ("good", "suspect")


class ValidationFigures(StrictModel):
    """Statistics of the crossings of a validation record."""

    crossings: int
    good: int
    intervals: int
    """Number of elements in all crossings with an answer."""
    covered: int
    """Number of 95 % intervals of EI that contain the truth."""
    rms_z: Finite | None = None
    """RMS of the error of ln EI over its standard deviation."""
    largest_z_good: Finite | None = None
    """Largest absolute value of this ratio among crossings with the verdict good."""
    std: Finite | None = None
    """Median relative standard deviation of EI."""
    weak: int
    """Number of crossings with a weak element and an answer."""
    weak_found: int
    """Number of those whose interval of the weak element lies below 0.9 of nominal."""
    evaluations: int
    """Number of model evaluations in all crossings."""

    @property
    def most_missed(self) -> int:
        """Largest number of the intervals that may miss the truth."""
        return int((1.0 - LEAST_COVERAGE) * self.intervals + 1e-9)


class ValidationRecord(StrictModel):
    """Evidence whether a method recovers known truths, for one vehicle on one bridge."""

    program: str = "driveby"
    version: str
    created: Finite
    """Seconds since 1970 UTC."""
    hash: Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
    """Hash of everything that the record covers: `pair_hash`."""
    method_edition: int
    """Method version: `METHOD_EDITION` at the time of the simulation."""
    vehicle: str
    bridge: str
    settings: dict[str, JsonValue]
    seed: Annotated[int, Field(ge=0, lt=1 << 64)]
    conditions: ValidationConditions
    planned: Annotated[int, Field(ge=1)]
    """Planned number of crossings; fewer are simulated if they are conclusive."""
    crossings: tuple[ValidationCrossing, ...]
    figures: ValidationFigures
    passed: bool
    reason: str
    """Reason for passing or failing, one sentence."""

    @property
    def pair(self) -> VehicleBridgePair:
        """The vehicle and the bridge of the record."""
        return VehicleBridgePair(self.vehicle, self.bridge)


def pair_hash(site: Site, pair: VehicleBridgePair, settings: IdentificationSettings) -> str:
    """Return 16 hex digits that change with anything that a validation record covers.

    This is the pair's vehicle and bridge, sensor, receiver, the method and its settings. Neither
    the order of keys nor other vehicles and bridges of the site matter. Raise KeyError if the site
    has no such pair.
    """
    content = {
        "method_edition": METHOD_EDITION,
        "settings": settings.model_dump(mode="json", exclude=set(_NOT_OF_A_CERTIFICATE)),
        "vehicle": site.vehicle(pair.vehicle).shortest(),
        "bridge": site.bridge(pair.bridge).model_dump(mode="json", exclude=set(NOT_OF_A_BRIDGE)),
        "sensor": site.sensor.model_dump(mode="json"),
        "receiver": site.receiver.model_dump(mode="json"),
    }
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def validation_path(folder: Path, digest: str) -> Path:
    """Return the path of the validation record of a hash."""
    return folder / f"{digest}.json"


def validation_json(record: ValidationRecord) -> str:
    """Return the text of a validation record's file."""
    return record.model_dump_json(indent=1) + "\n"


def load_validation(path: Path) -> ValidationRecord:
    """Read a validation record; raise InputError if it is not one or its name is not its hash."""
    found = load_json(ValidationRecord, path, "a validation record")
    if found.hash != path.stem:
        raise InputError(f"{path}: hash: is {found.hash}, it must be the name of its file")
    return found
