"""`driveby survey`: what a survey will tell, before anyone drives."""

import argparse
import json
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from services.cli.parsing import a_console, add_output_file, add_site, command, number, whole
from services.common.kinds import PNG, SURVEY_JSON, SVG

if TYPE_CHECKING:
    from services.planning.survey import Expected, Outlook, Survey

_SPEEDS: Final = (5.0, 20.0)
_USUAL_M_PER_S: Final = 10.0
_ROAD_CLASS: Final = "A"


def _speeds(text: str) -> tuple[float, float]:
    speed = number("a speed in m/s (or SLOWEST:FASTEST)", low=1, high=50)
    low, _, high = text.partition(":")
    found = speed(low), speed(high if ":" in text else low)
    if found[1] < found[0]:
        raise argparse.ArgumentTypeError(f'is "{text}", it must be SLOWEST:FASTEST')
    return found


def add_survey(commands: Any) -> None:
    """`driveby survey`: say what a survey will tell."""
    p = command(
        commands,
        "survey",
        _survey,
        "plan a survey: expected accuracy, detection probability, most useful change",
        "driveby survey --site site.toml --loss 0.2 --crossings 12 --figure plan.png",
    )
    add_site(
        p,
        "site file of truck, bridge and sensors, as docs/site.example.toml; its first vehicle "
        "and bridge are used",
        required=True,
    )
    p.add_argument(
        "--loss",
        type=number("a share of EI", low=0.01, high=0.95, hint="20 % is 0.2"),
        default=0.2,
        metavar="SHARE",
        help="stiffness loss to detect, as a share of EI (default: 0.2)",
    )
    p.add_argument(
        "--crossings",
        type=whole("a number of crossings", 1, 300),
        default=12,
        metavar="N",
        help="number of crossings (default: 12)",
    )
    p.add_argument(
        "--speed",
        type=_speeds,
        metavar="M_PER_S",
        help="speed in m/s, or feasible range SLOWEST:FASTEST; with a range the plan uses the "
        "site's survey_speed_m_per_s or 10 m/s (default: 5:20)",
    )
    p.add_argument(
        "--road",
        choices=tuple("ABCDE"),
        help="ISO 8608 class (default: the site's road_class, or A, the best)",
    )
    p.add_argument(
        "--tyres",
        choices=("single", "twin"),
        help="tyres of the rear axle; single: like the front ones (default: the site's, or twin)",
    )
    p.add_argument(
        "--noise",
        type=number("a noise density", low=0.1, high=1e6),
        metavar="UG_PER_RTHZ",
        help="noise density of all accelerometers in µg/√Hz (default: the site's)",
    )
    p.add_argument(
        "--wander",
        type=number("a standard deviation in m", low=0.01, high=1),
        default=0.12,
        metavar="M",
        help="lateral standard deviation between runs in m; it adds information (default: 0.12)",
    )
    text = "file of a figure of detection probability over the number of crossings"
    add_output_file(p, "--figure", "OUT.png|OUT.svg", text, PNG, SVG)
    add_output_file(p, "--json", "OUT.json", "JSON file of the whole plan", SURVEY_JSON)


def _survey(options: argparse.Namespace) -> int:
    from schemas.site_file import load_site
    from services.common.errors import InputError
    from services.common.files import check_writable, write_atomically
    from services.common.progress import progress_bar
    from services.identification.placed import middle_site, sensor_rows, sensors_in_words
    from services.planning.alternatives import with_noise, with_tyres
    from services.planning.crossings import Road
    from services.planning.survey import Asked, survey

    figure: Path | None = options.figure
    if figure is not None and figure.suffix not in (".png", ".svg"):
        raise InputError(f"{figure}: the name of a picture (.png or .svg) is expected")
    for path in (figure, options.json):
        if path is not None:
            check_writable(path)
    given = load_site(options.site)
    site = middle_site(given)
    if options.tyres is not None:
        site = with_tyres(site, options.tyres)
    if options.noise is not None:
        site = with_noise(site, (options.noise,) * 4)
    speeds = options.speed or _SPEEDS
    wanted = site.bridges[0].survey_speed_m_per_s or _USUAL_M_PER_S
    asked = Asked(options.loss, options.crossings, min(max(wanted, speeds[0]), speeds[1]), speeds)
    road = Road(options.road or site.bridges[0].road_class or _ROAD_CLASS, options.wander)
    console = a_console()
    with progress_bar(console) as bar:
        task = bar.add_task("crossings", total=None)
        found = survey(
            site,
            road,
            asked,
            lambda done, jobs: bar.update(task, completed=done, total=jobs),
        )
    if options.json is not None:
        rows = sensor_rows(given.sensor, given.vehicles[0])
        sensors = {"sensors": [row._asdict() for row in rows]} if rows else {}
        content = json.dumps(as_json(found) | sensors, indent=1, ensure_ascii=False)
        write_atomically(options.json, content + "\n")
    if figure is not None:
        from services.planning.figure import survey_figure

        survey_figure(figure, found)
    print("\n".join(lines_of(found)))
    for line in sensors_in_words(given.sensor, given.vehicles[0]):
        print(f"sensor {line}")
    return 0


def as_json(found: "Survey") -> dict[str, Any]:
    """Everything that was found, elements from the bridge's start."""
    from pre_core.survey.detection import FALSE_ALARM, SURE
    from services.planning.advice import advice, warnings
    from services.planning.crossings import scale_error

    site = found.planned.plan.site
    return {
        "vehicle": site.vehicles[0].id,
        "bridge": site.bridges[0].id,
        "loss": found.asked.loss,
        "false_alarm": FALSE_ALARM,
        "sure": SURE,
        "crossings": found.asked.crossings,
        "speed_m_per_s": found.asked.speed_m_per_s,
        "road_class": found.road.road_class,
        "wander_m": found.road.wander_m,
        "scale_error": scale_error(site),
        "planned": _outlook_json(found.planned),
        "alternatives": [_outlook_json(one) for one in found.others],
        "rougher_road": None if found.rougher is None else _outlook_json(found.rougher),
        "speeds": [one._asdict() for one in found.speeds],
        "growth": [_expected_json(one) for one in found.growth],
        "warnings": list(warnings(found)),
        "advice": advice(found),
    }


def _outlook_json(one: "Outlook") -> dict[str, Any]:
    bridge = one.plan.site.bridges[0]
    return {
        "name": one.plan.name,
        "element_lengths_m": list(bridge.lengths_m),
        "middle_element": one.middle + 1,
        "one_crossing": _expected_json(one.once),
        "all_crossings": _expected_json(one.expected),
        "crossings_needed": {"middle": one.needed_middle, "ends": one.needed_ends},
    }


def _expected_json(one: "Expected") -> dict[str, Any]:
    return {
        "crossings": one.crossings,
        "std_ln_ei": one.std.tolist(),
        "level_std": one.level_std,
        "probability_seen": one.seen.tolist(),
        "probability_seen_among_others": one.seen_among_others.tolist(),
        "smallest_loss": one.smallest_loss.tolist(),
    }


def lines_of(found: "Survey") -> Iterator[str]:
    """All that is said, at most 80 characters a line but for warnings and advice."""
    from pre_core.survey.detection import FALSE_ALARM, SURE
    from services.planning.advice import advice, tracks_of, tyres_of, warnings
    from services.planning.survey import MOST_CROSSINGS

    asked, planned = found.asked, found.planned
    vehicle, bridge = planned.plan.site.vehicles[0], planned.plan.site.bridges[0]
    speeds = [crossing.speed_m_per_s for crossing in planned.plan.tracks[0]]
    tonnes = vehicle.total_mass_kg / 1e3
    yield f"{vehicle.id} ({tonnes:.1f} t, {tyres_of(planned)}) over {bridge.id}"
    yield (
        f"({bridge.span_m:g} m, {bridge.elements} elements), road of class "
        f"{found.road.road_class}, {asked.crossings} crossings at {speeds[0]:.1f} to "
        f"{speeds[-1]:.1f} m/s"
    )
    if found.road.is_surface:
        yield tracks_of(found)
    yield f"a loss of {asked.loss:.0%} is to be seen; false alarms: {FALSE_ALARM:.0%} an element"
    yield ""
    yield from _aligned(_elements(found))
    yield (
        f"mean of all elements: ± {_percent(planned.once.level_std)} by 1 crossing, "
        f"± {_percent(planned.expected.level_std)} by {asked.crossings}"
    )
    yield "±: standard deviation of EI, near 55% nothing is learnt; seen: probability that"
    yield "the loss is seen, against the nominal value; by others: against the other"
    yield f"elements; smallest: loss that is seen with {SURE:.0%}"
    yield ""
    yield from _aligned(_comparison(found))
    yield f"by {asked.crossings} crossings; mean ±: of what all elements share; mid ±, seen,"
    yield f"smallest: at midspan; needed, ends: crossings until it is seen with {SURE:.0%} at"
    yield f"midspan, at both ends (elsewhere between them); –: more than {MOST_CROSSINGS};"
    yield "t: only if the law lets it weigh that; the other way: in the other lane;"
    yield "elements: longer ones"
    yield ""
    for line in warnings(found):
        yield f"warning: {line}"
    yield advice(found)


def _aligned(rows: "list[list[str]]") -> Iterator[str]:
    """Rows with their first cells at the left, the others at the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for first, *cells in rows:
        aligned = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        yield "  ".join([first.ljust(widths[0]), *aligned]).rstrip()


def _elements(found: "Survey") -> list[list[str]]:
    planned, count = found.planned, found.asked.crossings
    ends = list(accumulate(planned.plan.site.bridges[0].lengths_m, initial=0.0))
    once, whole = planned.once, planned.expected
    heads = [
        "element",
        "from m",
        "to m",
        "± by 1",
        f"± by {count}",
        "seen",
        "by others",
        "smallest",
    ]
    return [
        heads,
        *(
            [
                f"EI_{e + 1}",
                f"{ends[e]:.2f}",
                f"{ends[e + 1]:.2f}",
                _percent(once.std[e]),
                _percent(whole.std[e]),
                _percent(whole.seen[e]),
                _percent(whole.seen_among_others[e]),
                _percent(whole.smallest_loss[e]),
            ]
            for e in range(len(ends) - 1)
        ),
    ]


def _comparison(found: "Survey") -> list[list[str]]:
    rows = [["what if", "mean ±", "mid ±", "seen", "smallest", "needed", "ends"]]
    rows += [_cells(one, one.plan.name) for one in (found.planned, *found.others)]
    rows += [
        [
            f"at {at.speed_m_per_s:g} m/s",
            _percent(at.level_std),
            _percent(at.std_middle),
            _percent(at.seen_middle),
            _percent(at.smallest_middle),
            "",
            "",
        ]
        for at in found.speeds
    ]
    if found.rougher is not None:
        name = f"road of class {chr(ord(found.road.road_class) + 1)}"
        rows.append(_cells(found.rougher, name))
    return rows


def _cells(one: "Outlook", name: str) -> list[str]:
    e = one.middle
    return [
        name,
        _percent(one.expected.level_std),
        _percent(one.expected.std[e]),
        _percent(one.expected.seen[e]),
        _percent(one.expected.smallest_loss[e]),
        _count(one.needed_middle),
        _count(one.needed_ends),
    ]


def _count(crossings: int | None) -> str:
    return "–" if crossings is None else str(crossings)


def _percent(share: float) -> str:
    """Two digits that mean something."""
    value = 100.0 * share
    return f"{value:.1f}%" if value < 9.95 else f"{value:.0f}%"
