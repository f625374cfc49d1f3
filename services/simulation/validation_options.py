"""Options of `driveby validate`: one class for each of its four kinds.

The names are those of the command's options. The program itself makes site validations; the other
three kinds are studies in the checkout. Nothing heavy is imported here.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class SiteValidationOptions:
    """Options of the site validation of every pair in a site file."""

    site: Path
    truck: str | None
    """Identifier of the only vehicle; None: each."""
    bridge: str | None
    """Identifier of the only bridge; None: each."""
    validations: Path
    """Folder of the validation records."""
    seed: int
    processes: int


@dataclass(frozen=True, kw_only=True)
class ScenarioOptions:
    """Options of the paper's scenarios, identified by random walk and least squares."""

    scenarios: tuple[int, ...]
    noise: float
    """Noise density of the accelerometers in µg/√Hz."""
    seed: int
    site: Path | None
    """Site file; None: truck and bridge of the paper."""
    particles: int
    steps: int
    json: Path | None
    figures: Path | None
    """Folder for figures."""


@dataclass(frozen=True, kw_only=True)
class IntervalOptions:
    """Options of the comparison of intervals with the truth of simulated crossings."""

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
    """Options of the comparison of fused surveys with their truth."""

    surveys: int
    """Number of surveys of each kind."""
    kinds: tuple[str, ...]
    records: Path
    site: Path | None
    processes: int
