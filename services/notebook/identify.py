"""Identification of all crossings of recordings, CSV folders or a simulation."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import get_args

from schemas.results import Method
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.common.errors import InputError
from services.execution.inline import InlineExecutor
from services.execution.offline import identify_drives
from services.finding.order import Read, cached_reader, index_messages
from services.history.draws import Draws
from services.notebook.read import Name, given_site, messages_of_paths, paths_of, site_of_paths
from services.notebook.simulate import Simulation
from services.notebook.solution import Identification, Solution


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
    identify`.

    Raise InputError, in one line, for unreadable input; a crossing that cannot be identified is no
    error but has a verdict.
    """
    settings = _settings(method, seed)
    if isinstance(source, Simulation):
        known, name = source.site if site is None else given_site(site), "simulation"
        read: Read = source.messages
    else:
        paths = paths_of([source] if isinstance(source, str | PathLike) else list(source))
        known, name = site_of_paths(paths, site), ", ".join(str(path) for path in paths)
        read = cached_reader(lambda again: messages_of_paths(paths, known, site, vehicle))
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
        Solution(c, known.bridge(c.bridge), kept.get(c.crossing_id, {})) for c in found.crossings
    )
    return Identification(tuple(solutions), found, known)


def _settings(method: str, seed: int) -> IdentificationSettings:
    name = method.replace("-", "_")
    if name not in get_args(Method):
        raise InputError(f'method is "{method}", one of {", ".join(get_args(Method))} expected')
    if not 0 <= seed < 1 << 64:
        raise InputError(f"seed is {seed}, it must be a whole number from 0 on")
    return IdentificationSettings.model_validate({"method": name, "seed": seed})
