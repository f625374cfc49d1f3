"""Tables as vendors of loggers write them: read to the samples of the exact files, or refused."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.signals import CHANNELS
from schemas.site import Site
from schemas.site_file import parse_site
from services.common.arrays import Floats
from services.common.errors import InputError
from services.drives.csv_runs import AS_WRITTEN, ReadOptions, csv_runs, interpreted_runs
from services.drives.runs import Run
from services.drives.tables.guesses import Guess, grouped
from services.drives.tables.mapping import ImportMap, load_map, map_text
from services.drives.tables.preview import preview_lines
from services.drives.tables.reading import InterpretedRuns

Columns = dict[str, Floats]

RATE_HZ = 500
G = 9.80665
START_S = 1_790_000_000.0
SITE_TEXT = (Path(__file__).parents[2] / "data/csv_example/site.toml").read_text()


def site_of(old: str = "", new: str = "") -> Site:
    text = SITE_TEXT.replace("rate_hz = 100", f"rate_hz = {RATE_HZ}")
    assert old in text
    return parse_site(text.replace(old, new), "site.toml")


def measured() -> tuple[Columns, Columns]:
    """A drive of 7 s along the road at 12 m/s: smooth bodies, lively axles, noise as declared."""
    rng = np.random.default_rng(1)
    time_s = START_S + np.arange(7 * RATE_HZ) / RATE_HZ
    t = time_s - START_S
    accel: Columns = {"time_s": time_s}
    for k, name in enumerate(CHANNELS):
        size, frequency_hz = (0.3, 1.5) if k < 2 else (2.0, 10.0)
        motion = size * np.sin(2 * np.pi * frequency_hz * t + k)
        accel[name] = np.round(motion + 25e-6 * G * 250**0.5 * rng.standard_normal(t.size), 9)
    gps_s = START_S + np.arange(70) / 10
    east_deg = 12.0 * (gps_s - START_S) / 76_056.5  # metres a degree of longitude here
    gps = {
        "time_s": gps_s,
        "latitude_deg": np.full(70, 47.0) + 1e-7 * (np.arange(70) % 3),
        "longitude_deg": np.round(7.9997 + east_deg, 8),
        "altitude_m": np.full(70, 400.25),
        "speed_mps": np.full(70, 12.0),
    }
    return accel, gps


ACCEL, GPS = measured()


@lru_cache(maxsize=50)
def numbers(column: bytes, decimal: str) -> list[str]:
    """Return the cells of a column of doubles; most tables share most of their columns."""
    values = np.frombuffer(column).tolist()
    return ["" if v != v else repr(v).replace(".", decimal) for v in values]


def cells(column: Any, decimal: str) -> list[str]:
    if len(column) and isinstance(column[0], str):
        return list(column)
    return numbers(np.asarray(column, dtype=np.float64).tobytes(), decimal)


def table(columns: dict[str, Any], delimiter: str = ",", decimal: str = ".", **more: Any) -> str:
    rows = zip(*(cells(column, decimal) for column in columns.values()), strict=True)
    lines = [delimiter.join(row) for row in rows]
    head = [] if more.get("header") is False else [delimiter.join(columns)]
    return "\n".join([*more.get("before", []), *head, *more.get("units", []), *lines]) + "\n"


def renamed(columns: Columns, *names: str) -> dict[str, Any]:
    return dict(zip(names, columns.values(), strict=True))


def with_times(columns: Columns, times: Any) -> dict[str, Any]:
    return columns | {"time_s": times}


def dates(columns: Columns, form: str, shift_h: float = 0.0) -> dict[str, Any]:
    def text(second: float) -> str:
        when = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(
            hours=shift_h, microseconds=round(second * 1e6)
        )
        return when.strftime(form)

    return with_times(columns, [text(s) for s in columns["time_s"]])


def counted_from_0(columns: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the columns behind one of seconds from the start, their own times under a name."""
    other = {one: values for one, values in columns.items() if one != "time_s"}
    seconds = np.arange(len(columns["time_s"])) / 100.0
    return {"Zeit rel. [s]": seconds, name: columns["time_s"]} | other


def scaled(factor: float, offset: float = 0.0, names: tuple[str, ...] = CHANNELS) -> Columns:
    return {n: v * factor + offset if n in names else v for n, v in ACCEL.items()}


def gps_weeks(columns: Columns) -> dict[str, Any]:
    since = columns["time_s"] - 315_964_800 + 18
    week = np.floor(since / 604_800)
    rest = {name: v for name, v in columns.items() if name != "time_s"}
    return {"GPS Week": week, "GPS TOW [s]": np.round(since - 604_800 * week, 6)} | rest


def rows(columns: Columns, *pieces: slice) -> Columns:
    return {n: np.concatenate([v[piece] for piece in pieces]) for n, v in columns.items()}


def holes(columns: Columns, name: str, where: slice) -> Columns:
    changed = columns[name].copy()
    changed[where] = np.nan
    return columns | {name: changed}


def without(columns: Columns, *names: str) -> Columns:
    return {name: v for name, v in columns.items() if name not in names}


def one_file() -> dict[str, Any]:
    """All in one table; cells between the fixes are empty."""
    size = ACCEL["time_s"].size
    found: dict[str, Any] = dict(ACCEL)
    for name in list(GPS)[1:]:
        column = np.full(size, np.nan)
        column[:: RATE_HZ // 10] = GPS[name]
        found[name] = column
    return found


def one_file_held() -> dict[str, Any]:
    """All in one table; each fix is repeated until the next one."""
    found: dict[str, Any] = dict(ACCEL)
    for name in list(GPS)[1:]:
        found[name] = np.repeat(GPS[name], RATE_HZ // 10)
    return found


A, P = "accel_00.csv", "gps_00.csv"
GERMAN = "%d.%m.%Y %H:%M:%S,%f"
ISO = "%Y-%m-%dT%H:%M:%S.%f"
BODY = ("Body front [{}]", "Body rear [{}]", "Axle front [{}]", "Axle rear [{}]")
UNITS_LINE = ["s,m/s2,m/s2,m/s2,m/s2"]


class Variant(NamedTuple):
    """Files of a drive, what the user says, and what becomes of it."""

    files: Callable[[], dict[str, str | bytes]]
    guessed: str | None = None
    """Words of what has to be confirmed; None: nothing."""
    how: ReadOptions = AS_WRITTEN
    note: str = ""
    """Words of what is said besides."""
    left_out: tuple[slice, ...] = ()
    time_within_s: float = 3e-6
    speed_within: float = 1e-9
    site: tuple[str, str] = ("", "")


def pair(accel: Any = None, gps: Any = None, **options: Any) -> dict[str, str | bytes]:
    return {A: table(accel or ACCEL, **options), P: table(gps or GPS)}


def named(unit: str) -> dict[str, Any]:
    return renamed(ACCEL, "Time", *(name.format(unit) for name in BODY))


def channel_files(accel: dict[str, Any] = ACCEL) -> dict[str, str | bytes]:
    each = {f"{n}.csv": table({"time_s": accel["time_s"], n: accel[n]}) for n in CHANNELS}
    return each | {"positions.csv": table(GPS)}


def two_runs() -> dict[str, str | bytes]:
    """Half of the drive each, with other names of files and columns."""
    found: dict[str, str | bytes] = {}
    for number, (part, fixes) in enumerate(
        [(slice(0, 1750), slice(0, 36)), (slice(1800, 3500), slice(36, 70))]
    ):
        accel = renamed(rows(ACCEL, part), "t", *CHANNELS)
        found[f"log_{number}.csv"] = table(accel, ";")
        found[f"gnss_{number}.csv"] = table(rows(GPS, fixes), ";")
    return found


VARIANTS: dict[str, Variant] = {
    "exact": Variant(pair),
    "other order": Variant(lambda: pair({n: ACCEL[n] for n in reversed(ACCEL)})),
    "BOM and CRLF": Variant(
        lambda: {n: b"\xef\xbb\xbf" + t.replace("\n", "\r\n").encode() for n, t in pair().items()}  # type: ignore[union-attr, arg-type]
    ),
    "gap": Variant(
        lambda: pair(rows(ACCEL, slice(0, 1700), slice(1850, None))), left_out=(slice(1700, 1850),)
    ),
    "in g": Variant(lambda: pair(scaled(1 / G)), "accelerations are in g; their noise"),
    "in g with gravity": Variant(lambda: pair(scaled(1 / G, 1.0)), "in g; their mean is about 1"),
    "in mg with gravity": Variant(lambda: pair(scaled(1000 / G, 1000)), "in mg; their mean is"),
    "in gal with gravity": Variant(lambda: pair(scaled(100, 100 * G)), "in cm/s2; their mean is"),
    "gravity": Variant(lambda: pair(scaled(1.0, G)), "with gravity: sprung_front, sprung_rear"),
    "upside down": Variant(lambda: pair(scaled(-1.0, -G)), "with gravity, and pointing down:"),
    "no gravity though declared": Variant(
        pair,
        "without gravity: sprung_front",
        site=("rate_hz = 500", "rate_hz = 500\ngravity_included = true"),
    ),
    "no header": Variant(
        lambda: pair(header=False), "by the order of the columns: sprung_front is column 2"
    ),
    "neither has a header": Variant(
        lambda: {A: table(ACCEL, header=False), P: table(GPS, header=False)},
        "latitude_deg is column 2",
    ),
    "own names, latin-1": Variant(
        lambda: pair() | {A: table(named("m/s²")).encode("latin-1")},
        'sprung_front is column "Body front',
        note="latin-1",
    ),
    "own names in g": Variant(
        lambda: (
            pair(scaled(1 / G))
            | {A: table(renamed(scaled(1 / G), "t", *(n.format("g") for n in BODY)))}
        ),
        "in g by the header: sprung_front",
    ),
    "German names": Variant(
        lambda: {
            A: table(
                renamed(
                    ACCEL, "Zeit", "Aufbau vorn", "Aufbau hinten", "Achse vorn", "Achse hinten"
                ),
                "\t",
                ",",
            ),
            P: table(
                renamed(GPS, "Zeit", "Breite", "Länge", "Höhe", "Geschwindigkeit"), "\t", ","
            ).encode("latin-1"),
        },
        "longitude_deg is column",
    ),
    "semicolons and decimal commas": Variant(
        lambda: {A: table(ACCEL, ";", ","), P: table(GPS, ";", ",")}, note="decimal comma"
    ),
    "quoted decimal commas": Variant(
        lambda: {
            A: "\n".join(
                ",".join(f'"{c}"' for c in line.split(";"))
                for line in table(ACCEL, ";", ",").splitlines()
            ),
            P: table(GPS),
        },
        note="decimal comma",
    ),
    "spaces": Variant(lambda: pair(delimiter="  ")),
    "German dates with a zone": Variant(
        lambda: {
            A: table(dates(ACCEL, GERMAN, 2.0), ";", ","),
            P: table(dates(GPS, GERMAN, 2.0), ";", ","),
        },
        how=ReadOptions(zone="Europe/Berlin"),
    ),
    "dates beside a count from 0": Variant(
        lambda: {
            A: table(counted_from_0(dates(ACCEL, GERMAN, 2.0), "Datum/Uhrzeit"), ";", ","),
            P: table(counted_from_0(dates(GPS, GERMAN, 2.0), "Datum und Zeit"), ";", ","),
        },
        how=ReadOptions(zone="Europe/Berlin"),
        note="not used: Zeit rel. [s]",
    ),
    "Unix times beside a count from 0": Variant(
        lambda: pair(counted_from_0(ACCEL, "Timestamp (UTC)")), note="not used: Zeit rel. [s]"
    ),
    "ISO 8601 with an offset": Variant(
        lambda: {A: table(dates(ACCEL, ISO + "+01:00", 1.0)), P: table(dates(GPS, ISO + "Z"))}
    ),
    "ISO 8601 without a zone": Variant(
        lambda: {A: table(dates(ACCEL, ISO)), P: table(dates(GPS, ISO))},
        how=ReadOptions(zone="UTC"),
    ),
    "ISO 8601 beside Unix time": Variant(
        lambda: pair(dates(ACCEL, ISO)), "times without a zone are UTC"
    ),
    "date and time in two columns": Variant(
        lambda: pair(
            {
                "Datum": [
                    datetime.fromtimestamp(s, UTC).strftime("%d.%m.%Y") for s in ACCEL["time_s"]
                ]
            }
            | renamed(dates(ACCEL, "%H:%M:%S.%f"), "Uhrzeit", *CHANNELS)
        ),
        how=ReadOptions(zone="+00:00"),
    ),
    "from 0, both": Variant(
        lambda: {
            A: table(with_times(ACCEL, ACCEL["time_s"] - START_S)),
            P: table(with_times(GPS, GPS["time_s"] - START_S)),
        },
        how=ReadOptions(start="2026-09-21T16:13:20+02:00"),
        note="times count from the same start",
    ),
    "from 0 beside Unix time": Variant(
        lambda: pair(with_times(ACCEL, ACCEL["time_s"] - START_S)),
        how=ReadOptions(start="2026-09-21 14:13:20", zone="UTC"),
    ),
    "milliseconds from 0": Variant(
        lambda: {A: table(with_times(ACCEL, 1e3 * (ACCEL["time_s"] - START_S))), P: table(GPS)},
        "times are start in ms",
        ReadOptions(start=str(START_S)),
    ),
    "numbers of samples": Variant(
        lambda: pair(with_times(ACCEL, np.arange(3500.0))),
        "times are start in samples",
        ReadOptions(start=str(START_S)),
    ),
    "milliseconds since 1970": Variant(
        lambda: {
            A: table(with_times(ACCEL, 1e3 * ACCEL["time_s"])),
            P: table(with_times(GPS, 1e3 * GPS["time_s"])),
        },
        "times are since 1970 in ms",
    ),
    "nanoseconds since 1970": Variant(
        lambda: pair(with_times(ACCEL, 1e9 * ACCEL["time_s"])), "since 1970 in ns"
    ),
    "GPS week and seconds": Variant(lambda: pair(gps_weeks(ACCEL), gps_weeks(GPS))),
    "stamps rounded to 10 ms": Variant(
        lambda: pair(with_times(ACCEL, np.round(ACCEL["time_s"], 2))),
        "stamps are rounded",
        time_within_s=5e-3,
    ),
    "rows written twice": Variant(
        lambda: pair(rows(ACCEL, slice(0, 2000), slice(1990, None))),
        note="repeated rows left out: 10",
    ),
    "one row twice": Variant(
        lambda: pair(rows(ACCEL, slice(0, 2000), slice(1999, None))),
        note="repeated rows left out: 1",
    ),
    "one fix twice": Variant(
        lambda: pair(gps=rows(GPS, slice(0, 9), slice(8, None))), note="1 fix with a repeated"
    ),
    "one empty cell": Variant(
        lambda: pair(holes(ACCEL, "sprung_rear", slice(1700, 1701))),
        note="1 row with empty cells (first in line 1702)",
        left_out=(slice(1700, 1701),),
    ),
    "other names of files": Variant(lambda: {"run1.csv": table(ACCEL), "gnss1.csv": table(GPS)}),
    "a file for each channel": Variant(channel_files),
    "a file for each channel, ISO": Variant(lambda: channel_files(dates(ACCEL, f"{ISO}+00:00"))),
    "one file for both": Variant(lambda: {"drive.csv": table(one_file())}),
    "one file, fixes held": Variant(
        lambda: {"drive.csv": table(one_file_held())}, "each fix is repeated"
    ),
    "a line of units": Variant(lambda: pair(units=UNITS_LINE), note="units in line 2"),
    "a description before the table": Variant(
        lambda: pair(before=["Logger 7, firmware 2.1", "Project: Isar, truck: x", ""]),
        note="header in line 4",
    ),
    "speed in km/h": Variant(
        lambda: pair(gps=GPS | {"speed_mps": 3.6 * GPS["speed_mps"]}), "speed is in km/h: 3.6"
    ),
    "speed in km/h by its header": Variant(
        lambda: pair(
            gps=renamed(GPS | {"speed_mps": 3.6 * GPS["speed_mps"]}, *list(GPS)[:4], "Speed (km/h)")
        ),
        "speed is in km/h, by its header",
    ),
    "speed in knots": Variant(
        lambda: pair(gps=GPS | {"speed_mps": GPS["speed_mps"] / 0.5144444}), "speed is in knots"
    ),
    "speed in mph": Variant(
        lambda: pair(gps=GPS | {"speed_mps": GPS["speed_mps"] / 0.44704}), "speed is in mph"
    ),
    "latitude and longitude swapped": Variant(
        lambda: pair(
            gps=renamed(GPS, "time_s", "longitude_deg", "latitude_deg", "altitude_m", "speed_mps")
        ),
        "latitude and longitude are swapped",
    ),
    "coordinates in 1e-7 degrees": Variant(
        lambda: pair(
            gps=GPS | {n: np.round(1e7 * GPS[n]) for n in ("latitude_deg", "longitude_deg")}
        ),
        "coordinates are in 1e-7 deg",
    ),
    "altitude in feet": Variant(
        lambda: pair(
            gps=renamed(
                GPS | {"altitude_m": GPS["altitude_m"] / 0.3048},
                "time_s",
                "lat",
                "lon",
                "alt [ft]",
                "speed_mps",
            )
        ),
        "altitude_m is in ft",
    ),
    "no altitude": Variant(
        lambda: pair(gps=without(GPS, "altitude_m")), note="no altitude: it stays unknown"
    ),
    "no speed": Variant(
        lambda: pair(gps=without(GPS, "speed_mps")), "no speed: slopes", speed_within=0.02
    ),
    "receiver without a fix at first": Variant(
        lambda: pair(
            gps=rows(
                {
                    n: np.concatenate([[0.0 if n != "time_s" else START_S - 0.1], v])
                    for n, v in GPS.items()
                },
                slice(None),
            ),
            delimiter=";",
        ),
        note="1 row without a fix",
    ),
}


def quoted(text: str) -> str:
    return "\n".join(",".join(f'"{c}"' for c in line.split(",")) for line in text.splitlines())


def per_row(columns: Columns, name: str, form: Callable[[float], str]) -> dict[str, Any]:
    return columns | {name: [form(float(value)) for value in columns[name]]}


def sexagesimal(parts: int) -> dict[str, Any]:
    """Fixes as degrees and minutes, or degrees, minutes and seconds, with a hemisphere."""

    def form(value: float, side: str) -> str:
        degree, minute = int(value), 60.0 * (value % 1.0)
        if parts == 2:
            return f"{degree}°{minute:.7f}' {side}"
        return f"{side} {degree}°{int(minute)}'{60.0 * (minute % 1.0):.6f}\""

    found = per_row(GPS, "latitude_deg", lambda v: form(v, "N"))
    return found | per_row(found, "longitude_deg", lambda v: form(v, "E"))


def nmea_fields() -> dict[str, Any]:
    """Fixes as ddmm.mmmm with columns of hemispheres, and knots."""

    def form(value: float) -> float:
        return 100.0 * int(value) + 60.0 * (value % 1.0)

    return {
        "UTC": GPS["time_s"],
        "Lat": [f"{form(v):.7f}" for v in GPS["latitude_deg"]],
        "N/S": ["N"] * 70,
        "Lon": [f"{form(v):.7f}" for v in GPS["longitude_deg"]],
        "E/W": ["E"] * 70,
        "Alt (m)": GPS["altitude_m"],
        "Speed (kn)": GPS["speed_mps"] * 3600 / 1852,
    }


def thousands(number: float) -> str:
    return f"{number:,.9f}".replace(",", "#").replace(".", ",").replace("#", ".")


def triaxial() -> dict[str, Any]:
    found: dict[str, Any] = {"Time": ACCEL["time_s"]}
    for place, name in zip(
        ("Body front", "Body rear", "Axle front", "Axle rear"), CHANNELS, strict=True
    ):
        found |= {f"{place} {axis} [m/s²]": 0.1 * ACCEL[name] for axis in "xy"}
        found[f"{place} z [m/s²]"] = ACCEL[name]
    return found


def both(change: Callable[[str], str]) -> dict[str, str | bytes]:
    return {A: change(table(ACCEL)), P: change(table(GPS))}


FRENCH = ("Horodatage", "Caisse avant", "Caisse arrière", "Essieu avant", "Essieu arrière")
TO_DEGREES = 180.0 / np.pi

VARIANTS |= {
    "tabs": Variant(lambda: pair(delimiter="\t"), note="delimiter tab"),
    "quoted fields": Variant(lambda: both(quoted)),
    "French names": Variant(
        lambda: {
            A: table(renamed(dates(ACCEL, "%d/%m/%Y %H:%M:%S,%f", 2.0), *FRENCH), ";", ","),
            P: table(
                renamed(
                    dates(GPS, "%d/%m/%Y %H:%M:%S,%f", 2.0),
                    *("Horodatage", "Latitude", "Longitude", "Altitude", "Vitesse"),
                ),
                ";",
                ",",
            ),
        },
        'sprung_rear is column "Caisse arrière"',
        ReadOptions(zone="Europe/Paris"),
    ),
    "left front and left rear": Variant(
        lambda: pair(renamed(ACCEL, "Time", "Body_FL", "Body_RL", "Axle_FL", "Axle_RL")),
        'unsprung_rear is column "Axle_RL"',
    ),
    "three axes": Variant(lambda: pair(triaxial()), 'sprung_front is column "Body front z'),
    "mm/s² by the header": Variant(
        lambda: pair(
            renamed(scaled(1000.0), "t", *(name.format("mm/s²") for name in BODY)),
        ),
        "in mm/s2 by the header",
    ),
    "in mm/s² with gravity": Variant(
        lambda: pair(scaled(1000.0, 1000.0 * G)), "in mm/s2; their mean is"
    ),
    "ft/s² by the header": Variant(
        lambda: pair(renamed(scaled(1 / 0.3048), "t", *(n.format("ft/s2") for n in BODY))),
        "in ft/s2 by the header",
    ),
    "thousands": Variant(
        lambda: pair(
            dict(
                zip(
                    ("t", *(name.format("mg") for name in BODY)),
                    [
                        ACCEL["time_s"],
                        *(
                            [thousands(v) for v in scaled(1000 / G, 1000)[name]]
                            for name in CHANNELS
                        ),
                    ],
                    strict=True,
                )
            ),
            delimiter=";",
            decimal=",",
        ),
        "in mg by the header",
    ),
    "AM and PM": Variant(
        lambda: {
            A: table(dates(ACCEL, "%m/%d/%Y %I:%M:%S.%f %p")),
            P: table(dates(GPS, "%m/%d/%Y %I:%M:%S.%f %p")),
        },
        how=ReadOptions(zone="UTC"),
    ),
    "names of months": Variant(
        lambda: {
            A: table(dates(ACCEL, "%d-%b-%Y %H:%M:%S.%f")),
            P: table(dates(GPS, "%d. %B %Y %H:%M:%S.%f")),
        },
        how=ReadOptions(zone="UTC"),
    ),
    "dates without separators": Variant(
        lambda: {
            A: table(dates(ACCEL, "%Y%m%dT%H%M%S.%fZ")),
            P: table(dates(GPS, "%Y%m%d%H%M%S.%f+0000")),
        }
    ),
    "hours of an offset only": Variant(lambda: pair(dates(ACCEL, ISO + "+02", 2.0))),
    "CEST": Variant(lambda: pair(dates(ACCEL, ISO + " CEST", 2.0))),
    "milliseconds after a colon": Variant(
        lambda: {
            A: table(
                ACCEL
                | {
                    "time_s": [
                        text[:-7] + ":" + text[-6:-3]
                        for text in dates(ACCEL, "%Y-%m-%d %H:%M:%S.%f")["time_s"]
                    ]
                }
            ),
            P: table(GPS),
        },
        "times without a zone are UTC",
    ),
    "times of day": Variant(
        lambda: {A: table(dates(ACCEL, "%H:%M:%S.%f")), P: table(dates(GPS, "%H:%M:%S.%f"))},
        how=ReadOptions(start="2026-09-21", zone="UTC"),
    ),
    "hours, minutes and seconds from 0": Variant(
        lambda: {
            name: table(
                columns | {"time_s": [f"0:00:{s - START_S:09.6f}" for s in columns["time_s"]]}
            )
            for name, columns in ((A, ACCEL), (P, GPS))
        },
        how=ReadOptions(start=str(START_S)),
    ),
    "days of MATLAB": Variant(
        lambda: pair(per_row(ACCEL, "time_s", lambda s: f"{s / 86_400 + 719_529:.12f}")),
        "times are matlab in days",
        time_within_s=2e-5,
    ),
    "seconds since 1904": Variant(
        lambda: pair(with_times(ACCEL, ACCEL["time_s"] + 2_082_844_800)), "since 1904 in s"
    ),
    "a counter beside times": Variant(
        lambda: pair({"Index": np.arange(3500.0)} | ACCEL), note="not used: Index"
    ),
    "fixes in whole seconds": Variant(
        lambda: pair(gps=with_times(GPS, np.floor(GPS["time_s"]))),
        "the fixes are evenly spaced at 10 Hz",
    ),
    "blocks of one stamp": Variant(
        lambda: pair(with_times(ACCEL, START_S + np.repeat(np.arange(70) / 10, 50))),
        "stamps are rounded",
    ),
    "degrees and minutes": Variant(lambda: pair(gps=sexagesimal(2))),
    "degrees, minutes and seconds": Variant(lambda: pair(gps=sexagesimal(3))),
    "fields of NMEA": Variant(lambda: pair(gps=nmea_fields()), "speed is in knots"),
    "longitude counted to the west": Variant(
        lambda: pair(gps=GPS | {"longitude_deg": -GPS["longitude_deg"]}),
        "longitude_deg has the wrong sign",
    ),
    "radians": Variant(
        lambda: pair(gps=GPS | {n: GPS[n] / TO_DEGREES for n in ("latitude_deg", "longitude_deg")}),
        "coordinates are in rad",
    ),
    "speed in ft/s": Variant(
        lambda: pair(gps=GPS | {"speed_mps": GPS["speed_mps"] / 0.3048}), "speed is in ft/s"
    ),
    "u-blox": Variant(
        lambda: pair(
            gps={
                "time_s": GPS["time_s"],
                "lat [1e-7 deg]": np.round(1e7 * GPS["latitude_deg"]),
                "lon [1e-7 deg]": np.round(1e7 * GPS["longitude_deg"]),
                "hMSL [mm]": 1000.0 * GPS["altitude_m"],
                "gSpeed [mm/s]": 1000.0 * GPS["speed_mps"],
            }
        ),
        "speed is in mm/s",
    ),
    "UTF-16 without a mark": Variant(
        lambda: {A: table(ACCEL).encode("utf-16-le"), P: table(GPS).encode("utf-16-be")},
        note="utf-16",
    ),
    "comments": Variant(
        lambda: (
            pair(before=["# Logger 7", "# Rate: 500 Hz"])
            | {P: table(GPS).replace("\n", "\n# bridge\n", 30) + "End of data\n"}
        ),
        note="30 lines of comments, end text",
    ),
    "delimiters at the ends": Variant(
        lambda: {A: table(ACCEL, ";").replace("\n", ";\n").replace(";\n", "\n", 1), P: table(GPS)}
    ),
    "mixed line ends": Variant(lambda: both(lambda text: text.replace("\n", "\r\n", 100))),
    "words for no value": Variant(
        lambda: {
            A: table(per_row(ACCEL, "sprung_rear", repr)).replace(
                repr(float(ACCEL["sprung_rear"][700])), "OVERLOAD"
            ),
            P: table(GPS),
        },
        note="left out as a gap: 1 row with empty cells",
        left_out=(slice(700, 701),),
    ),
    "9999 for no value": Variant(
        lambda: pair(
            ACCEL
            | {"sprung_rear": np.where(np.arange(3500) // 3 == 200, -9999.0, ACCEL["sprung_rear"])}
        ),
        note="-9999 stands for a missing value in 3 cells",
        left_out=(slice(600, 603),),
    ),
    "a last row that was cut off": Variant(
        lambda: {A: table(ACCEL)[:-30], P: table(GPS)},
        note="end text or a cut-off row",
        left_out=(slice(3499, 3500),),
    ),
    "header of another program": Variant(
        lambda: pair(
            renamed(ACCEL, "Zeit  1 - Standardmessrate", *FRENCH[1:]),
            delimiter="\t",
            decimal=",",
            before=["HBM_CATMAN_DATAFILE_30", "T0: 21.09.2026 16:13:20", ""],
        ),
        "by their names",
    ),
}


def written(folder: Path, files: dict[str, str | bytes]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder


def gravity_back(run: Run, site: Site) -> dict[str, Floats]:
    """Accelerations upward and without gravity, as they were made."""
    g = G if site.sensor.gravity_included else 0.0
    return {name: values - g for name, values in run.channels.items()}


def check(run: Run, variant: Variant, site: Site) -> None:
    """The run is the drive that was measured."""
    kept = np.ones(ACCEL["time_s"].size, dtype=bool)
    for piece in variant.left_out:
        kept[piece] = False
    assert run.rate_hz == RATE_HZ
    np.testing.assert_allclose(
        run.accel_time_s - START_S,
        ACCEL["time_s"][kept] - START_S,
        rtol=0,
        atol=variant.time_within_s,
    )
    channels = gravity_back(run, site)
    assert set(channels) == set(CHANNELS)
    for name in CHANNELS:
        np.testing.assert_allclose(channels[name], ACCEL[name][kept], rtol=0, atol=1e-8)
    gnss = run.gnss
    np.testing.assert_allclose(gnss.time_s - START_S, GPS["time_s"] - START_S, rtol=0, atol=3e-6)
    np.testing.assert_allclose(gnss.latitude_deg, GPS["latitude_deg"], rtol=0, atol=1.1e-7)
    np.testing.assert_allclose(gnss.longitude_deg, GPS["longitude_deg"], rtol=0, atol=1.1e-7)
    np.testing.assert_allclose(
        gnss.speed_m_per_s, GPS["speed_mps"], rtol=variant.speed_within + 1e-6
    )
    if "no altitude" in variant.note:
        assert np.isnan(gnss.altitude_m).all()
    else:
        np.testing.assert_allclose(gnss.altitude_m, GPS["altitude_m"], rtol=1e-9)


@pytest.mark.parametrize("name", VARIANTS)
def test_vendor_table_gives_the_samples_of_the_exact_file(name: str, tmp_path: Path) -> None:
    variant = VARIANTS[name]
    site = site_of(*variant.site)
    folder = written(tmp_path / "drive", variant.files())
    found = interpreted_runs([folder], site, "truck-x", variant.how)
    (run,) = found.runs
    check(run, variant, site)
    output = [guess.text for guess in found.guesses]
    assert any(variant.note in text for text in output) or not variant.note, output
    conversions = "; ".join(found.conversions())
    if variant.guessed is None:
        assert conversions == ""
    else:
        assert variant.guessed in conversions
        with pytest.raises(InputError, match="--yes or a map") as caught:
            csv_runs([folder], site, "truck-x", variant.how)
        assert "\n" not in str(caught.value)
        check(
            csv_runs([folder], site, "truck-x", variant.how._replace(accepts_guesses=True))[0],
            variant,
            site,
        )


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in VARIANTS
        if name not in ("exact", "other order", "BOM and CRLF", "gap", "mixed line ends")
    ],
)
def test_written_map_reads_the_same_without_a_guess(name: str, tmp_path: Path) -> None:
    variant = VARIANTS[name]
    site = site_of(*variant.site)
    folder = written(tmp_path / "drive", variant.files())
    path = tmp_path / "map.toml"
    path.write_text(map_text(interpreted_runs([folder], site, "truck-x", variant.how).mapping))
    again = interpreted_runs([folder], site, "truck-x", ReadOptions(load_map(path)))
    assert again.conversions() == []
    check(again.runs[0], variant, site)
    assert map_text(again.mapping) == path.read_text()
    check(csv_runs([folder], site, "truck-x", ReadOptions(load_map(path)))[0], variant, site)


def test_map_of_several_runs_names_files_by_patterns(tmp_path: Path) -> None:
    site = site_of()
    folder = written(tmp_path / "drive", two_runs())
    found = interpreted_runs([folder], site, "truck-x")
    assert [run.accel_time_s.size for run in found.runs] == [1750, 1700]
    assert [file.name for file in found.mapping.files] == ["gnss_*.csv", "log_*.csv"]
    assert all(file.run is None for file in found.mapping.files)
    again = interpreted_runs([folder], site, "truck-x", ReadOptions(found.mapping))
    for one, other in zip(found.runs, again.runs, strict=True):
        assert np.array_equal(one.accel_time_s, other.accel_time_s)


def drift(columns: Columns) -> Columns:
    """A clock that goes back again and again."""
    times = columns["time_s"].copy()
    times[::7] -= 0.011
    return columns | {"time_s": times}


REFUSED: dict[str, tuple[Callable[[], dict[str, str | bytes]], str]] = {
    "clocks an hour apart": (
        lambda: pair(with_times(ACCEL, ACCEL["time_s"] + 3600)),
        (
            "gps_00.csv: begins 1 h before accel_00.csv, which looks like another time zone; "
            'the clocks must agree: give a map (--map) of [[file]], name = "gps_00.csv", '
            "[file.time], offset_s = 3600 if the positions are wrong, "
            'or of "accel_00.csv" with -3600 if it is'
        ),
    ),
    "local times": (
        lambda: {A: table(dates(ACCEL, GERMAN), ";", ","), P: table(dates(GPS, GERMAN), ";", ",")},
        "accel_00.csv: times have no zone: give --zone UTC",
    ),
    "times from 0": (
        lambda: pair(with_times(ACCEL, ACCEL["time_s"] - START_S)),
        "accel_00.csv: times count from the start of the drive, give that with --start",
    ),
    "runs that each count from 0": (
        lambda: {
            name.replace("00", run): content
            for run in ("03", "04")
            for name, content in pair(
                with_times(ACCEL, ACCEL["time_s"] - START_S),
                with_times(GPS, GPS["time_s"] - START_S),
            ).items()
        },
        'of each run in [file.time] of a map, start = { 03 = "…" }',
    ),
    "day or month first": (
        lambda: {A: table(dates(ACCEL, "%m/%d/2026 %H:%M:%S.%f", -24 * 11)), P: table(GPS)},
        'give order = "dmy" or "mdy"',
    ),
    "in mg without gravity": (
        lambda: pair(
            renamed(scaled(1000 / G), "t", "body front", "body rear", "axle front", "axle rear")
        ),
        "as in mg or cm/s2); give it in a map (--map)",
    ),
    "gravity in one channel only": (
        lambda: pair(scaled(1.0, G, ("sprung_front",))),
        "gravity shows in sprung_front and not in sprung_rear",
    ),
    "unknown names": (
        lambda: pair(renamed(ACCEL, "t", "a", "b", "c", "d") | {"e": ACCEL["sprung_front"]}),
        "no column is known by its name (t, a, b, c, d, e): assign them in [file.columns]",
    ),
    "speed of a short drive": (
        lambda: pair(gps=renamed(rows(GPS, slice(0, 12)), "time_s", "lat", "lon", "alt", "v")),
        "the unit of the speed is undetermined, give it in a map (--map)",
    ),
    "speed that fits no unit": (
        lambda: pair(gps=GPS | {"speed_mps": 1.5 * GPS["speed_mps"], "x": GPS["altitude_m"]}),
        "is 1.50 times the speed of the positions",
    ),
    "a clock that goes back": (
        lambda: pair(drift(ACCEL)),
        "rows are not later than the row before",
    ),
    "other channels at other times": (
        lambda: (
            channel_files()
            | {
                "sprung_rear.csv": table(
                    {"time_s": ACCEL["time_s"] + 0.0007, "sprung_rear": ACCEL["sprung_rear"]}
                )
            }
        ),
        "sprung_rear.csv: is not sampled at the times of sprung_front.csv",
    ),
    "GPS weeks after a rollover": (
        lambda: pair(gps_weeks(ACCEL) | {"GPS Week": np.full(3500, 386.0)}, gps_weeks(GPS)),
        "GPS week 386 is before 2000",
    ),
    "a word among numbers": (
        lambda: {
            A: table(ACCEL, ";").replace(repr(float(ACCEL["sprung_rear"][7])), "zwei"),
            P: table(GPS),
        },
        'accel_00.csv: line 9: column "sprung_rear" is "zwei", it must be a number',
    ),
    "volts": (
        lambda: pair(renamed(scaled(0.1), "t", *(name.format("V") for name in BODY))),
        'is in V, no acceleration: give sprung_front = { factor = 0.01, unit = "g" }',
    ),
    "counts of a converter": (
        lambda: pair({n: np.rint(1e4 * v) if n in CHANNELS else v for n, v in ACCEL.items()}),
        "whole numbers, as counts of a converter are: give factor",
    ),
    "mm/s² without a header": (
        lambda: pair(scaled(1000.0)),
        "as in mm/s2); give it in a map (--map)",
    ),
    "several columns of one name": (
        lambda: {
            A: table(ACCEL | {"x": ACCEL["time_s"]}).replace("x\n", "sprung_rear\n", 1),
            P: table(GPS),
        },
        "sprung_rear may be column",
    ),
    "times of day without a date": (
        lambda: {A: table(dates(ACCEL, "%H:%M:%S.%f")), P: table(dates(GPS, "%H:%M:%S.%f"))},
        "times of day have no date: give the midnight before them with --start",
    ),
    "times of day of a receiver beside dates": (
        lambda: {A: table(dates(ACCEL, ISO + "Z")), P: table(dates(GPS, "%H:%M:%S.%f"))},
        "give the midnight before them with --start 2026-09-21T00:00:00Z (in UTC; or with",
    ),
    "seconds of the GPS week": (
        lambda: pair(renamed(ACCEL, "TOW [s]", *CHANNELS)),
        "seconds of a GPS week without its number: give week = 2437",
    ),
    "GPS seconds": (
        lambda: pair(
            renamed(with_times(ACCEL, ACCEL["time_s"] - 315_964_782), "GPS time", *CHANNELS)
        ),
        'give format = "unix_s" or "gps_s"',
    ),
    "18 s apart": (
        lambda: pair(with_times(ACCEL, ACCEL["time_s"] + 18.0)),
        "18 s is GPS time less UTC",
    ),
    "times of Windows": (
        lambda: pair(
            per_row(ACCEL, "time_s", lambda s: str(round(s * 1e7) + 116_444_736_000_000_000))
        ),
        "no known kind of time: give format",
    ),
    "decimal commas between commas": (
        lambda: pair(delimiter=",", decimal=","),
        "export it with semicolons or decimal points",
    ),
    "a spreadsheet": (lambda: pair() | {A: b"PK\x03\x04" + bytes(100)}, "save it as CSV"),
    "sentences of NMEA": (
        lambda: pair() | {P: "$GPRMC,141320.0,A,4700.0,N,00759.9,E,23.3,90.0,210926,,*00\n"},
        "a log of NMEA sentences",
    ),
    "no positions": (
        lambda: {A: table(ACCEL, ";"), "b_00.csv": table(ACCEL, ";")},
        "positions expected next to it",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_doubtful_table_is_refused_in_a_line_that_helps(name: str, tmp_path: Path) -> None:
    files, words = REFUSED[name]
    folder = written(tmp_path / "drive", files())
    how = AS_WRITTEN._replace(accepts_guesses=True)
    with pytest.raises(InputError) as caught:
        csv_runs([folder], site_of(), "truck-x", how)
    line = str(caught.value)
    assert words in line
    assert line.startswith(str(folder))
    assert "\n" not in line
    assert len(line.removeprefix(str(folder))) < 320


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[file]]\nname = 'a'\ndelimeter = ';'", "file.0.delimeter is not a known key"),
        ("[[file]]\n[file.time]\nformat = 'unix'", "must be one of unix_s, unix_ms"),
        (
            "[[file]]\n[file.columns]\nspeed_mps = { unit = 'kmh' }",
            'speed_mps.unit is "kmh", it must be one of',
        ),
        ("[[file]]\nheader_line = 1.5", 'file.0.header_line is "1.5", it must be'),
        ("[[file]]\nheader_line = 'a'", 'file.0.header_line is "a", it must be a valid integer'),
        ("file = 3", 'file is "3", it must be a list: [[file]]'),
        ("[file.time]\noffset_s = 3600", "it must be a list: [[file]] before the keys of each"),
        ("[[file]\n", "is not TOML"),
    ],
)
def test_wrong_map_is_named_by_its_key(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_map(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_map_skips_a_file_that_is_no_part_of_the_drive(tmp_path: Path) -> None:
    files = pair(delimiter=";") | {"summary.csv": "bridge;ratio\nisar;0.9\nelbe;1.0\n"}
    folder = written(tmp_path / "drive", files)
    with pytest.raises(InputError, match="skip = true"):
        csv_runs([folder], site_of(), "truck-x")
    path = tmp_path / "map.toml"
    path.write_text('[[file]]\nname = "summary.csv"\nskip = true\n')
    check(
        csv_runs([folder], site_of(), "truck-x", ReadOptions(load_map(path)))[0],
        VARIANTS["exact"],
        site_of(),
    )


def test_map_that_names_one_key_leaves_the_rest_to_guesses(tmp_path: Path) -> None:
    """What a refusal asks for is all that has to be written."""
    accel = renamed(scaled(1000 / G), "t", "body front", "body rear", "axle front", "axle rear")
    folder = written(tmp_path / "drive", pair(accel))
    path = tmp_path / "map.toml"
    keys = "\n".join(f'{name} = {{ unit = "mg" }}' for name in CHANNELS)
    path.write_text(f'[[file]]\nname = "accel_*.csv"\n[file.columns]\n{keys}\n')
    with pytest.raises(InputError, match="by their names"):
        csv_runs([folder], site_of(), "truck-x", ReadOptions(load_map(path)))


def outcome(folder: Path) -> InterpretedRuns | str:
    try:
        return interpreted_runs([folder], site_of(), "truck-x")
    except InputError as error:
        return str(error)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.text(max_size=300), in_gps=st.booleans(), place=st.integers(0, 400))
def test_any_text_in_a_table_is_a_run_or_one_line(
    text: str, in_gps: bool, place: int, tmp_path: Path
) -> None:
    whole = [
        table(rows(ACCEL, slice(0, 60)), ";", ","),
        table(rows(GPS, slice(0, 3)), ";"),
    ]
    whole[in_gps] = whole[in_gps][:place] + text + whole[in_gps][place:]
    (tmp_path / A).write_bytes(whole[0].encode("utf-8", "surrogatepass"))
    (tmp_path / P).write_bytes(whole[1].encode("utf-8", "surrogatepass"))
    found = outcome(tmp_path)
    if isinstance(found, str):
        assert len(found.splitlines()) == 1
    else:
        assert all(np.isfinite(v).all() for v in found.runs[0].channels.values())
        assert preview_lines(found, 80)


def test_preview_shows_guesses_rows_and_curves(tmp_path: Path) -> None:
    folder = written(tmp_path / "drive", VARIANTS["in g with gravity"].files())
    found = interpreted_runs([folder], site_of(), "truck-x")
    lines = preview_lines(found, 90)
    assert (
        lines[0]
        == "guess: accel_00.csv: accelerations are in g; their mean is about 1, which is gravity "
        "in g"
    )
    first = ["14:13:20.000000", *(f"{ACCEL[name][0]:.4f}" for name in CHANNELS)]
    assert any(line.split() == first for line in lines)
    assert any(
        line.split() == ["14:13:20.000000", "47.000000", "7.999700", "400.2", "12.00"]
        for line in lines
    )
    curves = [line for line in lines if "█" in line]
    assert len(curves) == 5
    assert all(len(line) <= 90 for line in curves)


def test_uncalibrated_columns_are_read_by_a_factor(tmp_path: Path) -> None:
    volts = renamed(scaled(1 / 40.0), "t", *(name.format("V") for name in BODY))
    folder = written(tmp_path / "drive", pair(volts))
    path = tmp_path / "map.toml"
    keys = "\n".join(
        f'{channel} = {{ column = "{name.format("V")}", factor = {40.0 / G!r}, unit = "g" }}'
        for channel, name in zip(CHANNELS, BODY, strict=True)
    )
    path.write_text(f'[[file]]\nname = "accel_*.csv"\n[file.columns]\n{keys}\n')
    how = ReadOptions(load_map(path))
    check(csv_runs([folder], site_of(), "truck-x", how)[0], VARIANTS["exact"], site_of())


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (lambda: pair(gps=GPS | {"longitude_deg": GPS["longitude_deg"] + 5}), "no bridge of the"),
        (lambda: pair(ACCEL | {"sprung_front": np.zeros(3500)}), "sprung_front never changes"),
        (
            lambda: pair(renamed(ACCEL, "time_s", *CHANNELS[2:], *CHANNELS[:2])),
            "the front body shakes more than its axle",
        ),
        (
            lambda: pair(gps=GPS | {"altitude_m": 1000 * GPS["altitude_m"]}),
            "altitudes reach 400250 m; are they in another unit?",
        ),
        (
            lambda: pair(gps=with_times(GPS, GPS["time_s"] + 2.0)),
            "positions begin and end 2.0 s after the accelerations",
        ),
    ],
)
def test_strange_drive_is_noted_and_read(
    files: Callable[[], dict[str, str | bytes]], words: str, tmp_path: Path
) -> None:
    found = interpreted_runs([written(tmp_path / "drive", files())], site_of(), "truck-x")
    assert len(found.runs) == 1
    assert any(words in guess.text for guess in found.guesses)
    plain = interpreted_runs([written(tmp_path / "plain", pair())], site_of(), "truck-x")
    assert plain.guesses == []


def test_drives_in_folders_of_their_own_are_imported_one_by_one(tmp_path: Path) -> None:
    (tmp_path / "day").mkdir()
    folders = [written(tmp_path / "day" / name, two_runs()) for name in ("run-1", "run-2")]
    with pytest.raises(InputError, match=r"holds no accel_NN.*each of its folders.*run-1"):
        csv_runs([tmp_path / "day"], site_of(), "truck-x")
    with pytest.raises(InputError, match=r"2 files or folders given.*import each folder alone"):
        csv_runs(folders, site_of(), "truck-x")


def test_accepted_guesses_are_logged_once_for_all_files(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = ("t", *(name.format("m/s2") for name in BODY))
    files = two_runs()
    for n, part in enumerate((slice(0, 1750), slice(1800, 3500))):
        files[f"log_{n}.csv"] = table(renamed(rows(ACCEL, part), *names), ";")
    folder = written(tmp_path / "drive", files)
    csv_runs([folder], site_of(), "truck-x", AS_WRITTEN._replace(accepts_guesses=True))
    (line,) = (record.getMessage() for record in caplog.records if "by their" in record.message)
    assert line.startswith("log_0.csv and 1 more: by their names: sprung_front is column")


def test_equal_guesses_of_several_files_are_one_and_units_come_first() -> None:
    units = "accelerations are in g"
    guesses = [
        *(
            Guess(f"P_{k}.csv", "by their names latitude_deg is column 2", "columns")
            for k in (1, 2)
        ),
        *(Guess(f"A_{k}.csv", units, "converts") for k in (1, 2, 3)),
        Guess("P_1.csv", "no altitude", "form"),
    ]
    assert [one.file for one in grouped(guesses)] == [
        "P_1.csv and 1 more",
        "A_1.csv and 2 more",
        "P_1.csv",
    ]
    found = InterpretedRuns([], guesses, ImportMap()).conversions()
    assert found[0] == f"A_1.csv and 2 more: {units}"
    assert len(found) == 2
