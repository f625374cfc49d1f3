"""Do the tests see a wrong token? `make mutants MUTANTS=40 SEED=1`.

Draws one-token mutants from all rooms, as many from each as their number of files lets expect but
one at least, applies each to a copy of the tree and runs the default tests on it until the first
failure: first those that stand closest to the mutated module by their imports, then the rest. A
mutant that makes the tests run on without end counts as killed. A failure counts only if the same
test passes on the tree as it is.

numba keeps compiled kernels beside the sources and would not see that a kernel which it inlined
has changed: what was compiled from the mutated module, or from one that imports it, is forgotten
in the copy.

Each outcome is a line of a file, so a run that was stopped goes on where it ended.
"""

import argparse
import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from tests.mutants.imports import Imports, distances_to, imports_of
from tests.mutants.mutate import Mutant, mutants

PROJECT = Path(__file__).parents[2]
PACKAGES = ("driveby", "pre_core", "schemas", "services", "studies")
KILLED, TIMEOUT, SURVIVED = "killed", "killed by time", "survived"


class Drawn(NamedTuple):
    file: str
    mutant: Mutant

    @property
    def name(self) -> str:
        mutant = self.mutant
        return (
            f"{self.file}:{mutant.line}:{mutant.column} {mutant.old} -> {mutant.new or 'nothing'}"
        )


class Run(NamedTuple):
    """What pytest made of some tests."""

    code: int | None
    """None: it was still running at the end of its time."""
    failed: str
    """The first test that failed."""
    seconds: float


def main() -> None:
    options = _options()
    options.results.parent.mkdir(parents=True, exist_ok=True)
    files = _files()
    sources = [file for file in files if file.startswith(PACKAGES) and file.endswith(".py")]
    sources = [file for file in sources if file.split("/")[0] in PACKAGES and "_pb2" not in file]
    imports = imports_of(PROJECT, [file for file in files if file.endswith(".py")])
    sample = draw(sources, options.mutants, options.seed, options.only)
    known = _known(options.results)
    with tempfile.TemporaryDirectory(prefix="driveby-mutants-") as folder:
        pristine = Path(folder) / "pristine"
        _copy_project(files, pristine)
        _check_imports(pristine)

        def judge(drawn: Drawn) -> dict[str, Any]:
            record = known.get(drawn.name) or {}
            if record.get("outcome") in (KILLED, TIMEOUT) or record.get("wider") == SURVIVED:
                return record
            wider = not options.related_only
            if record.get("outcome") == SURVIVED and not wider:
                return record
            record = _judge(drawn, pristine, imports, options, wider=wider, before=record)
            with options.results.open("a") as file:
                file.write(json.dumps(record) + "\n")
            sys.stdout.write(f"{record['outcome']:>14}  {drawn.name}  {record['by']}\n")
            sys.stdout.flush()
            return record

        with ThreadPoolExecutor(options.jobs) as pool:
            records = list(pool.map(judge, sample))
    _table(records, options)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--mutants", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="files whose path begins with this")
    parser.add_argument("--related", type=int, default=8, help="files of tests that come first")
    parser.add_argument("--related-only", action="store_true", help="leave out the other tests")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at a time")
    parser.add_argument("--limit-s", type=float, default=1800.0, help="of one run of pytest")
    parser.add_argument("--results", type=Path, default=PROJECT / "build/mutants.jsonl")
    return parser.parse_args()


def _files() -> list[str]:
    """What belongs to the project, also if it is not committed yet."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=PROJECT,
        check=True,
        capture_output=True,
        text=True,
    )
    return sorted(file for file in listed.stdout.splitlines() if (PROJECT / file).is_file())


def draw(sources: list[str], count: int, seed: int, only: str = "") -> list[Drawn]:
    """Draw mutants without repetition; the rooms take turns, the largest first and oftenest."""
    rng = random.Random(seed)
    rooms: dict[str, list[Drawn]] = defaultdict(list)
    for file in sources:
        if file.startswith(only):
            found = mutants((PROJECT / file).read_text())
            rooms[_room(file)] += [Drawn(file, mutant) for mutant in found]
    rooms = {room: found for room, found in sorted(rooms.items()) if found}
    weight = {room: len({drawn.file for drawn in found}) for room, found in rooms.items()}
    for found in rooms.values():
        rng.shuffle(found)
    sample: list[Drawn] = []
    taken = dict.fromkeys(rooms, 0)
    while len(sample) < count:
        left = [room for room in rooms if taken[room] < len(rooms[room])]
        if not left:
            break
        # Each room's first mutant comes before any second one; then by the number of files.
        room = max(left, key=lambda room: (taken[room] == 0, weight[room] / (taken[room] + 1)))
        sample.append(rooms[room][taken[room]])
        taken[room] += 1
    return sample


def _room(file: str) -> str:
    parts = file.split("/")
    return "/".join(parts[:2]) if parts[0] in ("pre_core", "services", "studies") else parts[0]


def _known(results: Path) -> dict[str, dict[str, Any]]:
    if not results.exists():
        return {}
    records = [json.loads(line) for line in results.read_text().splitlines()]
    return {record["mutant"]: record for record in records}


def _copy_project(files: list[str], target: Path) -> None:
    compiled = [
        str(path.relative_to(PROJECT))
        for package in PACKAGES
        for path in (PROJECT / package).rglob("__pycache__/*.nb?")
    ]
    for file in [*files, *compiled]:
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(PROJECT / file, target / file)  # numba compares the times of the sources


def _check_imports(tree: Path) -> None:
    code = "import driveby, pre_core, schemas, services; print(services.__path__[0])"
    output = subprocess.run(
        [sys.executable, "-c", code], cwd=tree, env=_environment(tree), check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    if Path(output.stdout.strip()) != tree / "services":
        raise SystemExit(f"tests of the copy would import {output.stdout.strip()}")


def _environment(tree: Path) -> dict[str, str]:
    folder = tree.with_name(tree.name + "-tmp")
    folder.mkdir(exist_ok=True)
    return os.environ | {
        "PYTHONPATH": str(tree),
        "TMPDIR": str(folder),
        "OPENBLAS_NUM_THREADS": "1",
    }


def _judge(
    drawn: Drawn,
    pristine: Path,
    imports: Imports,
    options: argparse.Namespace,
    *,
    wider: bool,
    before: dict[str, Any],
) -> dict[str, Any]:
    related, others = tests_for(drawn.file, imports, options.related)
    tree = Path(tempfile.mkdtemp(prefix="mutant-", dir=pristine.parent)) / "driveby"
    shutil.copytree(pristine, tree, symlinks=True)
    path = tree / drawn.file
    path.write_text(drawn.mutant.apply(path.read_text()))
    _forget_compiled(tree, drawn.file, imports)
    record = {"mutant": drawn.name, "line": _line(drawn), "seconds": before.get("seconds", 0.0)}
    try:
        for kind, tests in (("related", related), ("wider", others)):
            if before.get(kind) == SURVIVED or not tests or (kind == "wider" and not wider):
                record[kind] = before.get(kind, SURVIVED if not tests else None)
                continue
            without: list[str] = []
            while True:
                run = _pytest(tree, tests, options.limit_s, without)
                record["seconds"] = round(record["seconds"] + run.seconds, 1)
                if run.code is None:
                    return record | {"outcome": TIMEOUT, "by": f"{kind} tests, {run.seconds:.0f} s"}
                if run.code == 0:
                    break
                if not run.failed or _pytest(pristine, [run.failed], options.limit_s).code == 0:
                    by = run.failed or f"pytest ended with {run.code}"
                    return record | {"outcome": KILLED, "by": by, kind: KILLED}
                sys.stdout.write(f"fails without any mutant, left out: {run.failed}\n")
                without.append(run.failed)
            record[kind] = SURVIVED
        return record | {"outcome": SURVIVED, "by": "" if wider else "related tests only"}
    finally:
        shutil.rmtree(tree.parent, ignore_errors=True)


def tests_for(file: str, imports: Imports, count: int) -> tuple[list[str], list[str]]:
    """Split the files of tests: the `count` closest to a module by their imports, and the rest."""
    away = distances_to(imports, file)
    tests = [name for name in imports if re.match(r"tests/.*/test_[^/]*\.py", name)]

    def order(name: str) -> tuple[bool, float, int, str]:
        # Tests that start programs come last: they are the slowest and the least direct. Of two
        # that are as close, the one that imports less is about this module rather than others.
        programs = name.startswith("tests/process_replay") or name not in away
        return programs, away.get(name, float("inf")), len(imports[name]), name

    tests.sort(key=order)
    count = min(count, len([name for name in tests if name in away]))
    return tests[:count], tests[count:]


def _forget_compiled(tree: Path, file: str, imports: Imports) -> None:
    for importer in distances_to(imports, file):
        path = tree / importer
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.nb?"):
            compiled.unlink()


def _line(drawn: Drawn) -> str:
    lines = drawn.mutant.apply((PROJECT / drawn.file).read_text()).splitlines()
    return lines[drawn.mutant.line - 1].strip()


def _pytest(tree: Path, tests: list[str], limit_s: float, without: Sequence[str] = ()) -> Run:
    began = time.monotonic()
    options = ["-x", "-q", "-p", "no:cacheprovider", "--tb=no"]
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "pytest",
            *options,
            *(f"--deselect={one}" for one in without),
            *tests,
        ],
        cwd=tree,
        env=_environment(tree),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        return Run(None, "", time.monotonic() - began)
    finally:
        # What the tests have started, too, and what a mutant has kept them from ending.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    failed = re.search(r"^(?:FAILED|ERROR) (\S+::.*?)(?: - .*)?$", output, re.MULTILINE)
    # 5: all of them are deselected by default.
    code = 0 if process.returncode == 5 else process.returncode
    return Run(code, failed[1] if failed else "", time.monotonic() - began)


def _table(records: list[dict[str, Any]], options: argparse.Namespace) -> None:
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for record in records:
        counts[_room(record["mutant"].split(":")[0])][record["outcome"] == SURVIVED] += 1
    say = sys.stdout.write
    say(f"\n{'room':<28}{'killed':>8}{'survived':>10}   (seed {options.seed})\n")
    for room, (killed, survived) in sorted(counts.items()):
        say(f"{room:<28}{killed:>8}{survived:>10}\n")
    killed = sum(count[0] for count in counts.values())
    say(f"{'together':<28}{killed:>8}{len(records) - killed:>10}\n")
    for record in records:
        if record["outcome"] == SURVIVED:
            say(f"\nsurvived: {record['mutant']}\n    {record['line']}\n")


if __name__ == "__main__":
    main()
