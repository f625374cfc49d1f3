"""The command `driveby survey`: forecast a survey before the drive."""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.common.kinds import PNG, SURVEY_JSON, SVG
from services.common.options import count_option, number, opt, output_option, site_option


def _speeds(text: str) -> tuple[float, float]:
    speed = number("a speed in m/s (or SLOWEST:FASTEST)", low=1, high=50)
    low, colon, high = text.partition(":")
    if ":" in high:
        raise argparse.ArgumentTypeError(f'is "{text}", it must be SLOWEST:FASTEST')
    found = speed(low), speed(high if colon else low)
    if found[1] < found[0]:
        raise argparse.ArgumentTypeError(f'is "{text}", it must be SLOWEST:FASTEST')
    return found


@dataclass(frozen=True, kw_only=True)
class SurveyPlanOptions:
    """Options of `driveby survey`: a survey to forecast, and outputs."""

    site: Path = site_option(
        "site file of truck, bridge and sensors, such as docs/site.example.toml; its first vehicle "
        "and bridge are used",
        required=True,
    )
    loss: float = opt(
        "stiffness loss to detect, as a share of EI (default: 0.2)",
        number("a share of EI", low=0.01, high=0.95, hint="20 % is 0.2"),
        default=0.2,
        metavar="SHARE",
    )
    crossings: int = count_option("number of crossings", "a number of crossings", 12, 1, 300)
    speed: tuple[float, float] | None = opt(
        "speed in m/s, or range SLOWEST:FASTEST of feasible speeds to compare; the plan itself "
        "then uses the site's survey_speed_m_per_s or 10 m/s (default: 5:20)",
        _speeds,
        metavar="M_PER_S",
    )
    road: str | None = opt(
        "road class by ISO 8608 (default: the site's road_class, or A, the best)",
        choices=tuple("ABCDE"),
    )
    tyres: str | None = opt(
        "tyres of the rear axle; single: like the front ones (default: the site's, or twin)",
        choices=("single", "twin"),
    )
    noise: float | None = opt(
        "noise density of all accelerometers in µg/√Hz (default: the site's)",
        number("a noise density", low=0.1, high=1e6),
        metavar="UG_PER_RTHZ",
    )
    wander: float = opt(
        "lateral wander: standard deviation of the lateral position between runs in m; more "
        "wander averages out more of the profile mismatch (default: 0.12)",
        number("a standard deviation in m", low=0.01, high=1),
        default=0.12,
        metavar="M",
    )
    figure: Path | None = output_option(
        "file of a figure of detection probability against the number of crossings",
        "OUT.png|OUT.svg",
        PNG,
        SVG,
    )
    json: Path | None = output_option("JSON file of the whole plan", "OUT.json", SURVEY_JSON)


def _survey(options: SurveyPlanOptions) -> int:
    from schemas.site_file import load_site
    from services.common.errors import InputError
    from services.common.files import check_writable, write_atomically
    from services.common.progress import steps_bar
    from services.finding.placed import sensor_rows, sensors_in_words
    from services.planning.forecast_text import as_json, lines_of
    from services.planning.plan_survey import SurveyWishes, plan_survey

    figure = options.figure
    if figure is not None and figure.suffix not in (".png", ".svg"):
        raise InputError(f"{figure}: the name of a figure (.png or .svg) is expected")
    for path in (figure, options.json):
        if path is not None:
            check_writable(path)
    given = load_site(options.site)
    wishes = SurveyWishes(
        options.loss,
        options.crossings,
        options.speed,
        options.road,
        options.tyres,
        options.noise,
        options.wander,
    )
    start = (
        f"forecasting {options.crossings} crossings of {given.bridges[0].id} by "
        f"{given.vehicles[0].id} and the alternatives: {{steps}} plans"
    )
    with steps_bar("plans", a_console(), start) as progress:
        found = plan_survey(given, wishes, progress)
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


COMMAND: Final = Subcommand(
    SurveyPlanOptions,
    "driveby survey --site site.toml --loss 0.2 --crossings 12 --figure plan.png",
    _survey,
)
