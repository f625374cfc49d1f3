"""A fleet of real processes that can be killed and frozen, and what they must have left on disk."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from schemas.topics import Message
from services.common.errors import InputError
from services.recordings.recording import is_closed, read_info, read_messages
from tests import prepared
from tests.endpoints import free_endpoint
from tests.parent import parent_environment
from tests.waiting import LONGEST_S

HERE = Path(__file__).parent
Numbers = dict[tuple[str, str, int], set[int]]


class Truck:
    """A process that drives, and what it said it has handed over."""

    def __init__(
        self, fleet: "Fleet", vehicle: str, rate: float, endpoint: str, env: dict[str, str]
    ) -> None:
        self._fleet = fleet
        self.vehicle = vehicle
        self.output: dict[int, int] = {}
        """By boot_id the last sequence of accel."""
        self.last_line = ""
        self.is_driving = True
        """Whether it has neither been killed nor stopped."""
        spool = fleet.folder / "spool" / vehicle
        self.process = fleet.python(
            "truck_process.py",
            endpoint,
            "live",
            vehicle,
            str(spool),
            str(rate),
            env=env,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.last_line = line.strip()
            boot_id, _, sequence = self.last_line.partition(" ")
            if boot_id.isdigit() and line.endswith("\n"):
                self.output[int(boot_id)] = int(sequence)

    def wait_for(self, batches: int, timeout_s: float = LONGEST_S) -> None:
        deadline = time.monotonic() + timeout_s
        while max(self.output.values(), default=0) < batches:
            assert time.monotonic() < deadline, f"{self.vehicle}: only {self.output}"
            time.sleep(0.02)

    def kill(self) -> None:
        self.is_driving = False
        self.process.kill()
        self.process.wait()
        self._reader.join()

    def stop(self) -> None:
        """End the drive; the truck leaves when a logger has everything."""
        self.is_driving = False
        self.process.send_signal(signal.SIGTERM)

    def wait(self, timeout_s: float = LONGEST_S) -> None:
        """Wait until it has left, which it must do with nothing missing."""
        assert self.process.wait(timeout=timeout_s) == 0
        self._reader.join()
        assert self.last_line.startswith("missing 0 "), (
            f"{self.vehicle}: {self.last_line}\n{self._fleet.logs()}"
        )


def messages_of(path: Path) -> Iterator[Message]:
    """All messages of a readable file; none if its logger was killed before its first second."""
    try:
        yield from read_messages(path)
    except InputError:
        if read_info(path).messages or is_closed(path):
            raise


class Fleet:
    """Trucks, perhaps a router, and a logger, in one folder."""

    def __init__(self, folder: Path, *, router: bool = False) -> None:
        self.folder = folder
        self.logger_endpoint = free_endpoint()
        self.truck_endpoint = free_endpoint() if router else self.logger_endpoint
        self.logger: subprocess.Popen[str] | None = None
        self.router: subprocess.Popen[str] | None = None
        self.trucks: list[Truck] = []
        self._processes: list[subprocess.Popen[str]] = []

    def python(self, script: str, *arguments: str, env: dict[str, str]) -> subprocess.Popen[str]:
        log = (self.folder / f"{Path(script).stem}-{len(self._processes)}.log").open("w")
        process = prepared.Popen(
            [sys.executable, str(HERE / script), *arguments],
            stdout=subprocess.PIPE,
            stderr=log,
            env=os.environ | {"PYTHONPATH": str(HERE.parents[1])} | parent_environment() | env,
        )
        log.close()
        self._processes.append(process)
        return process

    def start_logger(self, **env: str) -> None:
        self.logger = self.python(
            "logger_process.py", self.logger_endpoint, str(self.folder / "recordings"), env=env
        )
        assert self.logger.stdout is not None
        assert self.logger.stdout.readline() == "ready\n", self.logs()

    def start_router(self) -> None:
        self.router = self.python(
            "router_process.py", self.truck_endpoint, self.logger_endpoint, env={}
        )
        assert self.router.stdout is not None
        assert self.router.stdout.readline() == "ready\n", self.logs()

    def start_truck(
        self,
        vehicle: str = "truck-1",
        rate: float = 20.0,
        endpoint: str | None = None,
        **env: str,
    ) -> Truck:
        truck = Truck(self, vehicle, rate, endpoint or self.truck_endpoint, env)
        self.trucks.append(truck)
        return truck

    def kill(self, process: subprocess.Popen[str] | None) -> None:
        assert process is not None
        process.kill()
        process.wait()

    def stop_logger(self) -> None:
        assert self.logger is not None
        self.logger.send_signal(signal.SIGTERM)
        assert self.logger.wait(timeout=LONGEST_S) == 0, self.logs()

    def logger_output(self) -> str:
        return "".join(
            path.read_text() for path in sorted(self.folder.glob("logger_process-*.log"))
        )

    def logs(self) -> str:
        return "\n".join(path.read_text()[-3000:] for path in sorted(self.folder.glob("*.log")))

    def recorded(self) -> tuple[Numbers, int]:
        """Return the sequences on disk, and how many stand in more than one file.

        No file may hold a message twice.
        """
        union: Numbers = {}
        twice = 0
        for path in sorted((self.folder / "recordings").glob("*/*/*.mcap")):
            own: Counter[tuple[str, str, int, int]] = Counter()
            for message in messages_of(path):
                if message.key.owner != "vehicle":
                    continue
                name = (message.key.identifier, message.key.stream, message.boot_id)
                own[(*name, message.sequence)] += 1
                numbers = union.setdefault(name, set())
                # Of a latched topic every file has a copy.
                twice += message.sequence in numbers and message.key.stream != "info"
                numbers.add(message.sequence)
            repeated = [name for name, number in own.items() if number > 1]
            assert not repeated, f"{path}: {repeated[:5]}"
        return union, twice

    def finish(self) -> int:
        """End all drives and then the logger; return as `assert_complete` does."""
        driving = [truck for truck in self.trucks if truck.is_driving]
        for truck in driving:
            truck.stop()
        for truck in driving:
            truck.wait()
        self.stop_logger()
        return self.assert_complete()

    def assert_complete(self) -> int:
        """Everything that any truck handed over is there; return how often in two files."""
        union, twice = self.recorded()
        for truck in self.trucks:
            for boot_id, last in truck.output.items():
                for stream, highest in (("accel", last), ("gnss", last // 2), ("info", 0)):
                    found = union.get((truck.vehicle, stream, boot_id), set())
                    missing = set(range(highest + 1)) - found
                    assert not missing, (
                        f"{truck.vehicle} {stream} {boot_id}: {len(missing)} of {highest + 1} "
                        f"missing, {sorted(missing)[:5]}\n{self.logs()}"
                    )
        for name, numbers in union.items():
            assert numbers == set(range(len(numbers))), f"{name}: a hole"
        return twice

    def close(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Callable[..., Fleet]]:
    fleets: list[Fleet] = []

    def make(**arguments: Any) -> Fleet:
        fleets.append(Fleet(tmp_path, **arguments))
        return fleets[-1]

    yield make
    for one in fleets:
        one.close()
