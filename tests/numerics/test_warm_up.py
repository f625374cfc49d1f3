"""Who has warmed up never waits for a compiler again."""

import json
import subprocess
import sys
from pathlib import Path

# In a process of its own: here other tests may have compiled what the warm-up forgets.
IDENTIFY = """
import gc, json, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from schemas.settings import IdentificationSettings
from services.execution.offline import identify_recordings, site_of
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
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["crossings"] == 1
    # What comes from the cache brings its caller's signature only, so there may be few.
    assert any(kernel.startswith("pre_core.crossing.") for kernel in said["warm"])
    assert said["new"] == []
