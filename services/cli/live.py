"""Commands on the bus: demo, logger, worker, truck, gateway, health."""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from services.cli.parsing import (
    a_console,
    add_certificates,
    add_endpoint,
    add_folder,
    add_id,
    add_method,
    add_noise,
    add_output_file,
    add_output_folder,
    add_realm,
    add_site,
    add_speed,
    add_tls,
    command,
)
from services.common.endpoints import DEFAULT_ENDPOINT, default_endpoint
from services.common.errors import InputError
from services.common.options import number, whole


def add_demo(commands: Any) -> None:
    """Add `driveby demo`: simulate, publish, record, identify and draw one crossing."""
    p = command(
        commands,
        "demo",
        _demo,
        "simulate, publish, record, identify and draw one crossing",
        "driveby demo --speed 4",
    )
    add_output_folder(p, "--out", "new folder for the outputs")
    add_speed(p, 4.0)
    text = "accelerometers' noise density in µg/√Hz; 0: all exact, least squares (default: 25)"
    add_noise(p, text, 25.0)
    p.add_argument("--live", action="store_true", help="show it live in the viewer")
    p.add_argument("--web", action="store_true", help="show it live in the browser")


def _demo(options: argparse.Namespace) -> int:
    from services.cli.demo import demo_command

    return demo_command(
        out=options.out,
        speed=options.speed,
        noise=options.noise,
        console=a_console(),
        live="web" if options.web else "window" if options.live else None,
    )


def add_logger(commands: Any) -> None:
    """Add `driveby logger`: record all messages of a realm and host the bus router."""
    p = command(
        commands,
        "logger",
        _logger,
        "record all messages of a realm and host the bus router",
        f"driveby logger --listen {DEFAULT_ENDPOINT} --folder recordings --site site.toml",
    )
    p.add_argument("--listen", help=f"address to listen on (default: {DEFAULT_ENDPOINT})")
    add_tls(p)
    p.add_argument(
        "--insecure",
        action="store_true",
        help="listen to other machines without --tls; any session that reaches the address is "
        "accepted",
    )
    add_folder(p, "folder of the recordings")
    add_output_file(p, "--file", "REC.mcap", "single new file for all messages")
    p.add_argument(
        "--realm",
        action="append",
        metavar="REALM",
        help="realm to record, or pattern such as sim-* (*: all); repeatable (default: live)",
    )
    add_site(p, "site file to store in the recordings")
    add_id(p, "logger")
    room = p.add_argument_group("files and room")
    room.add_argument(
        "--rotate-minutes",
        type=number("minutes", low=0.01, high=1e6),
        default=15.0,
        metavar="MIN",
        help="start a truck's next file after this many minutes (default: 15; SIGUSR1: at once)",
    )
    room.add_argument(
        "--rotate-mb",
        type=number("a size in MB", low=0.1, high=1e6),
        default=1000.0,
        metavar="MB",
        help="start a new file at this size in MB (default: 1000)",
    )
    room.add_argument(
        "--min-free",
        type=number("a size in MB", low=0, high=1e9),
        default=500.0,
        metavar="MB",
        help="minimum free disk space in MB; recording stops at one eighth of it (default: 500)",
    )
    room.add_argument(
        "--budget",
        type=number("a size in MB", low=1, high=1e9),
        metavar="MB",
        help="limit of disk space for recordings; the oldest whose crossings are all identified "
        "are deleted beyond it (default: delete nothing)",
    )


def _logger(options: argparse.Namespace) -> int:
    from services.logger.run import run
    from services.logger.settings import LoggerSettings
    from services.logger.writer import RotationLimits

    listen = options.listen or default_endpoint(options.tls)
    asked = LoggerSettings(
        listen=listen,
        folder=options.folder,
        file=options.file,
        realms=options.realm or ("live",),
        site=options.site,
        service_id=options.id,
        tls=options.tls,
        insecure=options.insecure,
        limits=RotationLimits(
            age_s=options.rotate_minutes * 60.0,
            bytes=round(options.rotate_mb * 1e6),
            min_free_bytes=round(options.min_free * 1e6),
        ),
        budget_bytes=None if options.budget is None else round(options.budget * 1e6),
    )
    return run(asked, _announced(options, f"ready, listening at {listen}"))


def add_worker(commands: Any) -> None:
    """Add `driveby worker`: identify crossings as they happen and publish the results."""
    p = command(
        commands,
        "worker",
        _worker,
        "identify crossings as they happen and publish the results",
        "driveby worker --site site.toml",
    )
    add_endpoint(p)
    add_realm(p)
    add_site(p, "trucks and bridges", required=True)
    add_folder(p, "folder of the results")
    text = "single new file for the results (and .json)"
    add_output_file(p, "--file", "RESULTS.mcap", text)
    add_method(p)
    p.add_argument(
        "--processes",
        type=whole("processes", 1, 256),
        default=1,
        metavar="N",
        help="number of crossings identified at once, in addition to the listening process "
        "(default: 1)",
    )
    p.add_argument(
        "--cpu-limit",
        type=number("seconds", low=1, high=1e6),
        metavar="S",
        help="CPU time limit per crossing in s; on excess the crossing is retried once (default: "
        "900)",
    )
    add_id(p, "worker")
    first = p.add_mutually_exclusive_group()
    first.add_argument(
        "--validate-first",
        action="store_true",
        help="identify only truck and bridge pairs that have passed a site validation by "
        "simulation (always so in realm live)",
    )
    first.add_argument(
        "--skip-validation",
        action="store_true",
        help="identify in realm live without site validation",
    )
    add_certificates(p, "folder of certificates (default: certificates in --folder)")
    p.add_argument(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="folder of the logger's recordings, for crossings that trucks no longer send "
        "(default: --folder)",
    )
    p.add_argument(
        "--recordings-days",
        type=number("days", low=0, high=3650),
        metavar="DAYS",
        help="age in days of the oldest recordings to catch up from (default: 2; 0: none)",
    )


def _worker(options: argparse.Namespace) -> int:
    from services.worker.run import run
    from services.worker.settings import WorkerSettings

    usual = WorkerSettings
    asked = WorkerSettings(
        endpoint=options.endpoint or default_endpoint(options.tls),
        realm=options.realm,
        site=options.site,
        folder=options.folder,
        file=options.file,
        method=options.method.replace("-", "_"),
        service_id=options.id,
        tls=options.tls,
        processes=options.processes,
        limit_s=usual.limit_s if options.cpu_limit is None else options.cpu_limit,
        certificates=options.validations,
        recordings=options.recordings,
        recordings_days=(
            usual.recordings_days if options.recordings_days is None else options.recordings_days
        ),
        validate=True if options.validate_first else False if options.skip_validation else None,
    )
    line = f"ready, waiting for crossings in realm {options.realm}"
    return run(asked, _announced(options, line))


def add_truck(commands: Any) -> None:
    """Add `driveby truck`: publish a recording as a truck that drives now."""
    p = command(
        commands,
        "truck",
        _truck,
        "publish a recording as a truck that drives now",
        "driveby truck run.mcap --speed 4",
    )
    p.add_argument(
        "recording",
        type=Path,
        metavar="REC.mcap | DIR",
        help="measurements to publish: a recording, or a folder of CSV files with --site",
    )
    add_site(p, "site file for a folder of CSV files (a recording carries its own)")
    _add_spool(p)
    add_endpoint(p)
    add_realm(p)
    add_speed(p, 1.0)
    p.add_argument(
        "--skip-gaps",
        action="store_true",
        help="skip gaps of more than 2 s, as between runs",
    )
    p.add_argument(
        "--vehicle",
        metavar="ID",
        help="identifier of the vehicle to publish, where there are several",
    )


def _add_spool(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--spool",
        type=Path,
        metavar="DIR",
        help="folder that keeps every message until a logger has it; one for each truck",
    )
    p.add_argument(
        "--spool-budget",
        type=whole("MiB", 1, 1 << 30),
        default=4096,
        metavar="MIB",
        help="size limit of the spool in MiB; beyond it the oldest messages are dropped (default: "
        "4096)",
    )


def _truck(options: argparse.Namespace) -> int:
    from services.truck.run import run
    from services.truck.settings import TruckSettings

    return run(
        TruckSettings(
            recording=options.recording,
            endpoint=options.endpoint or default_endpoint(options.tls),
            realm=options.realm,
            speed=options.speed,
            vehicle=options.vehicle,
            tls=options.tls,
            spool=options.spool,
            spool_budget_bytes=options.spool_budget << 20,
            site=options.site,
            skip_gaps=options.skip_gaps,
        )
    )


def add_gateway(commands: Any) -> None:
    """Add `driveby gateway`: publish the data of a ROS 2 truck on the bus."""
    p = command(
        commands,
        "gateway",
        _gateway,
        "publish the data of a ROS 2 truck on the bus",
        "driveby gateway ros2 --ros tcp/127.0.0.1:7447 --endpoint tcp/office:7447 --site site.toml",
    )
    p.add_argument("what", choices=("ros2",), help="ros2: with rmw_zenoh, see docs/truck.md")
    p.add_argument(
        "--ros",
        required=True,
        metavar="ENDPOINT",
        help="address of rmw_zenoh's router, e.g. tcp/127.0.0.1:7447",
    )
    add_site(p, "site file of the truck, with its topics in [ros2]", required=True)
    p.add_argument("--vehicle", metavar="ID", help="identifier of the site's vehicle")
    _add_spool(p)
    add_endpoint(p)
    add_realm(p)


def _gateway(options: argparse.Namespace) -> int:
    from services.truck.ros2 import run
    from services.truck.settings import GatewaySettings

    asked = GatewaySettings(
        ros=options.ros,
        endpoint=options.endpoint or default_endpoint(options.tls),
        realm=options.realm,
        site=options.site,
        vehicle=options.vehicle,
        tls=options.tls,
        spool=options.spool,
        spool_budget_bytes=options.spool_budget << 20,
    )
    return run(asked, _announced(options, f"ready, listening to ROS 2 at {options.ros}"))


def add_health(commands: Any) -> None:
    """Add `driveby health`: query the health of a logger or worker over the bus."""
    p = command(
        commands,
        "health",
        _health,
        "query the health of a logger or worker over the bus",
        "driveby health logger",
    )
    p.add_argument(
        "service",
        nargs="?",
        metavar="ID",
        help="the service's --id, such as logger or worker; with --metrics all without it",
    )
    p.add_argument(
        "--metrics", action="store_true", help="print all figures in the format of Prometheus"
    )
    p.add_argument(
        "--serve",
        type=_address,
        metavar="[HOST:]PORT",
        help="with --metrics: HTTP address that answers /metrics until a signal (default host: "
        "127.0.0.1)",
    )
    add_endpoint(p)
    add_realm(p)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not (port.isdecimal() and int(port) < 65536):
        raise argparse.ArgumentTypeError(f"{text!r}: a port or HOST:PORT is expected, e.g. 9464")
    return host.strip("[]") or "127.0.0.1", int(port)


def _health(options: argparse.Namespace) -> int:
    asked: dict[str, Any] = {
        "service": options.service,
        "endpoint": options.endpoint or default_endpoint(options.tls),
        "tls": options.tls,
        "realm": options.realm,
    }
    if options.metrics:
        from services.cli.metrics import metrics_command, serve_metrics

        if options.serve is None:
            print(metrics_command(**asked), end="")
        else:

            def ready(url: str) -> None:
                _announced(options, f"ready, metrics at {url}")()

            serve_metrics(**asked, address=options.serve, ready=ready)
        return 0
    if options.serve is not None:
        raise InputError("--serve needs --metrics")
    if options.service is None:
        raise InputError("name the service, such as logger or worker; --metrics needs none")
    from services.cli.health import health_command

    print(health_command(**asked))
    return 0


def _announced(options: argparse.Namespace, line: str) -> Callable[[], None]:
    """Return a function that prints that a service is ready, in the form of its log."""
    if options.log_format != "json":
        return partial(print, line, flush=True)

    def announce() -> None:
        record = {"time": time.time(), "level": "info", "logger": "driveby", "message": line}
        print(json.dumps(record | subject_of(options)), flush=True)

    return announce


def subject_of(options: argparse.Namespace) -> dict[str, str]:
    """Return the fields of a log that hold for all lines of a process (`SUBJECT_FIELDS`)."""
    given = {"service": "id", "realm": "realm", "vehicle": "vehicle"}
    found = {name: getattr(options, option, None) for name, option in given.items()}
    return {name: value for name, value in found.items() if isinstance(value, str)}


SERVICES: Final = (_logger, _worker, _truck, _gateway)
"""Handlers that run until they are stopped, and whose log is their only output."""
