"""compose.yaml is what the Compose specification allows and keeps its own promises.

No container engine is needed: what the services do is in tests/process_replay/test_compose.py.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from distributed.cli import dask_scheduler, dask_worker

from services.cli import main as cli
from tests.builders.compose_file import with_defaults

ROOT = Path(__file__).parents[2]
COMPOSE = yaml.safe_load(with_defaults((ROOT / "compose.yaml").read_text()))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
LASTING = ("router", "logger", "worker")
OF_DASK = ("scheduler", "cluster-worker-1", "cluster-worker-2")
VERSIONS = ROOT / "docs" / "scripts" / "container_versions.py"


def schema() -> dict[str, Any]:
    text = (ROOT / "tests" / "data" / "compose" / "compose-spec.json").read_text()
    found: dict[str, Any] = json.loads(text)
    return found


def test_the_file_is_what_the_specification_allows() -> None:
    jsonschema.Draft7Validator(schema()).validate(COMPOSE)


@pytest.mark.parametrize(
    ("service", "key", "value"),
    [("worker", "stop_grace", "60s"), ("logger", "read_only", "maybe"), ("truck", "cap_drop", 3)],
)
def test_the_specification_refuses_what_is_wrong(service: str, key: str, value: object) -> None:
    wrong = json.loads(json.dumps(COMPOSE))
    wrong["services"][service][key] = value
    if key == "read_only":
        wrong["services"][service][key] = [value]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft7Validator(schema()).validate(wrong)


@pytest.mark.parametrize("name", SERVICES)
def test_every_container_is_confined(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert re.fullmatch(r"\d+[mg]", service["mem_limit"])
    assert service.get("privileged") is None


@pytest.mark.parametrize("name", SERVICES)
def test_everything_waits_for_health_and_not_for_a_start(name: str) -> None:
    waits = SERVICES[name].get("depends_on", {})
    assert isinstance(waits, dict)
    for other, how in waits.items():
        if other in LASTING:
            reads_rules = (name, other) == ("router", "logger")
            restart = {"restart": True} if reads_rules else {}
            assert how == {"condition": "service_healthy", **restart}
            assert "healthcheck" in SERVICES[other]
        else:
            assert how == {"condition": "service_completed_successfully"}
            assert SERVICES[other]["restart"] == "no"
    if name == "truck":
        assert set(waits) == {*LASTING, "simulation"}


def test_what_is_stopped_has_the_time_to_finish() -> None:
    def seconds(name: str) -> int:
        return int(SERVICES[name]["stop_grace_period"].removesuffix("s"))

    assert seconds("worker") >= 60
    assert seconds("logger") >= 30
    assert seconds("truck") > 30  # so long it waits for the logger


@pytest.mark.parametrize("name", ["logger", "worker"])
def test_checks_ask_the_service_itself_in_its_own_realm(name: str) -> None:
    check = SERVICES[name]["healthcheck"]["test"]
    assert check[:3] == ["CMD", "driveby", "health"]
    options = cli._parser().parse_args(check[2:])
    assert options.service == name
    output = cli._parser().parse_args(SERVICES[name]["command"])
    assert output.realm in (options.realm, [options.realm])  # a logger may have several
    assert options.tls == output.tls


def test_what_the_truck_says_is_recorded_and_identified() -> None:
    output = {n: cli._parser().parse_args(SERVICES[n]["command"]) for n in ("truck", "worker")}
    logger = cli._parser().parse_args(SERVICES["logger"]["command"])
    assert logger.realm == [output["truck"].realm] == [output["worker"].realm]


def test_it_comes_up_a_second_time() -> None:
    """The volume keeps the recording of the first; without --force that is bad input."""
    assert cli._parser().parse_args(SERVICES["simulation"]["command"]).force


@pytest.mark.parametrize("name", [n for n in SERVICES if n not in ("router", *OF_DASK)])
def test_every_command_is_one_of_ours(name: str) -> None:
    cli._parser().parse_args(SERVICES[name]["command"])


@pytest.mark.parametrize("name", OF_DASK)
def test_dask_takes_the_others_and_they_ask_for_certificates(name: str, tmp_path: Path) -> None:
    program, which, *arguments = SERVICES[name]["command"]
    assert program == "dask"
    for file in ("ca", "cert", "key"):
        (tmp_path / f"{file}.pem").touch()
    here = [argument.replace("/etc/driveby/tls", str(tmp_path)) for argument in arguments]
    command = {"scheduler": dask_scheduler.main, "worker": dask_worker.main}[which]
    options = command.make_context(which, here).params
    for option, file in (("tls_ca_file", "ca"), ("tls_cert", "cert"), ("tls_key", "key")):
        assert options[option] == str(tmp_path / f"{file}.pem")
    assert options["dashboard_address"] == "127.0.0.1:0"
    if which == "worker":
        assert options["scheduler"] == "tls://scheduler:8786"
        assert options["nanny"] is False
        assert 'case $1 in dask | python) exec "$@"' in (ROOT / "entrypoint.sh").read_text()


def test_the_client_of_the_cluster_finds_its_scheduler() -> None:
    options = cli._parser().parse_args(SERVICES["client"]["command"])
    assert options.scheduler == "tls://scheduler:8786"
    assert str(options.tls) == "/etc/driveby/tls"


def test_only_loopback_is_published() -> None:
    ports = [port for service in SERVICES.values() for port in service.get("ports", [])]
    assert ports == ["127.0.0.1:7447:7447", "127.0.0.1:9464:9464"]


def test_the_image_is_built_of_what_is_pinned_by_hash() -> None:
    steps = re.findall(r"^(?:RUN|    &&).* (pip .*(?:\\\n.*)*)$", DOCKERFILE, re.MULTILINE)
    assert len(steps) == 7
    for step in steps:
        assert ("--require-hashes" in step) != ("--no-index" in step)
        assert ("--no-build-isolation" in step) == (" wheel " in step)
    assert "-r requirements/build.txt" in DOCKERFILE
    build = (ROOT / "requirements" / "build.txt").read_text()
    assert re.match(r"setuptools==[\d.]+ \\\n    --hash=sha256:", build)
    copies = [line.split()[1:-1] for line in DOCKERFILE.splitlines() if line.startswith("COPY")]
    copied = {source for sources in copies for source in sources}
    copied = {source for source in copied if not source.startswith(("-", "/"))}
    assert {"setup.py", "driveby", "entrypoint.sh"} <= copied
    allowed = set(re.findall(r"^!(\S+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE))
    assert copied <= allowed


def test_the_image_compiles_its_kernels_where_the_entrypoint_looks() -> None:
    for room in ("execution", "simulation"):
        step = f"python -m driveby.services.{room}.warm_up --strict"
        assert f" NUMBA_CACHE_DIR=/app/kernels /app/entrypoint.sh {step}" in DOCKERFILE
    entrypoint = (ROOT / "entrypoint.sh").read_text()
    assert "${KERNELS:-/app/kernels}" in entrypoint
    cache = re.search(r"NUMBA_CACHE_DIR=(/tmp/\S+)", DOCKERFILE)
    assert cache is not None  # on the tmpfs, for the rest cannot be written
    assert all(
        any(place.startswith(cache[1].split("kernels")[0][:-1]) for place in service["tmpfs"])
        for service in SERVICES.values()
    )
    assert os.access(ROOT / "entrypoint.sh", os.X_OK)


def pinned(name: str) -> set[str]:
    text = (ROOT / "requirements" / f"{name}.txt").read_text()
    return set(re.findall(r"^[a-z].*?(?= \\$)", text, re.MULTILINE))


def test_the_truck_has_the_versions_of_the_others_and_nothing_that_draws() -> None:
    assert pinned("truck") < pinned("service") < pinned("runtime")
    names = {line.split("==")[0] for line in pinned("truck")}
    assert names.isdisjoint({"rerun-sdk", "duckdb", "matplotlib", "pyarrow", "scipy", "numba"})


def test_the_service_has_all_extras_but_those_that_draw() -> None:
    left_out = {line.split("==")[0] for line in pinned("runtime") - pinned("service")}
    assert {"rerun-sdk", "matplotlib", "pandas", "xarray"} <= left_out
    assert left_out.isdisjoint({"numba", "duckdb", "pyarrow", "s3fs", "rosbags", "distributed"})


def test_trucks_meet_the_router_only() -> None:
    on = {name: set(service["networks"]) for name, service in SERVICES.items()}
    assert {name for name in on if on["truck"] & on[name]} == {"truck", "router"}
    assert [n for n, network in COMPOSE["networks"].items() if not (network or {}).get("internal")]
    assert {name for name in on if "outside" in on[name]} == {"router", "metrics"}


@pytest.mark.parametrize("name", SERVICES)
def test_logs_are_bounded(name: str) -> None:
    assert SERVICES[name]["logging"]["options"] == {"max-size": "10m", "max-file": "3"}


def test_ours_are_never_fetched_from_a_registry() -> None:
    ours = {name: s for name, s in SERVICES.items() if s["image"].startswith("driveby")}
    assert set(SERVICES) - set(ours) == {"router"}
    assert all(service["pull_policy"] == "never" for service in ours.values())
    built = {ours[name]["image"] for name in ours if "build" in ours[name]}
    assert built == {service["image"] for service in ours.values()}


@pytest.mark.parametrize("features", ["avx2 fma bmi2", "avx2 fma", "asimd"])
def test_kernels_are_for_a_kind_of_processor_where_it_is_one(features: str, tmp_path: Path) -> None:
    """`grep` in place of the processor's own features."""
    program = tmp_path / "grep"
    program.write_text(f'#!/bin/sh\ncase " {features} " in *" $2 "*) exit 0 ;; esac\nexit 1\n')
    program.chmod(0o755)
    done = subprocess.run(
        [ROOT / "entrypoint.sh", "python", "-c", "import os; print(os.getenv('NUMBA_CPU_NAME'))"],
        env={
            "PATH": f"{tmp_path}:{Path(sys.executable).parent}:/usr/bin:/bin",
            "NUMBA_CACHE_DIR": str(tmp_path / "kernels"),
            "KERNELS": str(tmp_path / "none"),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == ("x86-64-v3" if "bmi2" in features else "None")


def a_docker(folder: Path, engine: str, compose: str, code: int = 0) -> Path:
    program = folder / "docker"
    program.write_text(
        f'#!/bin/sh\n[ "$1" = compose ] && echo "{compose}" || echo "{engine}"\nexit {code}\n'
    )
    program.chmod(0o755)
    return folder


def checked(path: Path) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, VERSIONS],
        env={"PATH": f"{path}:/bin:/usr/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("engine", "compose", "output"),
    [
        ("26.0.0", "2.26.0", ""),
        ("27.3.1+1", "v2.30.3-desktop.1", ""),
        ("100.0", "10.1", ""),
        ("25.0.5", "2.26.0", "Docker Engine 26.0 or newer is needed, this is 25.0.5\n"),
        ("26.0.0", "2.9.1", "Docker Compose 2.26 or newer is needed, this is 2.9.1\n"),
        ("26.0.0", "1.29.2", "Docker Compose 2.26 or newer is needed, this is 1.29.2\n"),
        ("", "2.26.0", "says: nothing\n"),
    ],
)
def test_too_old_version_gives_one_line(
    tmp_path: Path, engine: str, compose: str, output: str
) -> None:
    code, line = checked(a_docker(tmp_path, engine, compose))
    assert code == (1 if output else 0)
    assert line.endswith(output)
    assert line.count("\n") == bool(output)


def test_an_engine_that_does_not_run_or_is_not_there_is_one_line(tmp_path: Path) -> None:
    code, line = checked(a_docker(tmp_path, "Cannot connect to the Docker daemon", "2.26.0", 1))
    assert (code, line.count("\n")) == (1, 1)
    assert "Cannot connect to the Docker daemon" in line
    empty = tmp_path / "empty"
    empty.mkdir()
    done = subprocess.run(
        [sys.executable, VERSIONS], env={"PATH": str(empty)}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "there is no program docker" in done.stderr


def test_make_up_looks_at_the_versions_first() -> None:
    recipe = (ROOT / "Makefile").read_text().split("\nup:")[1].split("\n\n")[0].splitlines()[1:]
    assert "container_versions.py" in recipe[0]
    needed = re.search(
        r"Engine (\d+\.\d+) and Compose (\d+\.\d+)", (ROOT / "compose.yaml").read_text()
    )
    assert needed is not None
    assert f"({needed[1].replace('.', ', ')})" in VERSIONS.read_text()
    assert f"({needed[2].replace('.', ', ')})" in VERSIONS.read_text()
