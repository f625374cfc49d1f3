"""Who has warmed up never waits for a compiler again."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.execution import warm_up

# In a process of its own: here other tests may have compiled what the warm-up forgets.
IDENTIFY = """
import gc, json, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from schemas.settings import IdentificationSettings
from services.execution.offline import site_of
from tests.identifications import identify_recordings
from services.execution.warm_up import warm_up

def compiled():
    kernels = [one for one in gc.get_objects() if isinstance(one, Dispatcher)]
    kernels = [one.py_func for one in kernels], [one.signatures for one in kernels]
    return {
        f"{function.__module__}.{function.__qualname__} {signature}"
        for function, signatures in zip(*kernels)
        for signature in signatures
        if function.__module__.startswith("pre_core.")
    }

warm_up()
before = compiled()
recording = Path(sys.argv[1])
settings = IdentificationSettings(draws=100, starts=1)
found = identify_recordings([recording], site_of([recording], None), settings).crossings
new = sorted(compiled() - before)
print(json.dumps({"warm": sorted(before), "new": new, "crossings": len(found)}))
"""


def test_an_identification_compiles_nothing_after_the_warm_up(project: Path) -> None:
    """No kernel gets a signature by the default method that `warm_up` has not given it."""
    done = subprocess.run(
        [sys.executable, "-c", IDENTIFY, str(project / "recordings/sample/crossing.mcap")],
        check=True,
        capture_output=True,
        text=True,
        cwd=project,
    )
    output = json.loads(done.stdout.splitlines()[-1])
    assert output["crossings"] == 1
    # What comes from the cache brings its caller's signature only, so there may be few.
    assert any(kernel.startswith("pre_core.crossing.") for kernel in output["warm"])
    assert output["new"] == []


SIMULATE = """
from services.simulation import two_sided, two_sided_deck, two_sided_march, two_sided_surface
from services.simulation.warm_up import warm_up
from services.simulation.wide_crossings import road_under

warm_up()
kernels = two_sided_march.march_exactly, two_sided_surface._heights
before = [one.signatures for one in kernels]
axles = [two_sided.WideAxle(at, 1e3, 1e6, 1e4, 2e6, friction_n=10.0) for at in (0.0, 4.0, 5.3)]
bogie = two_sided.WideBogie((1, 2), (0.5, 0.5))
truck = two_sided.WideTruck((two_sided.Body(1e4, 2.0, 2e4, 1e4),), tuple(axles), (bogie,))
twist = two_sided_deck.Torsion(8.0, 2.0)
deck = two_sided_deck.Deck(6.0, (1e9, 2e9), 1e3, 0.1, 1e-4, twist, (1e6, 0.0))
road = road_under(truck, two_sided_surface.draw_waves("B", 2), -9.0, 9.0, is_one_road=True)
motion = two_sided.even_motion(-1.0, 10.0, 0.1, 5e-4, change_m_per_s=0.1)
two_sided.cross(truck, deck, road, motion, lane_offset_m=1.0, settle_s=0.05)
assert all(before)
assert [one.signatures for one in kernels] == before
"""


def test_a_truck_with_a_bogie_compiles_nothing_after_the_warm_up(project: Path) -> None:
    subprocess.run([sys.executable, "-c", SIMULATE], check=True, cwd=project)


ROWS = """
import sys
from pre_core.crossing import posterior
from services.execution import warm_up

def counted(problem, y):
    rows = real(problem, y)
    sys.stdout.write(rows.tobytes().hex())
    raise SystemExit

real, posterior.all_rows = posterior.all_rows, counted
warm_up.warm_up()
"""


@pytest.mark.parametrize("is_compiled", [False, True])
def test_warm_up_announces_only_a_compilation(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *,
    is_compiled: bool,
) -> None:
    (tmp_path / "kernel.py").touch()
    if is_compiled:
        (tmp_path / "__pycache__").mkdir()
        (tmp_path / "__pycache__" / "kernel.nbi").touch()

    def compile_kernels() -> None:
        printed.append(capsys.readouterr().out)

    printed: list[str] = []
    monkeypatch.setattr(warm_up, "PACKAGE", tmp_path)
    monkeypatch.setattr(warm_up, "warm_up", compile_kernels)
    assert warm_up.main() == 0
    assert printed == ["" if is_compiled else "compiling kernels, about a minute, once\n"]
    assert capsys.readouterr().out.startswith("kernels compiled (")


@pytest.mark.slow
def test_compiled_and_loaded_kernels_give_the_same_digits(project: Path, tmp_path: Path) -> None:
    """The rows of method `pre`, bit for bit, with an empty cache and with what that has left."""
    first, second = (
        subprocess.run(
            [sys.executable, "-c", ROWS],
            check=True,
            capture_output=True,
            text=True,
            cwd=project,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        ).stdout
        for _ in range(2)
    )
    assert list(tmp_path.glob("**/*.nbc")), "nothing was compiled"
    assert len(first) > 1000
    assert first == second
