"""The forward and the inverse problem: arrays and NamedTuples in, arrays and NamedTuples out.

Nothing here opens a file or a socket, reads a clock or prints, and nothing but numpy, numba and
scipy is imported. Units are SI throughout; `x` is the chainage of `docs/contract.md`.
"""

import sys
from importlib.util import LazyLoader, find_spec, module_from_spec

import numpy as np


def _put_off(*names: str) -> None:
    """Import parts of NumPy at their first use."""
    for name in names:
        spec = None if name in sys.modules else find_spec(name)
        if spec is None or spec.loader is None:
            continue
        spec.loader = LazyLoader(spec.loader)
        module = module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        setattr(np, name.rpartition(".")[2], module)


# SciPy accesses all names of NumPy, and so would import these modules, which nothing here uses: a
# twentieth of the start-up time, and 9 MB.
_put_off("numpy.f2py", "numpy.testing", "numpy.ctypeslib")
