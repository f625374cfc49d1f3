"""What the logger does with recordings that it does not write any more.

Those that a run before left without END, because it was killed or the power went, are recovered:
the damaged file is then called `….mcap.crashed`, so that `*.mcap` finds every message once. With a
budget, the oldest recordings are deleted, of those whose crossings have all been identified. The
work is done one file after the other in processes of low priority, while recording goes on.
"""

import json
import logging
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from schemas.events import Event, EventKind
from schemas.topics import REALM, realm_within
from services.common.disk import DISK, Disk
from services.common.errors import EXIT_INTERRUPTED, FailureError, InputError
from services.recordings.recording import is_being_written, is_closed
from services.recordings.recovery import ASIDE, put_aside, recovered_path

_log = logging.getLogger(__name__)
_BUDGET_PERIOD_S = 10.0
"""How often it is looked whether the folder has outgrown its budget."""
_ASK_AGAIN_S = 600.0
"""A recording that may not go is not asked about again sooner: each question is a process."""
_POLL_S = 0.1
"""So late an end of the logger is seen while a child works."""
_NICE = 15
"""Children give way to what records."""
_REALM = re.compile(REALM)
_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_EXIT_CLEAN, _EXIT_BAD_INPUT, _EXIT_LOSSY = 0, 2, 3


class House(NamedTuple):
    """Which recordings are kept, and who is told."""

    folder: Path
    realms: Sequence[str]
    min_free_bytes: int
    budget_bytes: int | None
    tell: Callable[[str, Event], None]
    """Takes a realm and an event."""
    disk: Disk = DISK


class Housekeeping:
    """Keeps house in a thread of its own until it is closed."""

    def __init__(self, house: House) -> None:
        self._house = house
        self._closing = threading.Event()
        # What crashed before this run; a file that is new is not looked at.
        self._crashed = sorted(_recordings(house, ".mcap"))
        self._kept_until: dict[Path, float] = {}
        self._is_over_budget = False
        self.is_busy = True
        """Whether there is something left to do now."""
        self._thread = threading.Thread(target=self._run, name="housekeeping", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop; what was begun is ended, and begun again in the next run."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            for path in self._crashed:
                if self._closing.is_set():
                    return
                try:
                    if path.exists() and not is_being_written(path) and not is_closed(path):
                        self._recover(path)
                except (InputError, FailureError, OSError) as error:
                    if path.exists():  # it may not be read
                        _log.warning("%s", error)
            while self._house.budget_bytes is not None:
                self._keep_budget(self._house.budget_bytes)
                self.is_busy = False
                if self._closing.wait(_BUDGET_PERIOD_S):
                    return
        except Exception:  # recording goes on without
            _log.exception("housekeeping ended")
        finally:
            self.is_busy = False

    def _recover(self, path: Path) -> None:
        size = path.stat().st_size
        free_bytes = self._house.disk.free_bytes(path.parent)
        if free_bytes - size < self._house.min_free_bytes:
            text = f"{path.name} was cut off and stays so: too little room to recover it"
            self._tell(path, EventKind.DISK_LOW, text)
            return
        # What an earlier run recovered of it, and did not get to rename it, is replaced.
        options = ["--set-aside", "--json", "--force"]
        done = self._run_gently(["services", "recover", str(path), *options])
        if done is None:
            return
        code, out, log = done
        if code in (_EXIT_CLEAN, _EXIT_LOSSY):
            found = json.loads(out)
            lost = "an unknown number" if found["lost"] is None else found["lost"]
            text = (
                f"{path.name} was cut off; {found['messages']} messages recovered to "
                f"{recovered_path(path).name}, {lost} lost, {found['damaged_bytes']} bytes damaged"
            )
            self._tell(path, EventKind.RECORDING_RECOVERED, text, found["messages"])
        elif code == _EXIT_BAD_INPUT and "holds nothing" in log:
            put_aside(path)
            text = f"{path.name} holds nothing that can be read, and was set aside"
            self._tell(path, EventKind.RECORDING_RECOVERED, text)
        elif path.exists():  # else somebody else has moved, deleted or recovered it meanwhile
            _log.error("%s could not be recovered: %s", path, log.strip()[-300:])

    def _keep_budget(self, budget_bytes: int) -> None:
        sizes = {p: p.stat().st_size for p in _recordings(self._house, ".mcap", ASIDE)}
        total = sum(sizes.values())
        for path in sorted(sizes, key=lambda p: (not p.name.endswith(ASIDE), p.stat().st_mtime)):
            if total <= budget_bytes or self._closing.is_set():
                break
            if self._may_go(path):
                path.unlink()
                total -= sizes[path]
                text = f"{path.name} ({sizes[path]} bytes) was deleted to keep the budget"
                self._tell(path, EventKind.RECORDING_DELETED, text)
        if total > budget_bytes and not self._is_over_budget:
            text = (
                f"recordings take {total / 1e6:.0f} MB of {budget_bytes / 1e6:.0f} MB, and none "
                "of them may be deleted: crossings in them are not identified"
            )
            self._tell(None, EventKind.DISK_LOW, text)
        self._is_over_budget = total > budget_bytes

    def _may_go(self, path: Path) -> bool:
        if path.name.endswith(ASIDE):
            return recovered_path(path.with_name(path.name.removesuffix(ASIDE))).exists()
        if time.monotonic() < self._kept_until.get(path, 0.0):
            return False
        if is_being_written(path) or not is_closed(path):
            return False
        others = sorted(p for p in _recordings(self._house, ".mcap") if p != path)
        realm = path.relative_to(self._house.folder).parts[0]
        results = sorted((self._house.folder / realm).glob("*.mcap"))
        arguments = [str(p) for p in (path, *others, *results)]
        done = self._run_gently(["services.history.processed", *arguments])
        may_go = done is not None and done[0] == 0
        if not may_go:
            self._kept_until[path] = time.monotonic() + _ASK_AGAIN_S
        return may_go

    def _run_gently(self, arguments: list[str]) -> tuple[int, str, str] | None:
        """Run a module of ours at low priority; None if it was not let finish.

        It ends with this process, even if this one is killed (`services.common.leash`).
        """
        its_end, our_end = os.pipe()
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", "services.common.leash", *arguments],
                stdin=its_end,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        finally:
            os.close(its_end)
        with process, os.fdopen(our_end, "wb") as leash:
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
            while True:
                try:
                    out, log = process.communicate(timeout=_POLL_S)
                    return (
                        None
                        if process.returncode == EXIT_INTERRUPTED
                        else (process.returncode, out, log)
                    )
                except subprocess.TimeoutExpired:
                    if self._closing.is_set():
                        leash.close()
                        process.communicate()
                        return None

    def _tell(self, path: Path | None, kind: EventKind, text: str, messages: int = 0) -> None:
        realm = realm_within(self._house.realms) or "live"
        if path is not None:
            realm = path.relative_to(self._house.folder).parts[0]
        self._house.tell(realm, Event(kind, time.time_ns(), text, messages=messages))


def _recordings(house: House, *endings: str) -> Iterator[Path]:
    """Yield what a logger has written below its folder: REALM/DATE/NAME."""
    for path in {path for one in house.realms for path in house.folder.glob(f"{one}/*/*")}:
        realm, date = path.relative_to(house.folder).parts[:2]
        named = _REALM.fullmatch(realm) and _DATE.fullmatch(date)
        if named and path.name.endswith(endings) and path.is_file() and path.name[0] != ".":
            yield path
