"""Certificates: what simulated crossings of one truck on one bridge showed, before real ones count.

A certificate is a JSON file named by the hash of all that it vouches for (`pair_hash`): another
truck, bridge, sensor, receiver or method is another file.
"""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

from schemas.errors import InputError
from schemas.json_file import load_json
from schemas.results import Finite
from schemas.settings import NOT_OF_THE_RESULT, IdentificationSettings
from schemas.site import Site

METHOD_EDITION: Final = 3
"""Of what method `pre` answers. To be raised with every change after which it may answer a crossing
otherwise: certificates of before are void then. Not the program's version, which says nothing of
the method: most versions leave it as it was, and it changes between two versions."""

_NOT_OF_A_CERTIFICATE: Final = NOT_OF_THE_RESULT | {"seed"}
"""Settings that make no other method. The seed is chance, which is what a certificate is about."""
_NOT_OF_A_BRIDGE: Final = frozenset({"owner_id", "baseline"})
"""What is said of a bridge and not of how it moves."""


class Pair(NamedTuple):
    """A vehicle and a bridge by their ids."""

    vehicle: str
    bridge: str

    def __str__(self) -> str:
        return f"{self.vehicle} on {self.bridge}"


class _Fields(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Conditions(_Fields):
    """How the crossings of a certificate were driven and measured, as the site file says."""

    speed_m_per_s: Finite
    road_class: Literal["A", "B", "C", "D", "E"]
    road: Literal["groove", "surface"]
    """One groove for both axles, or a surface where they feel different strips."""
    rate_hz: Finite
    noise_density_ug_per_rthz: tuple[Finite, Finite, Finite, Finite]


class Tried(_Fields):
    """One simulated crossing: what went in and what came out, element by element from the start."""

    seed: Annotated[int, Field(ge=0, lt=1 << 64)]
    direction: Literal["start_to_end", "end_to_start"]
    weak_element: Annotated[int, Field(ge=1)] | None = None
    """The one of half its nominal rigidity where all others have theirs; None: all are drawn."""
    ei_ratio: tuple[Finite, ...]
    """The truth: EI over its nominal value."""
    verdict: Literal["good", "suspect", "rejected", "not_found", "not_simulated"]
    reasons: tuple[str, ...] = ()
    ei_ratio_q025: tuple[Finite, ...] = ()
    ei_ratio_q50: tuple[Finite, ...] = ()
    ei_ratio_q975: tuple[Finite, ...] = ()
    """What was identified, over the nominal value; empty where there is no answer."""
    evaluations: Annotated[int, Field(ge=0)] | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> "Tried":
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


class Figures(_Fields):
    """What the crossings of a certificate say together."""

    crossings: int
    good: int
    intervals: int
    """Elements of all crossings with an answer."""
    covered: int
    """95 % intervals of EI that hold the truth."""
    rms_z: Finite | None = None
    """Of the error of ln EI over its standard deviation."""
    largest_z_good: Finite | None = None
    std: Finite | None = None
    """Median relative standard deviation of EI."""
    weak: int
    """Crossings with a weak element and an answer."""
    weak_found: int
    """Of these, those whose interval of the weak element lies below nine tenths of nominal."""
    evaluations: int
    """Of the model, all crossings together."""


class Certificate(_Fields):
    """Whether a method recovers what was put in, for one vehicle on one bridge."""

    program: str = "driveby"
    version: str
    created: Finite
    """Seconds since 1970 UTC."""
    hash: Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
    """Of all that it vouches for: `pair_hash`."""
    method_edition: int
    vehicle: str
    bridge: str
    settings: dict[str, JsonValue]
    seed: Annotated[int, Field(ge=0, lt=1 << 64)]
    conditions: Conditions
    planned: Annotated[int, Field(ge=1)]
    """So many crossings, unless fewer left no doubt."""
    crossings: tuple[Tried, ...]
    figures: Figures
    passed: bool
    reason: str
    """Why it passed or failed, in one sentence."""

    @property
    def pair(self) -> Pair:
        """Whom it is about."""
        return Pair(self.vehicle, self.bridge)


def pair_hash(site: Site, pair: Pair, settings: IdentificationSettings) -> str:
    """Return 16 hex digits that change when anything changes that a certificate vouches for.

    That is the pair's vehicle and bridge, sensor, receiver, the method and its settings. Neither
    the order of keys nor other vehicles and bridges of the site matter. KeyError if the site has
    no such pair.
    """
    content = {
        "method_edition": METHOD_EDITION,
        "settings": settings.model_dump(mode="json", exclude=set(_NOT_OF_A_CERTIFICATE)),
        "vehicle": site.vehicle(pair.vehicle).shortest(),
        "bridge": site.bridge(pair.bridge).model_dump(mode="json", exclude=set(_NOT_OF_A_BRIDGE)),
        "sensor": site.sensor.model_dump(mode="json"),
        "receiver": site.receiver.model_dump(mode="json"),
    }
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def certificate_path(folder: Path, digest: str) -> Path:
    """Where the certificate of a hash is, or would be."""
    return folder / f"{digest}.json"


def certificate_json(certificate: Certificate) -> str:
    """Return the text of a certificate's file."""
    return certificate.model_dump_json(indent=1) + "\n"


def load_certificate(path: Path) -> Certificate:
    """Read a certificate; InputError with one line if it is none or is not what its name says."""
    found = load_json(Certificate, path, "a certificate")
    if found.hash != path.stem:
        raise InputError(f"{path}: hash: is {found.hash}, it must be the name of its file")
    return found
