"""driveby for researchers: read, identify, fuse, simulate, survey, plot (docs/python.md).

    import driveby

    found = driveby.identify("recordings/sample/crossing.mcap")
    found.elements()

What is not here is the program's own and may change without notice; what is here changes with the
version only. Nothing is imported before it is used: `import driveby` takes milliseconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from services.common.extras import check_extras

if TYPE_CHECKING:
    from driveby.diagnostic_plots import plot_chains as plot_chains
    from driveby.diagnostic_plots import plot_posterior as plot_posterior
    from driveby.diagnostic_plots import plot_residual as plot_residual
    from driveby.plotting import plot as plot
    from driveby.reports import report as report
    from driveby.simulations import simulate_recording as simulate_recording
    from driveby.surveys import SurveyPlan as SurveyPlan
    from driveby.surveys import survey as survey
    from schemas.signals import CHANNELS as CHANNELS
    from schemas.site import Site as Site
    from schemas.site_file import load_site as load_site
    from schemas.site_file import site_toml as site_toml
    from schemas.site_file import with_values as with_values
    from services.common.errors import FailureError as FailureError
    from services.common.errors import InputError as InputError
    from services.drives.signals import Signals as Signals
    from services.notebook.fuse import Fusion as Fusion
    from services.notebook.fuse import fuse as fuse
    from services.notebook.identify import identify as identify
    from services.notebook.read import read as read
    from services.notebook.simulate import Simulation as Simulation
    from services.notebook.simulate import simulate as simulate
    from services.notebook.solution import Identification as Identification
    from services.notebook.solution import Solution as Solution

__version__: str

__all__ = [
    "CHANNELS",
    "FailureError",
    "Fusion",
    "Identification",
    "InputError",
    "Signals",
    "Simulation",
    "Site",
    "Solution",
    "SurveyPlan",
    "fuse",
    "identify",
    "load_site",
    "plot",
    "plot_chains",
    "plot_posterior",
    "plot_residual",
    "read",
    "report",
    "simulate",
    "simulate_recording",
    "site_toml",
    "survey",
    "with_values",
]

_PLACES = {
    "CHANNELS": "schemas.signals",
    "FailureError": "services.common.errors",
    "Fusion": "services.notebook.fuse",
    "Identification": "services.notebook.solution",
    "InputError": "services.common.errors",
    "Signals": "services.drives.signals",
    "Simulation": "services.notebook.simulate",
    "Site": "schemas.site",
    "Solution": "services.notebook.solution",
    "SurveyPlan": "driveby.surveys",
    "fuse": "services.notebook.fuse",
    "identify": "services.notebook.identify",
    "load_site": "schemas.site_file",
    "plot": "driveby.plotting",
    "plot_chains": "driveby.diagnostic_plots",
    "plot_posterior": "driveby.diagnostic_plots",
    "plot_residual": "driveby.diagnostic_plots",
    "read": "services.notebook.read",
    "report": "driveby.reports",
    "simulate": "services.notebook.simulate",
    "simulate_recording": "driveby.simulations",
    "site_toml": "schemas.site_file",
    "survey": "driveby.surveys",
    "with_values": "schemas.site_file",
}


_NEEDS = {
    "Fusion": ("identify",),
    "Simulation": ("identify",),
    "SurveyPlan": ("identify",),
    "fuse": ("identify",),
    "identify": ("identify",),
    "plot": ("identify", "view"),
    "plot_chains": ("identify", "view"),
    "plot_posterior": ("identify", "view"),
    "plot_residual": ("identify", "view"),
    "report": ("identify", "view"),
    "simulate": ("identify",),
    "simulate_recording": ("identify",),
    "survey": ("identify",),
}
"""Extras, by the names that need them."""


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("driveby")
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    check_extras(f"driveby.{name}", _NEEDS.get(name, ()))
    value = getattr(import_module(_PLACES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
