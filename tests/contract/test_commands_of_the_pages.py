"""Every shell command of README, docs/ and studies/: it is run here, or listed with a reason.

Of what is listed it is still looked at whether the program would take it: options that are gone,
targets of make, modules and files that are not there.
"""

import importlib.util
import re
import shlex
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from services.cli import main as cli

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "studies").glob("*.md")),
]
SAMPLE = "recordings/sample/crossing.mcap"

LONG = "takes minutes to hours; `make test-all`, `make faults` or a person runs it"
WINDOW = "opens a window until somebody closes it; tests/unit/viewer opens it without a screen"
OF_ENGINE = "containers.md"
"""Page whose commands all need an engine; tests/containers runs the main ones."""
ENGINE = "needs a container engine; tests/containers has one"
SERVICE = "runs until it is stopped; tests/process_replay starts it as a process"
FOUR = "is one of four at once; tests/process_replay/test_four_terminals.py runs them as they stand"
MACHINES = "is for machines that are not here; tests/process_replay and tests/faults do it on one"
NETWORK = "needs a network"
CLUSTER = "needs a cluster; tests/faults/test_cluster.py has one"
FUSES = "is of many drives; tests/unit/identification/test_fusing.py runs the commands"
KEPT = "is of a folder of `identify --into`; tests/unit/history/test_archive.py adds one"
REFERENCE = "is of reference crossings that are not in this repository"
CERTIFIES = "takes a minute; tests/process_replay and tests/unit/cli run it"
ITSELF = "runs the tests, of which this is one"

NOT_RUN = {
    "driveby catalog s3://bucket/fleet": "tests/unit/catalogue/test_catalog.py has a store",
    "driveby identify s3://bucket/fleet --into identified": (
        "tests/unit/cli/test_cluster.py has a store"
    ),
    'pytest tests/verdicts/test_faults.py -m slow -k "second or span"': LONG,
    "python -m tests.benchmarks.fleet --out /tmp/fleet": LONG,
    "python -m tests.benchmarks.alarms": LONG,
    "make year": LONG,
    "pytest tests/numerics/test_monitoring.py": ITSELF,
    "pytest tests/verdicts/test_opensees.py -m slow": LONG,
    "pytest tests/contract/test_wheel.py -m slow": ITSELF,
    "driveby alarm ack BRIDGE --by NAME --note TEXT": (
        "needs an alarm; tests/unit/history/test_alarms.py has one"
    ),
    "driveby alarm serve": SERVICE,
    "driveby history BRIDGE --period week --figures DIR": (
        "is of a bridge of one's own; its page runs it of another one"
    ),
    "driveby history add identified": KEPT,
    "driveby history add DIR": KEPT,
    "driveby import d10_left_and_right_8_runs --site d10_left_and_right_8_runs/site.toml "
    "-o d10.mcap": REFERENCE,
    "driveby identify d10.mcap --json d10.json": REFERENCE,
    "driveby cluster --workers 2": SERVICE,
    "driveby cluster --workers 2 --tls cluster-certs": SERVICE,
    "driveby identify recordings --site site.toml --scheduler tcp://127.0.0.1:8786 "
    "--into identified": CLUSTER,
    "driveby identify recordings --site site.toml --scheduler tls://127.0.0.1:8786 "
    "--tls cluster-certs/client --into identified": CLUSTER,
    "pytest tests/faults/test_cluster.py": ITSELF,
    'pip install -e ".[opensees]"': NETWORK,
    "python -m tests.benchmarks.cluster_scale --crossings 2000": LONG,
    "python -m studies.scripts.linearised_errors --kind three-elements --crossings 25": LONG,
    "python -m studies.scripts.local_minima": LONG,
    "python -m studies.scripts.local_minima --site studies/scripts/lorry_24_m.toml "
    "--crossings 25": LONG,
    "driveby validate --site studies/scripts/lorry_24_m.toml": CERTIFIES,
    "make install": "installs what this test runs in; .ci/run begins with it",
    "make demo": "tests/process_replay/test_demo.py runs the command of the target",
    "make test": ITSELF,
    "make test-all": ITSELF,
    "make faults": ITSELF,
    "make soak": LONG,
    "make day": LONG,
    "make validate": LONG,
    "driveby identify monday.mcap tuesday.mcap --json week.json": FUSES,
    "driveby fuse week.json lastweek.json --json both.json": FUSES,
    "driveby fuse both.json --baseline lastyear.json": FUSES,
    "pytest tests/numerics/test_fusion.py": ITSELF,
    "driveby validate --method pre --surveys 15": LONG,
    "driveby validate --method pre --surveys 15 --records build/surveys.jsonl": LONG,
    "driveby validate --method pre --surveys 3 --kinds scenario-1,scenario-4,scenario-10 "
    "--records build/detection.jsonl": LONG,
    "driveby validate --site site.toml": CERTIFIES,
    "driveby validate --site site.toml --validations recordings/certificates": CERTIFIES,
    "driveby health worker": "asks a worker; tests/process_replay does, of one that runs",
    "driveby survey --site SITE": "one of those above it, of a site of one's own",
    "driveby survey --site site.toml": LONG,
    "driveby survey --site docs/site.example.toml": LONG,
    "driveby survey --site docs/site.example.toml --tyres single --speed 10 --figure survey.png": (
        LONG
    ),
    "python -m tests.survey.achieved 5": LONG,
    "python -m tests.survey.sound 60": LONG,
    "python -m tests.benchmarks.logger_load --trucks 100 --seconds 200 --freeze 8": LONG,
    "python -m pytest tests/faults -m soak -k fifty": LONG,
    "make bench": LONG,
    "make mutants MUTANTS=30 SEED=1": LONG,
    "make up": ENGINE,
    "make down": ENGINE,
    "make containers": ITSELF,
    "make docs": "needs a network the first time; tests/contract/test_site.py builds the site",
    'pip install "WHEEL[identify,view,notebook]"': NETWORK,
    "pip install WHEEL": NETWORK,
    'pip install "WHEEL[identify,view]"': NETWORK,
    'pip install "WHEEL[all]"': NETWORK,
    'pip install "arviz<1"': NETWORK,
    "driveby view crossing.rrd": WINDOW,
    f"driveby view {SAMPLE}": WINDOW,
    "driveby logger --realm sim-first --site docs/site.example.toml": FOUR,
    "driveby worker --realm sim-first --site docs/site.example.toml": FOUR,
    "driveby watch --realm sim-first": FOUR,
    "driveby truck recordings/sample/crossing.mcap --realm sim-first": FOUR,
    "driveby view live --site site.toml": WINDOW,
    "driveby logger --realm '*'": SERVICE,
    "driveby logger --realm 'replay-*'": SERVICE,
    "driveby worker --site site.toml": SERVICE,
    "driveby worker --realm replay-drive --site docs/site.example.toml": SERVICE,
    "driveby replay drive.mcap": SERVICE,
    f"driveby replay {SAMPLE} --speed 4": SERVICE,
    "driveby truck drive.mcap --spool spool/truck-1": SERVICE,
    "driveby gateway ros2 --ros tcp/127.0.0.1:7447 --endpoint tcp/office:7447 --site site.toml "
    "--spool spool/truck-1": SERVICE,
    "driveby import DRIVE --site site.toml -o drive.mcap": (
        "needs a recording of ROS 2; tests/unit/drives/test_ros2_recording.py writes some"
    ),
    "python -m tests.benchmarks.ros2_rate": "measures; its figure is of one machine",
    "driveby truck FOLDER --site site.toml --spool spool/truck-1": SERVICE,
    "python docs/examples/decode_estimate.py recordings/replay-drive/results-TIME.mcap": (
        "its file has another name each time; tests/contract/test_site.py runs the example"
    ),
    "driveby logger --listen tls/0.0.0.0:7447 --tls certs/logger --site site.toml": MACHINES,
    "driveby worker --endpoint tls/logger.example.org:7447 --tls certs/worker --site site.toml": (
        MACHINES
    ),
    "driveby truck run.mcap --endpoint tls/logger.example.org:7447 --tls tls": MACHINES,
    "scp -rp certs/truck-1 truck-1.example.org:tls": MACHINES,
    "scp -rp certs/viewer laptop.example.org:tls": MACHINES,
    "driveby validate --json validation.json --figures figures/": LONG,
    "make validate WORLDS=48": LONG,
    "driveby validate --method pre --crossings 200 --control 20 --out-of-model 48 "
    "--page docs/validation.md": LONG,
    "driveby simulate --scenario 6 --road A --seed 3 --noise 10 --road-surface --tyres twin "
    "--rear-offset 0.005 --wander 0.12 --runs 4 --gps-noise -o twin.mcap": LONG,
    "driveby identify twin.mcap": LONG,
    "driveby report drive.json -o report.html --pdf": (
        "needs a browser; tests/unit/report prints where there is one"
    ),
    "python tests/numerics/table.py": LONG,
    "python -m studies.scripts.reproduction frequencies": LONG,
    "python -m studies.scripts.pavement --crossings 4": LONG,
    "python -m studies.scripts.pavement --crossings 2 --decks 2.5 --joints 15 --anisotropy 3.5": (
        LONG
    ),
    "python -m studies.scripts.pavement --search --crossings 1 --decks 2.5": LONG,
    "python -m studies.scripts.tandems --kinds loaded aside unequal --crossings 40 "
    "--records build/tandems.jsonl": LONG,
    "python -m pytest -m slow tests/studies/test_validation.py": LONG,
    "python -m tests.verdicts.measure": LONG,
    "python -m tests.verdicts.measure signals 300": LONG,
    "python -m tests.verdicts.measure sound 14": LONG,
    "pytest tests/verdicts -m slow": LONG,
    "pytest tests/verdicts/test_foreign_vehicle.py -m slow": LONG,
    "pytest tests/verdicts/test_as_they_are.py -m slow": LONG,
    "pytest tests/verdicts/test_width.py -m slow": LONG,
    "python -m tests.verdicts.width wide 64": LONG,
    "python -m tests.verdicts.width more-axles 16": LONG,
    "python -m tests.benchmarks.detection": LONG,
    "python -m tests.benchmarks.worker_load --seconds 60": LONG,
    "driveby view live --listen ADDRESS": "is for an address of this machine; tests/unit/viewer",
    "pytest tests/numerics/test_pre_posterior.py -k rows_up": ITSELF,
    "pytest tests/faults/test_security.py -m faults -k noise -s": LONG,
    "python -m tests.mutants.run --help": "tests/mutants/test_mutants.py reads its options",
    "python -m tests.benchmarks.logger_load": LONG,
    "python -m tests.benchmarks.logger_load --trucks 100 --seconds 300": LONG,
    "python -m tests.benchmarks.replay_speed": LONG,
    "python -m tests.benchmarks.view": LONG,
    "python -m tests.screenshots": "tests/unit/viewer/test_screenshots.py takes them",
}

ALTERNATIVES = {"logger.md"}
"""Pages whose commands are no sequence: each runs by itself."""
_PROGRAMS = r"(?:driveby|make|python|pip|pytest|scp)"
_COMMENT = re.compile(r"\s+#.*$|\s*&$")


def normal(line: str) -> str:
    """A command without comment, `&` and the folder of the environment."""
    return _COMMENT.sub("", line).strip().removeprefix(".venv/bin/").rstrip("&").strip()


def commands_of(page: Path) -> list[str]:
    """In their order, each once: blocks of shell, indented ones, and those in a sentence.

    The bare name of a subcommand in a sentence is no command, but a name.
    """
    found = []
    text = page.read_text()
    for block in re.finditer(r"```(\w*)\n(.*?)```", text, re.DOTALL):
        if block[1] == "sh":
            found += [(block.start(2) + n, line) for n, line in enumerate(block[2].splitlines())]
    prose = re.sub(r"```.*?```", lambda m: " " * len(m[0]), text, flags=re.DOTALL)
    for pattern in (rf"^    +((?:\.venv/bin/)?{_PROGRAMS} .*)$", rf"`({_PROGRAMS} [^`\n]+)`"):
        found += [(m.start(1), m[1]) for m in re.finditer(pattern, prose, re.MULTILINE)]
    ordered = [normal(line) for _, line in sorted(found)]
    return list(dict.fromkeys(c for c in ordered if c and not is_a_name(c)))


def is_a_name(command: str) -> bool:
    """`driveby view`, `driveby simulate --road-surface`: what is spoken of and not meant to run."""
    return bool(re.fullmatch(r"driveby (--help|[a-z]+( --[a-z-]+)?)", command))


def runnable(page: Path) -> list[str]:
    if page.name == OF_ENGINE:
        return []
    return [command for command in commands_of(page) if command not in NOT_RUN]


def test_what_is_listed_stands_on_a_page() -> None:
    everywhere = {command for page in PAGES for command in commands_of(page)}
    assert len(everywhere) > 60
    assert set(NOT_RUN) - everywhere == set()


def test_what_is_not_listed_can_be_run_here() -> None:
    for page in PAGES:
        for command in runnable(page):
            assert command.startswith("driveby "), f"{command}: list it in NOT_RUN, or run it"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_would_be_taken(page: Path) -> None:
    rules = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for command in commands_of(page):
        program, *arguments = shlex.split(command)
        match program:
            case "driveby":
                cli._parser().parse_args(arguments)
            case "make":
                assert arguments[0] in rules, command
            case "python" if arguments[0] == "-m":
                assert importlib.util.find_spec(arguments[1]) is not None, command
            case "python":
                assert (ROOT / arguments[0]).is_file(), command
            case "pytest":
                assert (ROOT / arguments[0]).exists(), command


def marked() -> Iterator[object]:
    for page in PAGES:
        commands = runnable(page)
        if commands:
            marks = [] if page.name == "README.md" else [pytest.mark.slow]
            each = [[one] for one in commands] if page.name in ALTERNATIVES else [commands]
            for number, some in enumerate(each, start=1):
                yield pytest.param(some, marks=marks, id=f"{page.name}-{number}")


@pytest.mark.parametrize("commands", list(marked()))
def test_the_other_commands_run_in_the_order_of_the_page(
    commands: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where somebody has what the page speaks of: a checkout, a drive, its results."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "recordings/sample", "recordings/sample")
    shutil.copytree(ROOT / "docs", "docs", ignore=shutil.ignore_patterns("images"))
    assert cli.main(["export", SAMPLE, "--to", "FOLDER"]) == 0
    shutil.copy("FOLDER/site.toml", "site.toml")
    made = {word for c in commands for flag, word in pairs(c) if flag in ("-o", "--json")}
    if "drive.mcap" not in made:
        shutil.copy(SAMPLE, "drive.mcap")
    if "drive.json" not in made and any("drive.json" in command for command in commands):
        quick = ["identify", "drive.mcap", "--method", "least-squares", "--json", "drive.json"]
        assert cli.main(quick) == 0
    for command in commands:
        code = cli.main(shlex.split(command)[1:])
        assert code == 0, command
        for flag, word in pairs(command):
            if flag in ("-o", "--json", "--rrd", "--draws", "--to", "--figures", "--csv"):
                assert word.startswith("-") or Path(word).exists(), command


def pairs(command: str) -> list[tuple[str, str]]:
    return list(pairwise(shlex.split(command)))
