"""Identification of all crossings of recordings, CSV folders or a simulation."""

import warnings
from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from typing import Final, get_args

from schemas.results import Method
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.common.errors import InputError
from services.execution.inline import InlineExecutor
from services.execution.offline import identify_drives
from services.finding.order import Read, cached_reader, index_messages
from services.history.draws import Draws
from services.identification.methods import lacks_noise
from services.notebook.arguments import known_arguments, whole, wrong
from services.notebook.read import Name, given_site, messages_of_paths, paths_of, site_of_paths
from services.notebook.simulate import Simulation
from services.notebook.solution import Identification, Solution

_NO_NOISE: Final = (
    "the site declares sensors without noise, which method pre cannot use: simulate(..., noise=25) "
    'adds noise, and identify(..., method="least_squares") needs none'
)
_SOURCES: Final = "a recording (.mcap), a folder of CSV files, a list of these or a simulation"


@known_arguments()
def identify(
    source: Name | Sequence[Name] | Simulation,
    *,
    site: Name | Site | None = None,
    method: str = "pre",
    seed: int = 1,
    draws: bool = True,
    vehicle: str | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Identification:
    """Identify every crossing in recordings (.mcap), folders of CSV files or a simulation.

    `site` is needed where the source has none of its own (a recording carries it, a folder may hold
    site.toml). `method` is pre, least_squares or random_walk. `draws=False` drops the posterior
    draws: about 1 MB a crossing. `say` is called with progress messages. BLAS is limited to one
    thread meanwhile. The same source, site, method and seed give the same numbers as `driveby
    identify`. A site without sensor noise, as of a simulation by default, brings a warning with
    method pre.

    Raise InputError, in one line, for unreadable input; a crossing that cannot be identified is no
    error but has a verdict.
    """
    settings = _settings(method, seed)
    if isinstance(source, Simulation):
        known, name = source.site if site is None else given_site(site), "simulation"
        read: Read = source.messages
    else:
        paths = paths_of(_several(source))
        known, name = site_of_paths(paths, site), ", ".join(str(path) for path in paths)
        read = cached_reader(lambda again: messages_of_paths(paths, known, site, vehicle))
    if lacks_noise(known, settings.method):
        warnings.warn(_NO_NOISE, stacklevel=3)
    kept: dict[str, Draws] = {}

    def keep(crossing_id: str, chains: Draws) -> None:
        if draws:
            kept[crossing_id] = chains

    def report(crossing_id: str, stage: str, fraction: float) -> None:
        if fraction < 1.0:
            say(f"{crossing_id}: {stage}")

    execution = InlineExecutor(report=report, keep=keep)
    found = identify_drives(index_messages(name, read, known), known, settings, execution, report)
    solutions = (
        Solution(c, known.bridge(c.bridge), kept.get(c.crossing_id, {}), known)
        for c in found.crossings
    )
    return Identification(tuple(solutions), found, known)


def _several(source: object) -> list[Name]:
    """Return the names of one source or several; raise InputError for anything else."""
    if isinstance(source, str | PathLike):
        return [source]
    if not isinstance(source, Iterable) or hasattr(source, "_fields"):
        raise wrong("source", source, _SOURCES)
    several = list(source)
    if any(isinstance(one, Simulation) for one in several):
        raise InputError(
            "source is a list with a simulation, it must be one simulation; fuse(identify(a), "
            "identify(b)) fuses several, each started at another time: "
            'b = b.started_at("2026-05-01T09:30:00Z")'
        )
    return several


def _settings(method: str, seed: int) -> IdentificationSettings:
    name = method.replace("-", "_") if isinstance(method, str) else method
    if name not in get_args(Method):
        raise wrong("method", method, f"one of {', '.join(get_args(Method))}")
    known = whole("seed", seed, 0, (1 << 64) - 1)
    return IdentificationSettings.model_validate({"method": name, "seed": known})
