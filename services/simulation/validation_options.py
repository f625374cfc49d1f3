"""Options of `driveby validate`: one class for each of its four kinds.

The names are those of the command's options. Certificates are made by the program itself, the
other three are studies of the checkout. Nothing heavy is imported here.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class CertificateOptions:
    """Certificates for the pairs of a site file."""

    site: Path
    truck: str | None
    """Identifier of the only vehicle; None: each."""
    bridge: str | None
    """Identifier of the only bridge; None: each."""
    validations: Path
    """Folder of the certificates."""
    seed: int
    processes: int


@dataclass(frozen=True, kw_only=True)
class ScenarioOptions:
    """The paper's scenarios by both of its searches."""

    scenarios: tuple[int, ...]
    noise: float
    """Noise density of the accelerometers in µg/√Hz."""
    seed: int
    site: Path | None
    """None: truck and bridge of the paper."""
    particles: int
    steps: int
    json: Path | None
    figures: Path | None
    """Folder for figures."""


@dataclass(frozen=True, kw_only=True)
class IntervalOptions:
    """The intervals of method `pre` against the truth of simulated crossings."""

    crossings: int
    """Number of crossings whose truth is drawn from the priors."""
    control: int
    """Number of crossings repeated with only half of their noise declared."""
    scenarios: tuple[int, ...]
    out_of_model: int
    """Number of crossings for each effect."""
    effects: tuple[str, ...]
    records: Path
    """File of finished crossings, which are not run again."""
    truth: Path
    """Folder of the crossings of an independent simulator."""
    site: Path | None
    processes: int
    json: Path | None
    figures: Path | None
    page: Path | None


@dataclass(frozen=True, kw_only=True)
class SurveyOptions:
    """Fused surveys of method `pre` against their truth."""

    surveys: int
    """Number of surveys of each kind."""
    kinds: tuple[str, ...]
    records: Path
    site: Path | None
    processes: int
