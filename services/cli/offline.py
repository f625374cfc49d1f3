"""Commands that work on files: simulate, import, identify, recover."""

import argparse
from pathlib import Path
from typing import Any

from services.cli.cluster import add_scheduler, check_scheduler, execution_of
from services.cli.parsing import (
    CERTIFICATES,
    OutputFile,
    a_console,
    add_certificates,
    add_file,
    add_force,
    add_method,
    add_noise,
    add_output,
    add_output_file,
    add_output_folder,
    add_seed,
    add_site,
    command,
    folder_here,
    number,
    numbers,
    scenario,
    source,
    whole,
)
from services.common.errors import InputError
from services.common.kinds import ARRAYS, MCAP, NETCDF, RERUN, RESULTS


def _ratios(text: str) -> tuple[float, ...]:
    ratio = number("ratios", low=1e-3, high=1e3)
    return tuple(ratio(part) for part in text.split(","))


def _speed_range(text: str) -> tuple[float, float]:
    speed = number("a speed in m/s (or START:END)", low=0.1, high=60)
    start, _, end = text.partition(":")
    return speed(start), speed(end if ":" in text else start)


def add_simulate(commands: Any) -> None:
    """`driveby simulate`: write the recording of a simulated crossing."""
    p = command(
        commands,
        "simulate",
        _simulate,
        "write the recording of a simulated crossing",
        "driveby simulate --scenario 6 --noise 25 -o run.mcap",
    )
    damage = p.add_mutually_exclusive_group(required=True)
    damage.add_argument(
        "--scenario", type=scenario, metavar="N", help="damage scenario of the paper, 1 to 12"
    )
    damage.add_argument(
        "--ei",
        type=_ratios,
        metavar="1,1,.4,…",
        help="flexural rigidity of each element as a ratio to the sound value",
    )
    add_site(p, "truck and bridge (default: those of the paper)")
    p.add_argument(
        "--road", choices=tuple("ABCDE"), default="A", help="ISO 8608 class (default: A)"
    )
    add_seed(p)
    add_noise(p, "accelerometers' noise density in µg/√Hz (default: 0)")
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
        type=number("a rate in Hz", low=50, high=50_000),
        metavar="HZ",
        help="sampling rate (default: the site's, or 1000)",
    )
    _add_surface(p.add_argument_group("several runs, and a road that is a surface"))
    _add_beyond(p.add_argument_group("beyond what a site file tells (default: nothing)"))
    add_output(p)


def _add_surface(p: Any) -> None:
    p.add_argument(
        "--runs",
        type=whole("a number of runs", 1, 100),
        default=1,
        help="over the same road, ten minutes apart, in one recording (default: 1)",
    )
    p.add_argument(
        "--drive-seed",
        type=whole("a seed", 0),
        metavar="SEED",
        help="of noise and of the place across the lane (default: --seed, which is the road's)",
    )
    p.add_argument(
        "--road-surface",
        action="store_true",
        help="the road is rough across too, so that the axles feel different roads "
        "(default: one groove under both)",
    )
    p.add_argument(
        "--tyres",
        choices=("single", "twin"),
        help="of the rear axle, on a surface (default: the site's, or twin)",
    )
    p.add_argument(
        "--rear-offset",
        type=number("an offset in m", low=-1, high=1),
        metavar="M",
        help="the rear axle runs so far beside the front, on a surface "
        "(default: the site's, or 0.005)",
    )
    p.add_argument(
        "--wander",
        type=number("a standard deviation in m", low=0, high=2),
        metavar="M",
        help="of the truck's place across the lane from run to run, on a surface (default: 0)",
    )


def _on_surface(options: argparse.Namespace) -> Any:
    from services.simulation.wheel_paths import OnSurface

    if options.road_surface:
        return OnSurface(options.tyres, options.rear_offset, options.wander or 0.0)
    for name in ("tyres", "rear_offset", "wander"):
        if getattr(options, name) is not None:
            raise InputError(f"--{name.replace('_', '-')}: only a --road-surface has it")
    return None


def _add_beyond(p: Any) -> None:
    p.add_argument(
        "--support-springs",
        type=numbers("rotational stiffnesses in N·m/rad (START:END)", (0, 1e13), (0, 1e13)),
        default=(0.0, 0.0),
        metavar="START:END",
        help="the ends turn against springs of so many N·m/rad",
    )
    p.add_argument(
        "--bearing-stiffness",
        type=numbers("vertical stiffnesses in N/m (START:END)", (1e7, 1e15), (1e7, 1e15)),
        metavar="START:END",
        help="the ends sink on bearings of so many N/m",
    )
    p.add_argument(
        "--left",
        type=numbers(
            "a weight in N, a speed in m/s and seconds before (N:M_PER_S:S)",
            (0, 1e7),
            (0.5, 60),
            (0, 1000),
        ),
        metavar="N:M_PER_S:S",
        help="a lorry of this weight and speed left so long before the truck comes on",
    )
    p.add_argument(
        "--friction",
        type=number("a share of the springs' load", low=0, high=0.5),
        default=0.0,
        metavar="SHARE",
        help="dry friction of the springs over their static load",
    )
    p.add_argument(
        "--friction-growth",
        type=number("a growth with the load", low=0, high=1),
        default=0.0,
        metavar="SHARE",
        help="of the friction with the load: 1 is proportional",
    )
    p.add_argument(
        "--bilinear",
        type=number("a share", low=0, high=0.9),
        default=0.0,
        metavar="SHARE",
        help="dampers act so much more in rebound, and less in compression",
    )
    p.add_argument(
        "--air-springs",
        type=number("a polytropic exponent", low=1, high=2),
        default=0.0,
        metavar="EXPONENT",
        help="of the air in the springs: 1.38 is usual",
    )
    p.add_argument(
        "--lane-offset",
        type=number("a distance in m", low=-20, high=20),
        metavar="M",
        help="distance of the lane's middle to the left of the bridge's axis, looking from start "
        "to end; with --torsion the deck twists under it (default: 0)",
    )
    p.add_argument(
        "--torsion",
        type=numbers(
            "a frequency ratio and a radius of gyration in m (RATIO:M)", (0.2, 100), (0.1, 30)
        ),
        metavar="RATIO:M",
        help="first torsional over first bending frequency of the deck and its radius of "
        "gyration, with --lane-offset (2:2.3 is usual; default: the deck does not twist)",
    )


def _simulate(options: argparse.Namespace) -> int:
    from services.simulation.drive import Beyond, Left, simulate_command

    if (options.lane_offset is None) != (options.torsion is None):
        given, missing = ("--torsion", "--lane-offset")
        if options.torsion is None:
            given, missing = missing, given
        raise InputError(f"{given}: is of use with {missing} only, which is missing")
    stiffness = options.bearing_stiffness
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
        beyond=Beyond(
            options.support_springs,
            (1.0 / stiffness[0], 1.0 / stiffness[1]) if stiffness else (0.0, 0.0),
            Left(*options.left) if options.left else None,
            options.friction,
            options.friction_growth,
            options.bilinear,
            options.air_springs,
        ),
        twist=None if options.torsion is None else (options.lane_offset, *options.torsion),
        surface=_on_surface(options),
        runs=options.runs,
        drive_seed=options.drive_seed,
        output=options.output,
        force=options.force,
        console=a_console(),
    )


def add_import(commands: Any) -> None:
    """`driveby import`: turn files of a drive into a recording."""
    p = command(
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
        metavar="DIR | ACCEL.csv GPS.csv | ROS",
        help="a folder with accel_NN.csv and gps_NN.csv, one such pair, a comma2k19 segment, "
        "or a recording of ROS 2 (a rosbag2 folder, .mcap, .db3)",
    )
    add_site(p, "what was driven, over which bridges; is stored in the recording", required=True)
    p.add_argument("--vehicle", metavar="ID", help="which of the site's vehicles drove")
    p.add_argument("--name", help="realm import-NAME (default: name of the folder)")
    add_output(p)


def _import(options: argparse.Namespace) -> int:
    from rich.console import Console

    from services.common.progress import progress_bar
    from services.drives.importing import import_command
    from services.history.catalog import catalog_above, catalog_closed

    with progress_bar(Console(stderr=True)) as bar:
        reading = bar.add_task("reading", total=None)
        writing = bar.add_task(f"writing {options.output}", total=None, visible=False)
        said = import_command(
            sources=options.sources,
            site=options.site,
            output=options.output,
            force=options.force,
            vehicle=options.vehicle,
            name=options.name,
            reading=lambda done, steps: bar.update(reading, completed=done, total=steps),
            writing=lambda done, steps: bar.update(
                writing, completed=done, total=steps, visible=True
            ),
        )
    print(said)
    folder = catalog_above(options.output)
    if folder is not None:
        catalog_closed(folder, options.output)
    return 0


def add_identify(commands: Any) -> None:
    """`driveby identify`: find the flexural rigidity of each element from recordings."""
    p = command(
        commands,
        "identify",
        _identify,
        "find the flexural rigidity of each element from recordings",
        "driveby identify run.mcap --json result.json --rrd result.rrd",
    )
    p.add_argument(
        "recordings",
        type=source,
        nargs="+",
        metavar="REC.mcap",
        help="recordings, also as s3://…; with --into also folders of them",
    )
    add_site(p, "(default: the site stored in the recording)")
    add_method(p)
    add_output_file(p, "--json", "OUT.json", "write the results here", RESULTS)
    add_output_file(p, "--rrd", "OUT.rrd", "write a Rerun recording here", RERUN)
    text = "write the draws of method pre here, for ArviZ"
    add_output_file(p, "--draws", "OUT.npz|OUT.nc", text, ARRAYS, NETCDF)
    add_output_folder(p, "--figures", "draw every crossing and bridge here, as PNG and SVG")
    _add_fusing(p)
    add_certificates(
        p, f"certificates that results name where there are such (default: {CERTIFICATES})"
    )
    add_seed(p)
    group = p.add_argument_group("many crossings")
    group.add_argument(
        "--into",
        type=folder_here,
        metavar="DIR",
        help="keep every result here as soon as there is one, and go on from what is there; what "
        "cannot be read is told and left out (exit code 3)",
    )
    add_scheduler(group)


def _add_fusing(p: argparse.ArgumentParser) -> None:
    add_file(
        p,
        "--baseline",
        "OLD.json",
        "results with which the bridge is compared (default: what the site file names)",
    )
    p.add_argument(
        "--fuse-suspect",
        action="store_true",
        help="fuse suspect crossings too; the bridge's estimate is suspect then",
    )


def add_fuse(commands: Any) -> None:
    """`driveby fuse`: one estimate of each bridge from stored results."""
    p = command(
        commands,
        "fuse",
        _fuse,
        "make one estimate of each bridge from the results of many crossings",
        "driveby fuse monday.json tuesday.json --json week.json",
    )
    p.add_argument("results", type=Path, nargs="+", metavar="RESULTS.json", help="results")
    text = "write all crossings and the fused estimates here"
    add_output_file(p, "--json", "OUT.json", text, RESULTS)
    _add_fusing(p)


def _fuse(options: argparse.Namespace) -> int:
    from services.cli.fuse import fuse_command

    return fuse_command(
        paths=options.results,
        json_path=options.json,
        baseline=options.baseline,
        fuse_suspect=options.fuse_suspect,
        console=a_console(),
    )


def _identify(options: argparse.Namespace) -> int:
    from services.cli.identify import identify_command
    from services.cli.identify_archive import archive_command

    check_scheduler(options)
    if options.into is not None:
        return archive_command(
            sources=options.recordings,
            into=options.into,
            site=options.site,
            method=options.method.replace("-", "_"),
            json_path=options.json,
            certificates=options.certificates,
            seed=options.seed,
            baseline=options.baseline,
            fuse_suspect=options.fuse_suspect,
            of_single={name: getattr(options, name) for name in ("rrd", "draws", "figures")},
            executing=execution_of(options),
            console=a_console(),
        )
    return identify_command(
        recordings=options.recordings,
        site=options.site,
        method=options.method.replace("-", "_"),
        json_path=options.json,
        rrd_path=options.rrd,
        draws_path=options.draws,
        figures=options.figures,
        certificates=options.certificates,
        seed=options.seed,
        baseline=options.baseline,
        fuse_suspect=options.fuse_suspect,
        executing=None if options.scheduler is None else execution_of(options),
        console=a_console(),
    )


def add_recover(commands: Any) -> None:
    """`driveby recover`: rewrite a recording that is damaged or was cut off."""
    p = command(
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
        type=OutputFile((MCAP,)),
        metavar="OUT.mcap",
        help="(default: REC.recovered.mcap beside it)",
    )
    p.add_argument(
        "--set-aside",
        action="store_true",
        help="then rename the damaged one to REC.mcap.crashed",
    )
    add_force(p)
    p.add_argument("--json", action="store_true", help="print the counts as JSON")


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
