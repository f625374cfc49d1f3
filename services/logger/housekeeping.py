"""Housekeeping of closed recordings.

Recordings of an earlier run without END, after a kill or power cut, are recovered: the damaged file
is then called `….mcap.crashed`, so that `*.mcap` finds every message once. With a budget, the
oldest recordings whose crossings have all been identified are deleted. The work runs file by file
in processes of low priority, while recording continues.
"""

import json
import logging
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from schemas.events import Event, EventKind
from schemas.topics import REALM, single_realm
from services.catalogue.deletions import note_deletion
from services.common.child_process import run_gently
from services.common.disk import DISK, Disk
from services.common.errors import FailureError, InputError
from services.common.naming import count_of
from services.recordings.recording import is_being_written, is_closed
from services.recordings.recovery import ASIDE, put_aside, recovered_path

_log = logging.getLogger(__name__)
_BUDGET_PERIOD_S = 10.0
"""Interval of checks of the folder's size."""
_ASK_AGAIN_S = 600.0
"""Interval of checks of a recording that must stay, because each check is a process."""
_REALM = re.compile(REALM)
_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_EXIT_CLEAN, _EXIT_BAD_INPUT, _EXIT_LOSSY = 0, 2, 3


class RetentionPolicy(NamedTuple):
    """The recordings to keep, and the recipient of events."""

    folder: Path
    realms: Sequence[str]
    min_free_bytes: int
    budget_bytes: int | None
    report: Callable[[str, Event], None]
    """Callback with a realm and an event."""
    disk: Disk = DISK


class Housekeeping:
    """A thread for housekeeping until it is closed."""

    def __init__(self, house: RetentionPolicy) -> None:
        self._house = house
        self._closing = threading.Event()
        # Only files that crashed before this run.
        self._crashed = sorted(_recordings(house, ".mcap"))
        self._kept_until: dict[Path, float] = {}
        self._is_over_budget = False
        self.is_busy = True
        """Whether there is something left to do now."""
        self._thread = threading.Thread(target=self._run, name="housekeeping", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop; interrupted work is repeated in the next run."""
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
        except Exception:  # recording continues without it
            _log.exception("housekeeping failed; recording continues without it")
        finally:
            self.is_busy = False

    def _recover(self, path: Path) -> None:
        size = path.stat().st_size
        free_bytes = self._house.disk.free_bytes(path.parent)
        if free_bytes - size < self._house.min_free_bytes:
            text = f"{path.name} was cut off and stays so: too little room to recover it"
            self._report(path, EventKind.DISK_LOW, text)
            return
        # A recovered file that an earlier run did not rename is replaced.
        options = ["--set-aside", "--json", "--force"]
        done = run_gently(["services", "recover", str(path), *options], self._closing)
        if done is None:
            return
        code, out, log = done
        if code in (_EXIT_CLEAN, _EXIT_LOSSY):
            found = json.loads(out)
            text = recovery_text(path, found)
            self._report(path, EventKind.RECORDING_RECOVERED, text, found["messages"])
        elif code == _EXIT_BAD_INPUT and "holds nothing" in log:
            put_aside(path)
            text = f"{path.name} holds nothing that can be read, and was set aside"
            self._report(path, EventKind.RECORDING_RECOVERED, text)
        elif (
            path.exists()
        ):  # otherwise another process has moved, deleted or recovered it meanwhile
            _log.error("%s could not be recovered: %s", path, log.strip()[-300:])

    def _keep_budget(self, budget_bytes: int) -> None:
        sizes = {p: p.stat().st_size for p in _recordings(self._house, ".mcap", ASIDE)}
        total = sum(sizes.values())
        for path in sorted(sizes, key=lambda p: (not p.name.endswith(ASIDE), p.stat().st_mtime)):
            if total <= budget_bytes or self._closing.is_set():
                break
            if self._may_go(path):
                self._note_deletion(path)
                path.unlink()
                total -= sizes[path]
                text = f"{path.name} ({sizes[path]} bytes) was deleted to keep the budget"
                self._report(path, EventKind.RECORDING_DELETED, text)
        if total > budget_bytes and not self._is_over_budget:
            text = (
                f"recordings take {total / 1e6:.0f} MB of {budget_bytes / 1e6:.0f} MB, and none "
                "of them may be deleted: no worker has identified all crossings in them"
            )
            self._report(None, EventKind.DISK_LOW, text)
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
        done = run_gently(["services.ledger.processed", *arguments], self._closing)
        may_go = done is not None and done.code == 0
        if not may_go:
            self._kept_until[path] = time.monotonic() + _ASK_AGAIN_S
        return may_go

    def _note_deletion(self, path: Path) -> None:
        """Note the deletion for the catalogue; without the note it would report a loss."""
        try:
            note_deletion(self._house.folder, path)
        except (InputError, FailureError, OSError) as error:
            _log.warning("the catalogue will report %s as gone: %s", path.name, error)

    def _report(self, path: Path | None, kind: EventKind, text: str, messages: int = 0) -> None:
        realm = single_realm(self._house.realms) or "live"
        if path is not None:
            realm = path.relative_to(self._house.folder).parts[0]
        self._house.report(realm, Event(kind, time.time_ns(), text, messages=messages))


def _recordings(house: RetentionPolicy, *endings: str) -> Iterator[Path]:
    """Yield a logger's files below its folder: REALM/DATE/NAME."""
    for path in {path for one in house.realms for path in house.folder.glob(f"{one}/*/*")}:
        realm, date = path.relative_to(house.folder).parts[:2]
        named = _REALM.fullmatch(realm) and _DATE.fullmatch(date)
        if named and path.name.endswith(endings) and path.is_file() and path.name[0] != ".":
            yield path


def recovery_text(path: Path, found: dict[str, Any]) -> str:
    """Return the result of a recovery, the JSON of `driveby recover`, in words."""
    text = (
        f"{path.name} was cut off; {count_of(found['messages'], 'message')} recovered to "
        f"{recovered_path(path).name}, {found['damaged_bytes']} bytes damaged"
    )
    if found["lost"] is not None:
        return f"{text}, {found['lost']} lost"
    return (
        f"{text}; the end of the file is missing, with an unknown number of messages; those that "
        "cannot be fetched from the trucks again count as missing or lost"
    )
