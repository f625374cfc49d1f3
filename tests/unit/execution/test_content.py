"""What a result is made from: the same in every process, another where anything is another."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from schemas.reasons import Reason
from services.execution import program
from services.execution.task_hash import task_hash
from services.identification.outputs import IdentificationTask
from tests.unit.execution.test_processes import works

PROGRAM = {"driveby": "0.1.0", "Python": "3.11.7"}
_ELSEWHERE = """
from services.execution.task_hash import task_hash
from tests.unit.execution.test_content import PROGRAM
from tests.unit.execution.test_processes import works
print(task_hash(works()[0], PROGRAM))
"""


@pytest.fixture(scope="module")
def work() -> IdentificationTask:
    return works()[0]


def test_another_process_finds_the_same(work: IdentificationTask, project: Path) -> None:
    found = {
        subprocess.run(
            [sys.executable, "-c", _ELSEWHERE],
            cwd=project,
            env=os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": "."},
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
        for seed in ("1", "2")
    }
    assert found == {task_hash(work, PROGRAM)}


def test_what_changes_no_result_changes_nothing(work: IdentificationTask) -> None:
    threads = work.settings.model_copy(update={"threads": 7})
    for same in (work._replace(number=99), work._replace(settings=threads)):
        assert task_hash(same, PROGRAM) == task_hash(work, PROGRAM)


def test_whatever_is_another_makes_another(work: IdentificationTask) -> None:
    data = work.data
    samples = data.samples
    assert samples is not None
    name, values = next(iter(samples.channels.items()))
    moved = values.copy()
    moved[-1] = np.nextafter(moved[-1], np.inf)
    changed = [
        work._replace(settings=work.settings.model_copy(update={"seed": 2})),
        work._replace(certificate="0" * 8),
        work._replace(data=data._replace(crossing_id="another")),
        work._replace(data=data._replace(wall_offset_s=data.wall_offset_s + 1e-6)),
        work._replace(data=data._replace(against=(Reason.OTHER_TRUCK_ON_BRIDGE,))),
        work._replace(data=data._replace(stay=data.stay._replace(direction=-data.stay.direction))),
        work._replace(
            data=data._replace(vehicle=data.vehicle.model_copy(update={"id": "truck-9"}))
        ),
        work._replace(
            data=data._replace(samples=samples._replace(channels=samples.channels | {name: moved}))
        ),
    ]
    contents = {task_hash(one, PROGRAM) for one in (work, *changed)}
    contents.add(task_hash(work, PROGRAM | {"Python": "3.12.1"}))
    assert len(contents) == len(changed) + 2


def test_what_is_not_known_is_refused(work: IdentificationTask) -> None:
    with pytest.raises(TypeError, match="a set has no content"):
        task_hash(work._replace(certificate={1, 2}), PROGRAM)  # type: ignore[arg-type]


_DECIDING = """
import sys
import services.identification.identify, services.finding.finder
print(*sorted({name.split(".")[1] for name in sys.modules if name.startswith("services.")}))
"""


def test_the_sources_that_decide_about_a_result_are_of_its_program(project: Path) -> None:
    """All rooms that finder and identification stand on, but for what is common to everything."""
    done = subprocess.run(
        [sys.executable, "-c", _DECIDING], cwd=project, check=True, capture_output=True, text=True
    )
    counted = {Path(str(module.__file__)).parent.name for module in program._DECIDING}
    assert set(done.stdout.split()) - {"common"} <= counted
    assert {"pre_core", "schemas"} <= counted
