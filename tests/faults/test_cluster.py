"""A Dask cluster of real processes: the results of one process, whoever of them is killed."""

import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from distributed import Client

from services.cli import main as cli
from services.common.errors import FailureError
from services.execution.result_store import kept_results
from services.execution.scheduler import Credentials, connect, threads_of
from services.security.certs import certs_command
from services.security.settings import CertsSettings
from tests.drives import drives
from tests.faults.clusters import (
    Running,
    RunningCluster,
    cluster,
    computing,
    contents,
    of,
    other_worker,
    results_of,
    start,
)
from tests.waiting import until

pytestmark = pytest.mark.process

CROSSINGS = 12
HELD = "20260101T010003"
"""When the first crossing begins that workers can be made to hold, as all later ones."""
_HOLDING = """
import time
from pathlib import Path

from services.execution import cluster_worker


def holding(batch):
    works = of_others(batch)
    while Path(FILE).exists() and any(w.crossing_id.split(".")[2] >= HELD for w in works):
        time.sleep(0.02)
    return works


if cluster_worker.unpacked.__name__ != "holding":  # Dask runs this twice
    of_others = cluster_worker.unpacked
    cluster_worker.unpacked = holding
"""
_SOON_HUNG = """
from services.execution.processes import ProcessExecutor
from services.execution.hang_watchdog import TaskLimits

cluster_worker.new_pool = lambda: ProcessExecutor(1, limits=TaskLimits(idle_s=5.0))
"""
_OTHER_VERSION = """
from services.execution import cluster_worker, program

of_this = program.program()


def of_another() -> dict[str, str]:
    return of_this | {"driveby": "0.0.9 (code 0123456789)"}


cluster_worker.program = of_another
"""
_DEADLY = """
import os
import signal

from services.execution import cluster_worker


def deadly(batch):
    works = of_others(batch)
    if any(NAME in work.crossing_id for work in works):
        os.kill(os.getpid(), signal.SIGKILL)
    return works


if cluster_worker.unpacked.__name__ != "deadly":  # Dask runs this twice
    of_others = cluster_worker.unpacked
    cluster_worker.unpacked = deadly
"""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return drives(tmp_path_factory.mktemp("drives"), CROSSINGS, each=4)


@pytest.fixture(scope="module")
def of_one_process(
    recordings: list[Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("one") / "one.json"
    assert cli.main(of(recordings, "--json", str(path))) == 0
    return results_of(path)


class Held(NamedTuple):
    """A cluster whose workers hold a batch while there is a file."""

    cluster: RunningCluster
    file: Path


@contextmanager
def holding(folder: Path, more: str = "", **env: str) -> Iterator[Held]:
    """`more` is run on every worker."""
    file, preload = folder / "hold", folder / "holding.py"
    text = _HOLDING.replace("FILE", repr(str(file))).replace("HELD", repr(HELD))
    preload.write_text(text + more)
    preloaded = {"DASK_DISTRIBUTED__WORKER__PRELOAD": f"['{preload}']"}
    with cluster(folder, env=preloaded | env) as running:
        yield Held(running, file)


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Held]:
    with holding(tmp_path_factory.mktemp("cluster")) as one:
        yield one


@pytest.fixture
def two(held: Held) -> RunningCluster:
    held.file.unlink(missing_ok=True)
    return held.cluster


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    """Start a command; what has not ended is killed with the test."""
    started: list[Running] = []

    def one(*arguments: str, **env: str) -> Running:
        started.append(start(tmp_path / f"{len(started)}.log", *arguments, env=env))
        return started[-1]

    yield one
    for running in started:
        if running.process.poll() is None:
            running.process.kill()
        running.wait()


def in_the_middle(running: Running, into: Path) -> None:
    """Wait until some crossings are kept; others are held."""
    until(lambda: contents(into) or running.process.poll() is not None)
    assert running.process.poll() is None, running.output()
    assert 0 < len(contents(into)) < CROSSINGS


def on(two: RunningCluster, into: Path, *options: str) -> list[str]:
    return ["--scheduler", two.address, "--into", str(into), "--batch", "3", *options]


def test_a_drive_gives_what_it_gives_in_one_process(
    two: RunningCluster, recordings: list[Path], tmp_path: Path
) -> None:
    found = []
    for number, options in enumerate(
        ([], ["--scheduler", two.address], ["--scheduler", "processes:2"])
    ):
        path = tmp_path / f"{number}.json"
        assert cli.main(of(recordings[:1], *options, "--json", str(path))) == 0
        found.append(results_of(path))
    assert len(found[0]["crossings"]) == 4
    assert found[0]["bridges"] != {}
    assert found[1:] == found[:1] * 2


@pytest.mark.parametrize(
    ("whom", "by", "cause"),
    [
        ("worker 1", signal.SIGKILL, "exit code -9"),
        ("scheduler", signal.SIGKILL, "exit code -9"),
        pytest.param(
            *("scheduler", signal.SIGTERM, "exit code 0: SIGTERM from outside"),
            marks=pytest.mark.faults,
        ),
    ],
)
def test_killed_process_loses_no_result(
    two: RunningCluster,
    held: Held,
    begin: Callable[..., Running],
    recordings: list[Path],
    tmp_path: Path,
    of_one_process: dict[str, Any],
    whom: str,
    by: int,
    cause: str,
) -> None:
    into, path = tmp_path / "into", tmp_path / "found.json"
    held.file.touch()
    running = begin(*of(recordings, *on(two, into, "--json", str(path))))
    in_the_middle(running, into)
    before = two.pids(whom)
    os.kill(before[-1], by)
    until(lambda: len(two.pids(whom)) > len(before))
    assert f"the {whom} ended ({cause}); restarting it" in two.command.output()
    held.file.unlink()
    assert running.wait() == 0, running.output()
    assert results_of(path) == of_one_process
    assert len(contents(into)) == len(set(contents(into))) == CROSSINGS
    is_reported = "scheduler tcp://" in running.output()
    assert is_reported == (whom == "scheduler"), running.output()


@pytest.mark.faults
def test_idle_scheduler_lives_on_whatever_dask_is_configured_to(
    tmp_path: Path, begin: Callable[..., Running], recordings: list[Path]
) -> None:
    """Time-outs of Dask's configuration, and a client that shuts its cluster down."""
    env = {
        "DASK_DISTRIBUTED__SCHEDULER__IDLE_TIMEOUT": "500ms",
        "DASK_DISTRIBUTED__SCHEDULER__NO_WORKERS_TIMEOUT": "500ms",
        "DASK_DISTRIBUTED__WORKER__LIFETIME__DURATION": "500ms",
    }
    with cluster(tmp_path, env=env) as two:
        with Client(two.address, set_as_default=False) as client:
            with pytest.raises(PermissionError, match="ends with that command only"):
                client.sync(client.scheduler.terminate)  # as Client.shutdown does
            until(lambda: client.run_on_scheduler(idle_s) > 2.0)
        running = begin(*of(recordings[:1], *on(two, tmp_path / "into")))
        assert running.wait() == 0, running.output()
        assert " lost; waiting" not in running.output()
        assert "ended (" not in two.command.output()
        assert len(two.pids("scheduler")) == 1


def idle_s(dask_scheduler: Any) -> float:
    """For how long a scheduler has had nothing to do; run in its process."""
    import time

    since: float | None = dask_scheduler.idle_since
    return 0.0 if since is None else time.time() - since


def test_a_client_that_is_killed_goes_on(
    two: RunningCluster,
    held: Held,
    begin: Callable[..., Running],
    recordings: list[Path],
    tmp_path: Path,
    of_one_process: dict[str, Any],
) -> None:
    into, path = tmp_path / "into", tmp_path / "found.json"
    held.file.touch()
    first = begin(*of(recordings, *on(two, into)))
    in_the_middle(first, into)
    first.process.kill()
    assert first.wait() == -signal.SIGKILL
    there = len(contents(into))
    assert 0 < there < CROSSINGS
    second = begin(*of(recordings, *on(two, into, "--json", str(path))))
    held.file.unlink()
    assert second.wait() == 0, second.output()
    assert f"{CROSSINGS} crossings, {there} from earlier runs" in second.output()
    assert results_of(path) == of_one_process
    assert len(contents(into)) == len(set(contents(into))) == CROSSINGS


@pytest.mark.faults
def test_two_clients_with_one_folder_do_each_other_no_harm(
    two: RunningCluster,
    held: Held,
    begin: Callable[..., Running],
    recordings: list[Path],
    tmp_path: Path,
    of_one_process: dict[str, Any],
) -> None:
    """They ask for the same batches at the same time, and the first to end leaves the other one."""
    into = tmp_path / "into"
    held.file.touch()
    paths = [tmp_path / f"found-{n}.json" for n in range(2)]
    both = [begin(*of(recordings, *on(two, into, "--json", str(path)))) for path in paths]
    for running in both:
        in_the_middle(running, into)
    held.file.unlink()
    assert [running.wait() for running in both] == [0, 0], [one.output() for one in both]
    assert [results_of(path) for path in paths] == [of_one_process] * 2
    assert len(set(contents(into))) == CROSSINGS
    problems: list[str] = []
    found = [one for file in kept_results(into, problems.append) for one in file.crossings]
    assert (len(found), problems) == (CROSSINGS, [])


def test_a_worker_of_another_version_is_refused_by_name(
    two: RunningCluster, recordings: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preload = tmp_path / "other_version.py"
    preload.write_text(_OTHER_VERSION)
    into = tmp_path / "into"
    with other_worker(two.address, tmp_path, preload) as address:
        assert cli.main(of(recordings, *on(two, into))) == 1
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert f"worker {address}: has driveby 0.0.9 (code 0123456789); here is driveby " in line
    assert contents(into) == []


@pytest.mark.faults
def test_a_worker_of_another_version_that_comes_later_is_sent_away(
    two: RunningCluster,
    held: Held,
    begin: Callable[..., Running],
    recordings: list[Path],
    tmp_path: Path,
    of_one_process: dict[str, Any],
) -> None:
    """While the workers that were there hold a batch each, it gets another one."""
    preload = tmp_path / "other_version.py"
    preload.write_text(_OTHER_VERSION)
    into, path = tmp_path / "into", tmp_path / "found.json"
    held.file.touch()
    running = begin(*of(recordings, *on(two, into, "--json", str(path))), "--batch", "1")
    in_the_middle(running, into)
    with other_worker(two.address, tmp_path, preload) as address:
        refused = f"worker {address}: has driveby 0.0.9"
        until(lambda: refused in running.output() or running.process.poll() is not None)
        held.file.unlink()
        assert running.wait() == 0, running.output()
    assert refused in running.output()
    assert "retiring it" in running.output()
    assert results_of(path) == of_one_process


@pytest.mark.faults
def test_tls_admits_only_certificates_of_the_cluster(
    credentials: Path, recordings: list[Path], tmp_path: Path
) -> None:
    certs = tmp_path / "certs"
    certs_command(CertsSettings(folder=certs, cluster=True))
    with cluster(tmp_path, "--tls", str(certs), scheme="tls") as running:
        into = tmp_path / "into"
        options = on(running, into, "--tls", str(certs / "client"))
        assert cli.main(of(recordings[:1], *options)) == 0
        assert len(contents(into)) == 4
        truck = credentials / "truck-1"
        for files in (
            Credentials(truck / "ca.pem", truck / "cert.pem", truck / "key.pem"),
            Credentials(certs / "client" / "ca.pem", truck / "cert.pem", truck / "key.pem"),
            None,
        ):
            address = running.address if files else running.address.replace("tls", "tcp")
            with pytest.raises(FailureError, match="no scheduler answers"):
                connect(address, files, 2.0)


@pytest.mark.faults
def test_a_crossing_that_ends_every_worker_costs_itself_only(
    begin: Callable[..., Running],
    recordings: list[Path],
    tmp_path: Path,
    of_one_process: dict[str, Any],
) -> None:
    preload = tmp_path / "deadly.py"
    preload.write_text(_DEADLY.replace("NAME", repr("T002003")))
    into, path = tmp_path / "into", tmp_path / "found.json"
    with cluster(tmp_path, env={"DASK_DISTRIBUTED__WORKER__PRELOAD": f"['{preload}']"}) as running:
        options = on(running, into, "--json", str(path))
        first = begin(*of(recordings[:2], *options))
        assert first.wait() == 3, first.output()
    (name,) = re.findall(r"(\S+): identification failed", first.output())
    assert "T002003" in name
    found = results_of(path)["crossings"]
    failed = [one for one in found if one["reasons"] == ["failed"]]
    assert [one["crossing_id"] for one in failed] == [name]
    others = [one for one in of_one_process["crossings"][:8] if one["crossing_id"] != name]
    assert [one for one in found if one not in failed] == others
    assert len(contents(into)) == len(set(contents(into))) == 7


@pytest.fixture
def checked(
    begin: Callable[..., Running],
    recordings: list[Path],
    tmp_path: Path,
    of_one_process: dict[str, Any],
) -> Callable[..., str]:
    """Identify on a cluster, let something be done to that in the middle, compare the results."""

    def one(held: Held, do: Callable[[Running], object], **env: str) -> str:
        into, path = tmp_path / "into", tmp_path / "found.json"
        held.file.touch()
        running = begin(*of(recordings, *on(held.cluster, into, "--json", str(path))), **env)
        in_the_middle(running, into)
        do(running)
        held.file.unlink(missing_ok=True)
        assert running.wait() == 0, running.output()
        assert results_of(path) == of_one_process
        assert len(contents(into)) == len(set(contents(into))) == CROSSINGS
        return running.output()

    return one


@pytest.mark.faults
@pytest.mark.parametrize("whom", ["worker 1", "scheduler"])
def test_permanently_frozen_process_is_ended_without_loss(
    checked: Callable[..., str], tmp_path: Path, whom: str
) -> None:
    with holding(tmp_path, DRIVEBY_TEST_FROZEN_S="5") as one:

        def freeze(_: Running) -> None:
            before = one.cluster.pids(whom)
            os.kill(before[-1], signal.SIGSTOP)
            until(lambda: len(one.cluster.pids(whom)) > len(before))
            assert f"the {whom} has done nothing for 5 s; ending it" in one.cluster.command.output()

        output = checked(one, freeze, DRIVEBY_TEST_CALL_S="2")
    assert ("scheduler tcp://" in output) == (whom == "scheduler"), output


@pytest.mark.faults
def test_a_worker_that_is_frozen_and_goes_on_leaves_what_was_its_own_to_others(
    checked: Callable[..., str], tmp_path: Path
) -> None:
    """The scheduler takes it to be gone after a while; then it comes back, and is started anew."""
    with holding(tmp_path, DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL="5s") as one:

        def freeze(_: Running) -> None:
            before = one.cluster.pids("worker 1")
            os.kill(before[-1], signal.SIGSTOP)
            until(lambda: threads_of(one.cluster.address, None) == 1)
            os.kill(before[-1], signal.SIGCONT)
            one.file.unlink()  # it ends when its batch has
            until(lambda: len(one.cluster.pids("worker 1")) > len(before))

        output = checked(one, freeze)
    assert "scheduler tcp://" not in output, output


@pytest.mark.faults
def test_client_retries_while_a_worker_is_frozen(
    begin: Callable[..., Running],
    recordings: list[Path],
    tmp_path: Path,
    of_one_process: dict[str, Any],
) -> None:
    """All workers are asked what they are, until all answer, or the scheduler gives one up."""
    into, path = tmp_path / "into", tmp_path / "found.json"
    with holding(tmp_path, DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL="600s") as one:
        (worker,) = one.cluster.pids("worker 1")
        os.kill(worker, signal.SIGSTOP)
        options = on(one.cluster, into, "--json", str(path))
        running = begin(*of(recordings, *options), DRIVEBY_TEST_CALL_S="2")
        published = "could not ask for its workers' versions"
        until(lambda: published in running.output() or running.process.poll() is not None)
        os.kill(worker, signal.SIGCONT)
        assert running.wait() == 0, running.output()
    assert published in running.output()
    assert results_of(path) == of_one_process


@pytest.mark.faults
@pytest.mark.parametrize("ttl", ["60s", "5s"])
def test_a_scheduler_that_is_frozen_and_goes_on_costs_nothing(
    checked: Callable[..., str], tmp_path: Path, ttl: str
) -> None:
    """By the shorter time it takes all its workers to be gone when it goes on."""
    with holding(tmp_path, DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL=ttl) as one:

        def freeze(running: Running) -> None:
            (scheduler,) = one.cluster.pids("scheduler")
            os.kill(scheduler, signal.SIGSTOP)
            until(lambda: "scheduler tcp://" in running.output())
            os.kill(scheduler, signal.SIGCONT)

        checked(one, freeze, DRIVEBY_TEST_CALL_S="6")


@pytest.mark.faults
def test_a_scheduler_that_is_frozen_for_ever_and_nobody_ends_is_a_line(
    begin: Callable[..., Running],
    recordings: list[Path],
    tmp_path: Path,
    of_one_process: dict[str, Any],
) -> None:
    into, path = tmp_path / "into", tmp_path / "found.json"
    with holding(tmp_path) as one:
        one.file.touch()
        options = on(one.cluster, into, "--json", str(path))
        first = begin(*of(recordings, *options, "--patience", "1"), DRIVEBY_TEST_CALL_S="2")
        in_the_middle(first, into)
        (scheduler,) = one.cluster.pids("scheduler")
        os.kill(scheduler, signal.SIGSTOP)
        assert first.wait() == 1, first.output()
        assert re.search(
            r"^driveby: .*: no scheduler answers \(.*\); start one", first.output(), re.M
        )
        assert "Traceback" not in first.output()
        assert 0 < len(contents(into)) < CROSSINGS
        os.kill(scheduler, signal.SIGCONT)
        one.file.unlink()
        second = begin(*of(recordings, *options))
        assert second.wait() == 0, second.output()
    assert results_of(path) == of_one_process
    assert len(contents(into)) == len(set(contents(into))) == CROSSINGS


@pytest.mark.faults
def test_frozen_processes_below_workers_are_ended_and_cost_nothing(
    checked: Callable[..., str], tmp_path: Path
) -> None:
    with holding(tmp_path, _SOON_HUNG) as one:
        frozen: list[int] = []

        def freeze(_: Running) -> None:
            for name in ("worker 1", "worker 2"):
                frozen.extend(computing(one.cluster.pids(name)[-1]))
            for pid in frozen:
                os.kill(pid, signal.SIGSTOP)

        output = checked(one, freeze)
        assert frozen != []
        assert not [pid for pid in frozen if Path(f"/proc/{pid}").exists()]
    assert "scheduler tcp://" not in output, output
