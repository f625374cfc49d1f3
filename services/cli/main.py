"""The command `driveby`: reads the arguments, calls one function, turns errors into exit codes.

0 it worked, 1 it failed, 2 the input was bad; 3 of `recover`: it worked, but something is lost.
The functions are imported when they are called, so that `driveby --help` does not wait for
compilers and viewers.
"""

import argparse
import json
import logging
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn

from services.common.errors import FailureError, InputError

if TYPE_CHECKING:
    from rich.console import Console

ENDPOINT: Final = "tcp/127.0.0.1:7447"
TLS_ENDPOINT: Final = "tls/127.0.0.1:7447"
RECORDINGS: Final = Path("recordings")
METHODS: Final = ("pre", "least-squares", "random-walk")
SCENARIOS: Final = range(1, 13)

EXIT_FAILED: Final = 1
EXIT_BAD_INPUT: Final = 2
EXIT_INTERRUPTED: Final = 130
EXIT_BROKEN_PIPE: Final = 141

Handler = Callable[[argparse.Namespace], int]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    # Our matrices are small: threads that wait for each other at every column cost up to fifty
    # times the work itself when other processes want the cores too.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        options = _parser().parse_args(arguments)
    except InputError as error:
        return _say(str(error), EXIT_BAD_INPUT)
    # A service has nothing else to show for itself than what it says.
    _log(options.log_format, verbose=options.verbose or options.handler in _SERVICES)
    handler: Handler = options.handler
    try:
        code = handler(options)
        sys.stdout.flush()
    except InputError as error:
        return _say(str(error), EXIT_BAD_INPUT)
    except FailureError as error:
        return _say(str(error), EXIT_FAILED)
    except KeyboardInterrupt:
        return _say("interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output has gone; Python would complain again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except Exception as error:
        if options.debug:
            traceback.print_exc()
        what = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        hint = "" if options.debug else "; run with --debug for the traceback"
        return _say(f"internal error, please report: {what}{hint}", EXIT_FAILED)
    return code


def _simulate(options: argparse.Namespace) -> int:
    from services.simulation.drive import simulate_command

    return simulate_command(
        site=options.site,
        scenario=options.scenario,
        ei=options.ei,
        road=options.road,
        seed=options.seed,
        noise=options.noise,
        speed=options.speed,
        direction=options.direction,
        gps_noise=options.gps_noise,
        rate=options.rate,
        output=options.output,
        force=options.force,
        console=_console(),
    )


def _import(options: argparse.Namespace) -> int:
    from services.drives.importing import import_command

    print(
        import_command(
            sources=options.sources,
            site=options.site,
            output=options.output,
            force=options.force,
            vehicle=options.vehicle,
            name=options.name,
        )
    )
    return 0


def _identify(options: argparse.Namespace) -> int:
    from services.cli.identify import identify_command

    return identify_command(
        recordings=options.recordings,
        site=options.site,
        method=options.method.replace("-", "_"),
        json_path=options.json,
        rrd_path=options.rrd,
        draws_path=options.draws,
        seed=options.seed,
        console=_console(),
    )


def _validate(options: argparse.Namespace) -> int:
    if options.method == "pre":
        from services.cli.validate_pre import validate_pre_command

        return validate_pre_command(
            crossings=options.crossings,
            control=options.control,
            scenarios=options.scenarios,
            folder=options.truth,
            site=options.site,
            processes=options.processes,
            json_path=options.json,
            figures=options.figures,
            page=options.page,
            console=_console(),
        )
    from services.cli.validate_paper import validate_command

    return validate_command(
        scenarios=options.scenarios,
        noise=options.noise,
        json_path=options.json,
        figures=options.figures,
        seed=options.seed,
        site=options.site,
        particles=options.particles,
        steps=options.steps,
        console=_console(),
    )


def _recover(options: argparse.Namespace) -> int:
    from services.cli.recover import recover_command

    code, line = recover_command(
        source=options.recording,
        output=options.output,
        set_aside=options.set_aside,
        force=options.force,
        as_json=options.json,
    )
    print(line)
    return code


def _demo(options: argparse.Namespace) -> int:
    from services.cli.demo import demo_command

    return demo_command(
        out=options.out, speed=options.speed, noise=options.noise, console=_console()
    )


def _certs(options: argparse.Namespace) -> int:
    from services.security.certs import certs_command

    lines = certs_command(
        folder=options.folder,
        trucks=options.trucks,
        others=options.add,
        renew=options.renew,
        revoke=options.revoke,
        hosts=options.host,
        days=options.days,
    )
    print("\n".join(lines))
    return 0


def _logger(options: argparse.Namespace) -> int:
    from services import logger
    from services.logger.writer import Limits

    listen = options.listen or _default_endpoint(options)
    return logger.run(
        listen=listen,
        folder=options.folder,
        file=options.file,
        realms=options.realm or ("live",),
        site=options.site,
        service_id=options.id,
        ready=lambda: print(f"ready, listening at {listen}", flush=True),
        tls=options.tls,
        insecure=options.insecure,
        limits=Limits(
            age_s=options.rotate_minutes * 60.0,
            bytes=round(options.rotate_mb * 1e6),
            min_free_bytes=round(options.min_free * 1e6),
        ),
        budget_bytes=None if options.budget is None else round(options.budget * 1e6),
    )


def _worker(options: argparse.Namespace) -> int:
    from services import worker

    return worker.run(
        endpoint=options.endpoint or _default_endpoint(options),
        realm=options.realm,
        site=options.site,
        folder=options.folder,
        file=options.file,
        method=options.method.replace("-", "_"),
        service_id=options.id,
        ready=lambda: print(f"ready, waiting for crossings in realm {options.realm}", flush=True),
        tls=options.tls,
        processes=options.processes,
    )


def _truck(options: argparse.Namespace) -> int:
    from services import truck

    return truck.run(
        recording=options.recording,
        endpoint=options.endpoint or _default_endpoint(options),
        realm=options.realm,
        speed=options.speed,
        vehicle=options.vehicle,
        tls=options.tls,
        spool=options.spool,
        spool_budget_bytes=options.spool_budget << 20,
        site=options.site,
    )


def _replay(options: argparse.Namespace) -> int:
    from services import replay
    from services.common.naming import checked_identifier, identifier_from

    name = options.name
    return replay.run(
        recordings=options.recordings,
        endpoint=options.endpoint or _default_endpoint(options),
        speed=options.speed,
        name=(
            identifier_from(options.recordings[0].stem)
            if name is None
            else checked_identifier(name, "--name")
        ),
        tls=options.tls,
    )


def _view(options: argparse.Namespace) -> int:
    from services.viewer.view import view_command

    return view_command(target=options.target, web=options.web, console=_console())


_SERVICES: Final = (_logger, _worker, _truck, _replay)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="driveby",
        description="Find how stiff every part of a bridge is from a truck that drives over it.",
        epilog="example: driveby simulate --scenario 6 --noise 25 -o run.mcap "
        "&& driveby identify run.mcap",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and leave")
    _add_common(parser, suppressed=False)
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=_Parser)
    _add_offline(commands)
    _add_live(commands)
    return parser


def _add_offline(commands: Any) -> None:
    p = _command(
        commands,
        "simulate",
        _simulate,
        "write the recording of a simulated crossing",
        "driveby simulate --scenario 6 --noise 25 -o run.mcap",
    )
    damage = p.add_mutually_exclusive_group(required=True)
    damage.add_argument(
        "--scenario", type=_scenario, metavar="N", help="damage scenario of the paper, 1 to 12"
    )
    damage.add_argument(
        "--ei",
        type=_ratios,
        metavar="1,1,.4,…",
        help="flexural rigidity of each element as a ratio to the sound value",
    )
    _add_site(p, "truck and bridge (default: those of the paper)")
    p.add_argument(
        "--road", choices=tuple("ABCDE"), default="A", help="ISO 8608 class (default: A)"
    )
    _add_seed(p)
    _add_noise(p, "accelerometers' noise density in µg/√Hz (default: 0)")
    p.add_argument(
        "--speed",
        type=_speed_range,
        default=(10.0, 10.0),
        metavar="M_PER_S",
        help="a speed, or START:END for a change along the way (default: 10)",
    )
    p.add_argument(
        "--direction",
        choices=("start_to_end", "end_to_start"),
        default="start_to_end",
        help="(default: start_to_end)",
    )
    receiver = p.add_mutually_exclusive_group()
    receiver.add_argument(
        "--gps-noise", dest="gps_noise", action="store_true", help="errors of a real receiver"
    )
    receiver.add_argument(
        "--perfect-gps",
        dest="gps_noise",
        action="store_false",
        help="exact positions and speeds (default)",
    )
    p.set_defaults(gps_noise=False)
    p.add_argument(
        "--rate",
        type=_number("a rate in Hz", low=50, high=50_000),
        metavar="HZ",
        help="sampling rate (default: the site's, or 1000)",
    )
    _add_output(p)

    p = _command(
        commands,
        "import",
        _import,
        "turn files of a drive into a recording",
        "driveby import crossings/d1 --site crossings/d1/site.toml -o d1.mcap",
    )
    p.add_argument(
        "sources",
        type=Path,
        nargs="+",
        metavar="DIR | ACCEL.csv GPS.csv",
        help="a folder with accel_NN.csv and gps_NN.csv, one such pair, or a comma2k19 segment",
    )
    _add_site(p, "what was driven, over which bridges; is stored in the recording", required=True)
    p.add_argument("--vehicle", metavar="ID", help="which of the site's vehicles drove")
    p.add_argument("--name", help="realm import-NAME (default: name of the folder)")
    _add_output(p)

    p = _command(
        commands,
        "identify",
        _identify,
        "find the flexural rigidity of each element from recordings",
        "driveby identify run.mcap --json result.json --rrd result.rrd",
    )
    p.add_argument("recordings", type=Path, nargs="+", metavar="REC.mcap", help="recordings")
    _add_site(p, "(default: the site stored in the recording)")
    _add_method(p)
    _add_file(p, "--json", "OUT.json", "write the results here")
    _add_file(p, "--rrd", "OUT.rrd", "write a Rerun recording here")
    _add_file(
        p, "--draws", "OUT.npz|OUT.nc", "write the Markov chains of method pre here, for ArviZ"
    )
    _add_seed(p)

    p = _command(
        commands,
        "validate",
        _validate,
        "identify simulated crossings and compare with the truth and the paper",
        "driveby validate --scenarios 1,6,12 --noise 25 --json validation.json",
    )
    p.add_argument(
        "--scenarios",
        type=_scenarios,
        default=tuple(SCENARIOS),
        metavar="all|1,6,12",
        help="(default: all)",
    )
    _add_noise(p, "accelerometers' noise density in µg/√Hz (default: 0)")
    _add_site(p, "validate this truck and bridge (default: those of the paper)")
    _add_file(p, "--json", "OUT.json", "write the table here")
    p.add_argument("--figures", type=Path, metavar="DIR", help="write figures to this folder")
    p.add_argument("--particles", type=_whole("particles", 1), default=500, help="(default: 500)")
    p.add_argument("--steps", type=_whole("steps", 1), default=600, help="(default: 600)")
    _add_seed(p)
    p.add_argument(
        "--method",
        choices=("paper", "pre"),
        default="paper",
        help="paper: its search and least squares, without sensors; pre: is its uncertainty true "
        "(exit code 1 if an aim is missed; the options below) (default: paper)",
    )
    p.add_argument(
        "--crossings",
        type=_whole("a number of crossings", 0),
        default=200,
        help="whose truth is drawn from the priors (default: 200)",
    )
    p.add_argument(
        "--control",
        type=_whole("a number of crossings", 0),
        default=20,
        help="of these again with half the noise declared (default: 20)",
    )
    p.add_argument(
        "--truth",
        type=Path,
        default=Path("../shared/crossings"),
        metavar="DIR",
        help="folders of crossings with a truth.json (default: ../shared/crossings)",
    )
    p.add_argument("--processes", type=_whole("processes", 1, 256), default=2, help="(default: 2)")
    _add_file(p, "--page", "PAGE.md", "write what was found as a page")

    p = _command(
        commands,
        "recover",
        _recover,
        "rewrite a recording that is damaged or was cut off",
        "driveby recover run.mcap -o whole.mcap",
    )
    p.add_argument("recording", type=Path, metavar="REC.mcap", help="recording, stays as it is")
    p.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT.mcap",
        help="(default: REC.recovered.mcap beside it)",
    )
    p.add_argument(
        "--set-aside",
        action="store_true",
        help="then rename the damaged one to REC.mcap.crashed",
    )
    _add_force(p)
    p.add_argument("--json", action="store_true", help="print the counts as JSON")

    p = _command(
        commands,
        "view",
        _view,
        "look at a recording or a result",
        "driveby view run.mcap --web",
    )
    p.add_argument("target", metavar="REC|RESULT|RRD", help="a .mcap, .json or .rrd file")
    p.add_argument("--web", action="store_true", help="in the browser")


def _add_live(commands: Any) -> None:
    p = _command(
        commands,
        "demo",
        _demo,
        "a truck crosses a bridge: simulated, recorded, identified, drawn",
        "driveby demo --speed 4",
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="new folder for what it leaves behind")
    _add_speed(p, 4.0)
    text = "accelerometers' noise density in µg/√Hz; 0: all exact, least squares (default: 25)"
    _add_noise(p, text, 25.0)

    p = _command(
        commands,
        "logger",
        _logger,
        "record all that travels; hosts the router that the others connect to",
        f"driveby logger --listen {ENDPOINT} --folder recordings --site site.toml",
    )
    p.add_argument("--listen", help=f"where to listen (default: {ENDPOINT})")
    _add_tls(p)
    p.add_argument(
        "--insecure",
        action="store_true",
        help="listen to other machines without --tls: whoever reaches the address is believed",
    )
    _add_folder(p, "folder of the recordings")
    _add_file(p, "--file", "REC.mcap", "put everything into this one new file")
    p.add_argument(
        "--realm",
        action="append",
        metavar="REALM",
        help="record this realm, or those that begin so, e.g. sim-* (*: all); may be given again "
        "(default: live)",
    )
    _add_site(p, "site file to store in the recordings")
    _add_id(p, "logger")
    room = p.add_argument_group("files and room")
    room.add_argument(
        "--rotate-minutes",
        type=_number("minutes", low=0.01, high=1e6),
        default=15.0,
        metavar="MIN",
        help="begin a truck's next file after so long (default: 15; SIGUSR1: at once)",
    )
    room.add_argument(
        "--rotate-mb",
        type=_number("a size in MB", low=0.1, high=1e6),
        default=1000.0,
        metavar="MB",
        help="or when it is so large (default: 1000)",
    )
    room.add_argument(
        "--min-free",
        type=_number("a size in MB", low=0, high=1e9),
        default=500.0,
        metavar="MB",
        help="room the disk must have; at an eighth of it recording ends (default: 500)",
    )
    room.add_argument(
        "--budget",
        type=_number("a size in MB", low=1, high=1e9),
        metavar="MB",
        help="delete the oldest recordings beyond it, if all of their crossings are identified "
        "(default: delete nothing)",
    )

    p = _command(
        commands,
        "worker",
        _worker,
        "identify crossings as they happen and publish the results",
        "driveby worker --site site.toml",
    )
    _add_endpoint(p)
    _add_realm(p)
    _add_site(p, "trucks and bridges", required=True)
    _add_folder(p, "folder of the results")
    _add_file(p, "--file", "RESULTS.mcap", "put the results into this one new file (and .json)")
    _add_method(p)
    p.add_argument(
        "--processes",
        type=_whole("processes", 1, 256),
        default=1,
        metavar="N",
        help="identify so many crossings at once, beside the process that listens (default: 1)",
    )
    _add_id(p, "worker")

    p = _command(
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
        help="what the truck will measure: a recording, or a folder of CSV files with --site",
    )
    _add_site(p, "of a folder of CSV files (a recording carries its own)")
    p.add_argument(
        "--spool",
        type=Path,
        metavar="DIR",
        help="keep every message here, too, until a logger has it; one folder for each truck",
    )
    p.add_argument(
        "--spool-budget",
        type=_whole("MiB", 1, 1 << 30),
        default=4096,
        metavar="MIB",
        help="room for the spool; over it the oldest is given up (default: 4096)",
    )
    _add_endpoint(p)
    _add_realm(p)
    _add_speed(p, 1.0)
    p.add_argument("--vehicle", metavar="ID", help="which one drives, if there are several")

    p = _command(
        commands,
        "replay",
        _replay,
        "publish recorded messages again, unchanged, in a realm of their own",
        "driveby replay run.mcap --speed 10",
    )
    p.add_argument("recordings", type=Path, nargs="+", metavar="REC.mcap", help="recordings")
    _add_endpoint(p)
    _add_speed(p, 1.0, zero="0 for as fast as possible")
    p.add_argument("--name", help="realm replay-NAME (default: name of the first recording)")

    p = _command(
        commands,
        "certs",
        _certs,
        "make certificates and access control for a bus between machines",
        "driveby certs certs --trucks truck-1,truck-2 --host logger.example.org",
    )
    p.add_argument(
        "folder",
        type=Path,
        metavar="FOLDER",
        help="made by the first run, with an authority, router, logger, worker, viewer and replay",
    )
    p.add_argument("--trucks", type=_names, default=(), metavar="ID,…", help="add these trucks")
    p.add_argument(
        "--add", type=_names, default=(), metavar="ROLE/NAME,…", help="add e.g. viewer/anna"
    )
    p.add_argument(
        "--host",
        nargs="+",
        default=(),
        metavar="NAME",
        help="names and addresses of the machines of router and logger, besides this machine",
    )
    p.add_argument(
        "--days",
        type=_whole("days", 1, 3650),
        default=365,
        metavar="N",
        help="how long the new certificates are valid (default: 365)",
    )
    p.add_argument(
        "--renew", type=_names, default=(), metavar="NAME,…", help="new key and certificate"
    )
    p.add_argument(
        "--revoke", type=_names, default=(), metavar="NAME,…", help="these may no longer take part"
    )


def _command(
    commands: Any, name: str, handler: Handler, summary: str, example: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=f"example: {example}",
        allow_abbrev=False,
    )
    parser.set_defaults(handler=handler)
    _add_common(parser, suppressed=True)
    return parser


def _add_common(parser: argparse.ArgumentParser, *, suppressed: bool) -> None:
    """Options that may stand before or after the sub-command."""

    def default(value: object) -> Any:
        # A sub-command's default would overwrite what stood before the sub-command.
        return argparse.SUPPRESS if suppressed else value

    group = parser.add_argument_group("messages")
    group.add_argument("--verbose", action="store_true", default=default(False), help="say more")
    group.add_argument(
        "--log-format",
        choices=("text", "json"),
        default=default("text"),
        help="of the messages on standard error (default: text)",
    )
    group.add_argument(
        "--debug", action="store_true", default=default(False), help="tracebacks of internal errors"
    )


def _add_site(p: argparse.ArgumentParser, text: str, *, required: bool = False) -> None:
    p.add_argument("--site", type=Path, required=required, metavar="SITE.toml", help=text)


def _add_output(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "-o", "--output", type=Path, required=True, metavar="REC.mcap", help="recording to write"
    )
    _add_force(p)


def _add_force(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--force",
        action="store_true",
        help="replace a recording of that name, unless it is being written",
    )


def _add_file(p: argparse.ArgumentParser, option: str, metavar: str, text: str) -> None:
    p.add_argument(option, type=Path, metavar=metavar, help=text)


def _add_folder(p: argparse.ArgumentParser, text: str) -> None:
    p.add_argument(
        "--folder",
        type=Path,
        default=RECORDINGS,
        metavar="DIR",
        help=f"{text} (default: recordings)",
    )


def _add_seed(p: argparse.ArgumentParser) -> None:
    p.add_argument("--seed", type=_whole("a seed", 0), default=1, help="(default: 1)")


def _add_noise(p: argparse.ArgumentParser, text: str, default: float = 0.0) -> None:
    p.add_argument(
        "--noise", type=_number("a noise density", low=0, high=1e6), default=default, help=text
    )


def _add_speed(p: argparse.ArgumentParser, default: float, zero: str = "") -> None:
    p.add_argument(
        "--speed",
        type=_number("a factor", low=0 if zero else 1e-3, high=1e6),
        default=default,
        metavar="FACTOR",
        help=f"times real speed{', ' + zero if zero else ''} (default: {default:g})",
    )


def _add_method(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--method",
        choices=METHODS,
        default=METHODS[0],
        help="pre: with intervals, for real sensors; least-squares: for simulations without noise; "
        f"random-walk: the paper's search (default: {METHODS[0]})",
    )


def _add_endpoint(p: argparse.ArgumentParser) -> None:
    p.add_argument("--endpoint", help=f"where the logger listens (default: {ENDPOINT})")
    _add_tls(p)


def _add_tls(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--tls",
        type=Path,
        metavar="FOLDER",
        help=f"credentials made by `driveby certs`; the default address is {TLS_ENDPOINT} then",
    )


def _default_endpoint(options: argparse.Namespace) -> str:
    return ENDPOINT if options.tls is None else TLS_ENDPOINT


def _add_realm(p: argparse.ArgumentParser) -> None:
    p.add_argument("--realm", default="live", help="(default: live)")


def _add_id(p: argparse.ArgumentParser, default: str) -> None:
    p.add_argument("--id", default=default, help=f"name of this service (default: {default})")


def _number(what: str, *, low: float, high: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f'is "{text}", it must be {what} from {low:g} to {high:g}'
            )
        return value

    return parse


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


def _whole(what: str, low: int, high: int = (1 << 63) - 1) -> Callable[[str], int]:
    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            limits = f"of at least {low}" if high >= (1 << 63) - 1 else f"from {low} to {high}"
            raise argparse.ArgumentTypeError(
                f'is "{text}", it must be {what}, a whole number {limits}'
            )
        return value

    return parse


def _scenario(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text[:9]) not in SCENARIOS:
        raise argparse.ArgumentTypeError(f'is "{text}", it must be 1 to 12')
    return int(text)


def _scenarios(text: str) -> tuple[int, ...]:
    if text == "all":
        return tuple(SCENARIOS)
    return tuple(dict.fromkeys(_scenario(part.strip()) for part in text.split(",")))


def _ratios(text: str) -> tuple[float, ...]:
    ratio = _number("ratios", low=1e-3, high=1e3)
    return tuple(ratio(part) for part in text.split(","))


def _speed_range(text: str) -> tuple[float, float]:
    speed = _number("a speed in m/s (or START:END)", low=0.1, high=60)
    start, _, end = text.partition(":")
    return speed(start), speed(end if ":" in text else start)


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, as every other error does."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


class _Version(argparse.Action):
    def __call__(self, *_: object, **__: object) -> NoReturn:
        from importlib.metadata import version

        print(f"driveby {version('driveby')}")
        sys.exit(0)


def _console() -> "Console":
    from rich.console import Console

    return Console()


def _say(line: str, code: int) -> int:
    print(f"driveby: {line}", file=sys.stderr)
    return code


class _JsonFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": round(record.created, 6),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if hasattr(record, "figures"):
            line["figures"] = record.figures
        return json.dumps(line, ensure_ascii=False)


def _log(form: str, *, verbose: bool) -> None:
    handler = logging.StreamHandler()
    handler.setFormatter(
        _JsonFormatter()
        if form == "json"
        else logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s")
    )
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, handlers=[handler], force=True
    )


if __name__ == "__main__":
    sys.exit(main())
