"""Compiles the numerical kernels ahead of time: `python -m services.precompile`.

numba keeps the compiled form beside the sources, for every later start of any command. It notices
that a kernel's own file has changed, but not that another kernel, which it has inlined, has: so
everything is compiled anew when any source is newer than what was compiled from it.

`make install` ends with this. An installation must not fail for want of a cache (a read-only
folder, a processor that the compiler does not know): the first command then compiles for itself.
"""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

PACKAGE = Path(__file__).parents[1] / "pre_core"


def main() -> int:
    """Compile what is not compiled yet and say so in one line; the exit code is always 0."""
    began = time.perf_counter()
    try:
        _forget_stale(PACKAGE)
        compile_kernels()
    except Exception as error:  # noqa: BLE001, RUF100 - see the module's docstring
        what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        sys.stdout.write(f"kernels not compiled, the first command will do it ({what})\n")
    else:
        sys.stdout.write(f"kernels compiled ({time.perf_counter() - began:.0f} s)\n")
    return 0


def compile_kernels() -> None:
    """Call every kernel that a command uses, in the way in which commands call it."""
    import numpy as np

    from pre_core import paper, parameters, random_walk
    from services.validation import paper_window
    from services.worker.warm_up import warm_up

    warm_up()
    sound = paper.beam(np.ones(paper.ELEMENTS))
    window = paper_window(paper.TRUCK, sound, 0.0, 0)  # simulates, and integrates as the paper does
    nominal = parameters.from_models(paper.TRUCK, sound)
    free = parameters.paper_subset(paper.ELEMENTS)
    walk = random_walk.problem(window, nominal, free, 0, threads=1)
    random_walk.step(walk, random_walk.init(walk, particles=1))
    _compile_pre(nominal)


def _compile_pre(nominal: "NDArray[np.float64]") -> None:
    """The kernels of method `pre`, on four seconds of noise at 10 m/s."""
    import numpy as np

    from pre_core import paper, posterior, pre
    from pre_core.vehicle import total_mass_kg

    step_s, count = 0.002, 2700
    time_s = step_s * np.arange(0, count, 50, dtype=np.float64)
    fixes = posterior.Fixes(
        time_s, paper.SPEED_M_PER_S * time_s - 10.0, np.full(time_s.size, 10.0), 0.4, 0.07, 1.5
    )
    inputs = pre.Inputs(
        np.random.default_rng(0).standard_normal((4, count)),
        0.0,
        step_s,
        1,
        paper.SPAN_M,
        np.full(paper.ELEMENTS, paper.SPAN_M / paper.ELEMENTS),
        total_mass_kg(paper.TRUCK),
        1.0,
        np.full(4, 1e-3),
        500.0,
        fixes,
        posterior.Priors(
            nominal, np.full(nominal.size, 0.1), paper.TRUCK.wheelbase_m, 0.002, 0.01, 0.01, 0.0005
        ),
        2,
        1,
    )
    problem, y = pre.prepare(inputs)
    posterior.all_rows(problem, y[None, :])
    posterior.roads(problem, y)


def _forget_stale(package: Path) -> None:
    newest = max(source.stat().st_mtime for source in package.glob("*.py"))
    compiled = [*package.glob("__pycache__/*.nbi"), *package.glob("__pycache__/*.nbc")]
    if any(file.stat().st_mtime < newest for file in compiled):
        for file in compiled:
            file.unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main())
