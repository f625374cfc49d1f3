"""Compare what two states of the program give: `python -m tests.same REV`.

Runs the parts of `parts.py` with the packages of git revision REV, checked out in a temporary
worktree, and with those of the working tree, and compares all that they wrote and printed byte for
byte. Exempt is what `canonical.py` lists, and nothing else. Both run on this machine with the same
interpreter and the same installed packages, each with a cache of compiled kernels of its own.

The exit code is 0 if nothing differs, and 1 otherwise, after one line for each difference with a
short excerpt. What REV gave is kept in build/same for as long as the parts, the interpreter and
the pinned packages stay the same; `--fresh` runs it again.
"""

import argparse
import difflib
import hashlib
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.same.canonical import NOT_COMPARED, canonical, name_of
from tests.same.parts import PARTS, PROJECT, Run, make_inputs

KEPT = PROJECT / "build" / "same"
FAILED = "failed.out"
"""Why a part could not be run to its end: a difference, even where both trees fail."""
_EXCERPT = 12
"""Lines of a difference that are printed."""
_LONGEST_LINE = 200


class Difference(NamedTuple):
    """Something that is not the same in both trees."""

    name: str
    excerpt: list[str]


class Tree(NamedTuple):
    """Where a tree's packages are, and where its runs are put."""

    source: Path
    out: Path
    cache: Path


def compared(before: Path, after: Path) -> tuple[int, list[Difference]]:
    """Compare all files of two folders; return their number and the differences, by name."""
    ours, theirs = _files(before), _files(after)
    failed = [path for path in (*ours.values(), *theirs.values()) if path.name == FAILED]
    differences = [Difference(str(path), path.read_text().splitlines()) for path in failed]
    for name in sorted(ours | theirs):
        if name not in theirs:
            differences.append(Difference(name, ["only in the revision"]))
        elif name not in ours:
            differences.append(Difference(name, ["only in the working tree"]))
        elif excerpt := differing(canonical(ours[name]), canonical(theirs[name])):
            differences.append(Difference(name, excerpt))
    return len(ours | theirs), differences


def differing(before: str | bytes, after: str | bytes) -> list[str]:
    """Return a short excerpt of the difference; nothing where there is none."""
    if before == after:
        return []
    if isinstance(before, str) and isinstance(after, str):
        lines = difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm="")
        return [line[:_LONGEST_LINE] for line in list(lines)[2 : 2 + _EXCERPT]] or ["line ends"]
    old, new = (one.encode() if isinstance(one, str) else one for one in (before, after))
    pairs = enumerate(zip(old, new, strict=False))
    first = next((n for n, (a, b) in pairs if a != b), min(len(old), len(new)))
    return [f"byte {first} of {len(old)} and {len(new)} is the first that differs"]


def _files(folder: Path) -> dict[str, Path]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {
        name_of(path.relative_to(folder)): path for path in paths if path.suffix not in NOT_COMPARED
    }


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=PROJECT, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"git {words[0]}: {done.stderr.strip()}")
    return done.stdout.strip()


def _key(commit: str) -> str:
    """Name what a kept result of a revision depends on beside the revision itself."""
    here = Path(__file__).parent
    sources = [*sorted(here.glob("*.py")), *sorted((PROJECT / "requirements").glob("*.txt"))]
    content = b"".join(path.read_bytes() for path in sources) + sys.version.encode()
    return f"{commit[:12]}-{hashlib.sha256(content).hexdigest()[:8]}"


@contextmanager
def _worktree(commit: str, folder: Path) -> Iterator[Path]:
    """Check a revision out beside everything else, for as long as it is needed."""
    tree = folder / "tree"
    _git("worktree", "add", "--detach", "--force", str(tree), commit)
    try:
        yield tree
    finally:
        _git("worktree", "remove", "--force", str(tree))


def _run_all(jobs: Sequence[tuple[Tree, str]], at_once: int) -> None:
    """Run parts, `at_once` at a time; a part that cannot be run leaves its error to be compared."""
    waiting: queue.SimpleQueue[tuple[Tree, str]] = queue.SimpleQueue()
    for job in jobs:
        waiting.put(job)

    def work() -> None:
        while not waiting.empty():
            try:
                tree, name = waiting.get_nowait()
            except queue.Empty:
                return
            _run_one(tree, name)

    with ThreadPoolExecutor(at_once) as pool:
        for future in [pool.submit(work) for _ in range(at_once)]:
            future.result()


def _run_one(tree: Tree, name: str) -> None:
    folder = tree.out / name
    partial = tree.out / f".{name}"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    began = time.monotonic()
    try:
        PARTS[name](Run(tree.source, partial, tree.cache))
    except (OSError, AssertionError, subprocess.SubprocessError) as error:
        (partial / FAILED).write_text(f"{type(error).__name__}: {error}\n")
    partial.rename(folder)
    print(f"  {time.monotonic() - began:5.0f} s  {tree.out.parent.name}  {name}", file=sys.stderr)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.same", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("revision", metavar="REV", help="git revision to compare with")
    parser.add_argument(
        "--only",
        action="append",
        metavar="NAME",
        help="parts whose name begins so; may be given again (default: all)",
    )
    parser.add_argument("--fresh", action="store_true", help="forget what REV gave before")
    parser.add_argument("--keep", metavar="DIR", type=Path, help="keep both trees' files here")
    parser.add_argument("--list", action="store_true", help="print the names of the parts")
    return parser.parse_args()


def main() -> int:
    """Run both trees and compare; return the exit code."""
    options = _arguments()
    if options.list:
        print("\n".join(PARTS))
        return 0
    chosen = [n for n in PARTS if not options.only or n.startswith(tuple(options.only))]
    if not chosen:
        sys.exit(f"--only: is {', '.join(options.only)}, it must begin the name of a part (--list)")
    commit = _git("rev-parse", "--verify", f"{options.revision}^{{commit}}")
    kept = KEPT / _key(commit) / "revision"
    if options.fresh:
        shutil.rmtree(kept.parent, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix="driveby-same-") as temporary:
        scratch = Path(temporary)
        number, differences = _both(commit, kept, scratch, chosen)
        if options.keep is not None:
            shutil.copytree(kept, options.keep / "revision", dirs_exist_ok=True)
            shutil.copytree(scratch / "now", options.keep / "working", dirs_exist_ok=True)
    for name, excerpt in differences:
        print(f"{name}: differs")
        for line in excerpt[:_EXCERPT]:
            print(f"    {line}")
    if differences:
        print(f"{number} things compared, {len(differences)} differ")
        return 1
    print(f"{number} things compared, same")
    return 0


def _both(
    commit: str, kept: Path, scratch: Path, chosen: Sequence[str]
) -> tuple[int, list[Difference]]:
    """Run what has to be run in both trees and compare the chosen parts."""
    now = Tree(PROJECT, scratch / "now", scratch / "kernels-now")
    missing = [name for name in chosen if not (kept / name).exists()]
    at_once = min(2, os.cpu_count() or 1)
    with _worktree(commit, scratch) as source:
        before = Tree(source, kept, scratch / "kernels-before")
        if not (kept / "inputs").exists():
            shutil.rmtree(kept / ".inputs", ignore_errors=True)
            make_inputs(kept / ".inputs", source, before.cache)
            (kept / ".inputs").rename(kept / "inputs")
        shutil.copytree(kept / "inputs", now.out / "inputs")
        jobs = [(before, name) for name in missing] + [(now, name) for name in chosen]
        _run_all(sorted(jobs, key=lambda job: chosen.index(job[1])), at_once)
    number, differences = 0, []
    for name in chosen:
        some, differing_ones = compared(kept / name, now.out / name)
        number += some
        differences += [d._replace(name=f"{name}/{d.name}") for d in differing_ones]
    return number, differences


if __name__ == "__main__":
    sys.exit(main())
