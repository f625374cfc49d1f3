"""The fixed list of runs: each part calls one tree's commands and leaves files to be compared.

A part knows a tree only by what stays when code moves: its commands, and the class `WorkingEngine`
of its own tests. It writes with relative names, so that two trees print the same paths.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.endpoints import free_endpoint
from tests.waiting import until

PROJECT = Path(__file__).parents[2]
RECORDINGS = {
    "sample": PROJECT / "recordings/sample/crossing.mcap",
    "exact": PROJECT / "tests/data/noise_free.mcap",
}
"""Recordings of the repository; `many` beside them is simulated once for both trees."""
MANY = ("--scenario", "6", "--runs", "3", "--noise", "25", "--gps-noise", "--seed", "7")
INPUTS = Path("../inputs")
_MODIFIED_S = 1_700_000_000
"""Modification time of every input (s since 1970 UTC): catalogues store it."""
_NOW_S = 1_800_000_000
"""Time of day at which every command runs (s since 1970 UTC)."""
_CLOCK = Path(__file__).with_name("clock")
_LONGEST_S = 3600.0
"""Longest wall time of one command (s): a busy machine compiles the kernels in many minutes."""
_PROGRESS = "INFO driveby.progress: "
"""Mark of lines of progress, whose number depends on the machine's speed."""


class Run(NamedTuple):
    """One part's run in one tree."""

    tree: Path
    folder: Path
    """Working directory of the commands; its files are compared afterwards."""
    cache: Path
    """Numba's kernels of this tree."""

    @property
    def environment(self) -> dict[str, str]:
        """Return the environment in which this tree's packages come first."""
        own = {
            "PYTHONPATH": f"{self.tree}{os.pathsep}{_CLOCK}",
            "PYTHONSAFEPATH": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
            "NUMBA_CACHE_DIR": str(self.cache),
            "OPENBLAS_NUM_THREADS": "1",
            "COLUMNS": "100",
            "TZ": "UTC",
            "NO_COLOR": "1",
        }
        return os.environ | own

    def python(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run Python in the part's folder with this tree's packages."""
        return subprocess.run(
            [sys.executable, *words],
            cwd=self.folder,
            env=self.environment | {"DRIVEBY_SAME_CLOCK": str(_NOW_S)},
            capture_output=True,
            text=True,
            timeout=_LONGEST_S,
        )

    def driveby(self, name: str, *words: str, code: int | None = 0) -> str:
        """Run a command; keep exit code and output as `NAME.out`, return standard output.

        AssertionError: it ends with another exit code than `code`, where one is given, so that
        two trees which both fail are not the same.
        """
        done = self.python("-m", "driveby", *words)
        errors = "".join(
            line for line in done.stderr.splitlines(keepends=True) if _PROGRESS not in line
        )
        text = f"exit code {done.returncode}\n{done.stdout}--- standard error\n{errors}"
        (self.folder / f"{name}.out").write_text(text)
        assert code in (None, done.returncode), f"{' '.join(words)}: {text}"
        return done.stdout

    def start(self, *words: str) -> "subprocess.Popen[bytes]":
        """Start a service in the part's folder, with the time of day.

        Its log goes to a file that is not compared.
        """
        with (self.folder / f"{words[0]}.log").open("wb") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "driveby", *words],
                cwd=self.folder,
                env=self.environment,
                stdout=log,
                stderr=log,
            )


def make_inputs(folder: Path, tree: Path, cache: Path) -> None:
    """Put the recordings, a site file and files with faults into `folder`, for both trees."""
    folder.mkdir(parents=True)
    for name, path in RECORDINGS.items():
        shutil.copy(path, folder / f"{name}.mcap")
    run = Run(tree, folder, cache)
    done = run.python("-m", "driveby", "simulate", *MANY, "-o", "many.mcap")
    if done.returncode:
        raise RuntimeError(done.stderr)
    example = (PROJECT / "docs/site.example.toml").read_text()
    (folder / "site.toml").write_text(example)
    (folder / "span.toml").write_text(re.sub(r"(?m)^span_m = .*$", "span_m = -3", example))
    (folder / "unknown.toml").write_text(example + '\n[[bridges]]\nid = "x"\nspam = 1\n')
    (folder / "broken.toml").write_text(example + "\n[[[")
    torn = (folder / "sample.mcap").read_bytes()
    (folder / "torn.mcap").write_bytes(torn[: len(torn) * 2 // 3])
    (folder / "text.mcap").write_text("not a recording\n")
    (folder / "temperature.csv").write_text("time_s,temperature_deg_c\n1767225600,4.0\n")
    (folder / "paper.toml").write_bytes(_site_of(folder / "exact.mcap"))
    for path in folder.iterdir():
        os.utime(path, (_MODIFIED_S, _MODIFIED_S))


def given(name: str) -> str:
    """Return the path of an input as commands name it."""
    return str(INPUTS / name)


def help_of_all(run: Run) -> None:
    """Print the help of every command."""
    overview = run.driveby("driveby", "--help")
    for command in re.findall(r"(?m)^    ([a-z][a-z-]+)\b", overview.split("COMMAND", 2)[-1]):
        run.driveby(command, command, "--help")
    for shell in ("bash", "zsh"):
        run.driveby(shell, "--print-completion", shell)


PAPER = ("--site", given("paper.toml"))


BAD: dict[str, tuple[str, ...]] = {
    "no-command": (),
    "unknown-command": ("identfy",),
    "unknown-option": ("identify", given("exact.mcap"), "--jsn", "a.json"),
    "unknown-method": ("identify", given("exact.mcap"), "--method", "best"),
    "no-file": ("identify", "none.mcap"),
    "no-recording": ("identify", given("text.mcap")),
    "span": ("identify", given("exact.mcap"), "--site", given("span.toml")),
    "unknown-key": ("identify", given("exact.mcap"), "--site", given("unknown.toml")),
    "broken-site": ("identify", given("exact.mcap"), "--site", given("broken.toml")),
    "onto-input": ("identify", given("exact.mcap"), "--json", given("exact.mcap")),
    "draws-of-other-method": (
        *("identify", given("exact.mcap"), "--method", "least-squares", "--draws", "a.npz"),
    ),
    "scenario": ("simulate", "--scenario", "13", "-o", "a.mcap"),
    "two-truths": ("simulate", "--scenario", "1", "--ei", "1,1", "-o", "a.mcap"),
    "noise": ("simulate", "--scenario", "1", "--noise", "-1", "-o", "a.mcap"),
    "results-of-text": ("report", given("text.mcap"), "-o", "a.html"),
    "history-without": ("history", "bridge-1", "--history", "none"),
    "alarm-of-nothing": ("alarm", "ack", "bridge-1", "--history", "none"),
    "export-nothing": ("export", "none.mcap", "--to", "tables"),
    "worker-without-site": ("worker",),
    "worker-method": ("worker", "--site", given("site.toml"), "--method", "least-squares"),
    "worker-processes": ("worker", "--site", given("site.toml"), "--processes", "0"),
    "truck-speed": ("truck", given("exact.mcap"), "--speed", "-1"),
    "replay-nothing": ("replay", given("exact.mcap"), "--topics", "nothing"),
    "logger-open": ("logger", "--listen", "tcp/0.0.0.0:7447"),
    "realm": ("worker", "--site", given("site.toml"), "--realm", "a/b"),
    "view-what": ("view", "none.mcap"),
    "torn": ("info", given("torn.mcap")),
}


def bad_input(run: Run) -> None:
    """Give every command something wrong; the line of the error and the code are compared."""
    for name, words in BAD.items():
        run.driveby(name, *words, code=None)


def simulated(run: Run) -> None:
    """Simulate three drives that use different parts of the simulation."""
    run.driveby("plain", "simulate", "--scenario", "6", "-o", "plain.mcap")
    run.driveby("many", "simulate", *MANY, "-o", "many.mcap")
    words = ("--road-surface", "--wander", "0.2", "--direction", "end_to_start", "--speed", "8:11")
    more = ("--lane-offset", "1.5", "--torsion", "2:2.3", "--friction", "0.02", "--noise", "25")
    run.driveby("beyond", "simulate", "--ei", "1,1,.6,1,1,1,1", *words, *more, "-o", "beyond.mcap")


def identified(method: str, recording: str) -> Callable[[Run], None]:
    """Identify a recording and write all that `identify` can write."""

    def part(run: Run) -> None:
        outputs = ["--json", "result.json", "--rrd", "result.rrd", "--figures", "figures"]
        if method == "pre":
            outputs += ["--draws", "draws.npz"]
        words = ("identify", given(f"{recording}.mcap"), "--method", method, *outputs)
        run.driveby("identify", *words)

    return part


def engine(method: str, recording: str) -> Callable[[Run], None]:
    """Feed a recording to the engine of the tree's own tests; keep every message it yields."""

    def part(run: Run) -> None:
        script = Path(__file__).with_name("engine_messages.py")
        done = run.python(str(script), given(f"{recording}.mcap"), method, "messages.jsonl")
        assert done.returncode == 0, done.stderr

    return part


@contextmanager
def _ended(
    process: "subprocess.Popen[bytes]",
) -> Iterator["subprocess.Popen[bytes]"]:
    """End a service as an operator would, whatever happened meanwhile."""
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(_LONGEST_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def worker(method: str, recording: str, crossings: int) -> Callable[[Run], None]:
    """Replay a recording to logger and worker as processes; keep the worker's two files."""

    def part(run: Run) -> None:
        endpoint = free_endpoint()
        shutil.copy(run.folder / given(f"{recording}.mcap"), run.folder / "drive.mcap")
        logger = ("logger", "--listen", endpoint, "--realm", "replay-*", "--file", "logged.mcap")
        (run.folder / "site.toml").write_bytes(_site_of(run.folder / "drive.mcap"))
        words = ("--endpoint", endpoint, "--realm", "replay-drive", "--site", "site.toml")
        files = ("--file", "results.mcap", "--method", method)
        with (
            _ended(run.start(*logger)),
            _ended(run.start("worker", *words, *files)),
        ):
            until(lambda: _listens(run, endpoint), "the worker")
            replay = ("replay", "drive.mcap", "--endpoint", endpoint, "--speed", "0")
            with _ended(run.start(*replay)) as player:
                player.wait(_LONGEST_S)
            results = run.folder / "results.json"
            key = b'"crossing_id"'
            until(
                lambda: results.exists() and results.read_bytes().count(key) >= crossings,
                "all results",
            )
        (run.folder / "drive.mcap").unlink()

    return part


def _site_of(recording: Path) -> bytes:
    from mcap.reader import make_reader

    with recording.open("rb") as file:
        found = [one.data for one in make_reader(file).iter_attachments()]
    return found[0]


def _listens(run: Run, endpoint: str) -> bool:
    words = ("health", "worker", "--endpoint", endpoint, "--realm", "replay-drive")
    process = run.start(*words)
    return process.wait(_LONGEST_S) == 0


def years(run: Run) -> None:
    """Identify into a folder, keep a history, and ask it everything."""
    found = ("many.mcap", "sample.mcap")
    words = ("identify", *(given(name) for name in found), "--into", "into")
    run.driveby("into", *words, "--json", "into.json")
    run.driveby("again", *words)
    exact = ("identify", given("exact.mcap"), "--method", "least-squares", "--into", "exact")
    run.driveby("exact", *exact)
    history = ("--history", "history")
    run.driveby("add", "history", "add", "into", *history)
    run.driveby(
        *("add-exact", "history", "add", "exact", *history),
        *("--temperature", given("temperature.csv")),
    )
    run.driveby("table", "history", *history)
    outputs = ("--csv", "past.csv", "--json", "past.json", "--figures", "past", "--rrd", "past.rrd")
    run.driveby("bridge", "history", "bridge-1", *history, "--period", "day", *outputs)
    asked = "SELECT crossing_id, verdict, entry_s FROM crossings ORDER BY crossing_id, method"
    run.driveby("sql", "history", *history, "--sql", asked)
    run.driveby("check", "alarm", "check", *history, "--period", "day")
    run.driveby("list", "alarm", "list", *history)
    report = ("report", "into.json", *history, *PAPER, "-o", "report.html")
    run.driveby("report", *report)


def files(run: Run) -> None:
    """Look at recordings, export, check, fuse, report and recover."""
    for name in ("many", "sample", "exact"):
        run.driveby(f"info-{name}", "info", given(f"{name}.mcap"), "--json")
        run.driveby(f"words-{name}", "info", given(f"{name}.mcap"))
        found = 1 if name == "exact" else 0  # its sensors are declared to have no noise
        run.driveby(f"check-{name}", "check", given(f"{name}.mcap"), code=found)
        words = ("identify", given(f"{name}.mcap"), "--method", "least-squares")
        run.driveby(f"identify-{name}", *words, "--json", f"{name}.json")
    run.driveby("pre", "identify", given("many.mcap"), "--json", "many.json")
    run.driveby("fuse", "fuse", "many.json", "--json", "fused.json")
    run.driveby("report", "report", "many.json", "exact.json", *PAPER, "-o", "report.html")
    for kind in ("csv", "parquet"):
        export = ("export", given("many.mcap"), "many.json", "--to", kind, "--format", kind)
        run.driveby(f"export-{kind}", *export, "--sensorthings")
    run.driveby("recover", "recover", given("torn.mcap"), "-o", "recovered.mcap", code=3)
    shutil.copytree(run.folder / INPUTS, run.folder / "drives")
    site = ("--site", given("site.toml"), "--csv", "catalog.csv")
    run.driveby("catalog", "catalog", "drives", *site)
    shutil.rmtree(run.folder / "drives", ignore_errors=True)
    run.driveby("check-site", "check", given("site.toml"))
    run.driveby("template", "check", "--template", "new.toml")


def paper(run: Run) -> None:
    """Compare two of the paper's scenarios with its tables."""
    words = ("validate", "--scenarios", "6", "--noise", "0", "--json", "paper.json")
    run.driveby("validate", *words)


PARTS: dict[str, Callable[[Run], None]] = {
    "identify-random-walk-exact": identified("random-walk", "exact"),
    "identify-pre-exact": identified("pre", "exact"),
    "years": years,
    "worker-pre-many": worker("pre", "many", 3),
    "worker-least-squares-exact": worker("least-squares", "exact", 1),
    "files": files,
    "identify-pre-many": identified("pre", "many"),
    "identify-pre-sample": identified("pre", "sample"),
    "identify-least-squares-many": identified("least-squares", "many"),
    "identify-least-squares-sample": identified("least-squares", "sample"),
    "identify-least-squares-exact": identified("least-squares", "exact"),
    "engine-random-walk-sample": engine("random_walk", "sample"),
    "engine-random-walk-many": engine("random_walk", "many"),
    "engine-pre-many": engine("pre", "many"),
    "engine-pre-sample": engine("pre", "sample"),
    "engine-least-squares-exact": engine("least_squares", "exact"),
    "simulate": simulated,
    "paper": paper,
    "help": help_of_all,
    "errors": bad_input,
}
"""The parts by name, longest first."""
