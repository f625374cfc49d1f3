"""driveby for researchers: read, identify, simulate, plot (docs/python.md).

    import driveby

    found = driveby.identify("recordings/sample/crossing.mcap")
    found.elements()

What is not here is the program's own and may change without notice; what is here changes with the
version only. Nothing is imported before it is used: `import driveby` takes milliseconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from driveby.plotting import plot as plot
    from schemas.signals import CHANNELS as CHANNELS
    from schemas.site import Site as Site
    from schemas.site_file import load_site as load_site
    from services.common.errors import FailureError as FailureError
    from services.common.errors import InputError as InputError
    from services.drives.signals import Signals as Signals
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
    "Identification",
    "InputError",
    "Signals",
    "Simulation",
    "Site",
    "Solution",
    "identify",
    "load_site",
    "plot",
    "read",
    "simulate",
]

_PLACES = {
    "CHANNELS": "schemas.signals",
    "FailureError": "services.common.errors",
    "Identification": "services.notebook.solution",
    "InputError": "services.common.errors",
    "Signals": "services.drives.signals",
    "Simulation": "services.notebook.simulate",
    "Site": "schemas.site",
    "Solution": "services.notebook.solution",
    "identify": "services.notebook.identify",
    "load_site": "schemas.site_file",
    "plot": "driveby.plotting",
    "read": "services.notebook.read",
    "simulate": "services.notebook.simulate",
}


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("driveby")
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_PLACES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
