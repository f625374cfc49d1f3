"""CSV files of a drive: read exactly, or refused with file, line and field."""

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.signals import CHANNELS
from schemas.site_file import load_site
from services.common.errors import InputError
from services.drives.csv_import import read_folder, read_pair
from services.drives.runs import Run

EXAMPLE = Path(__file__).parents[2] / "data" / "csv_example"
ACCEL = (EXAMPLE / "accel_00.csv").read_text()
GPS = (EXAMPLE / "gps_00.csv").read_text()


def complaint(folder: Path, accel: str | bytes = ACCEL, gps: str | bytes = GPS) -> str:
    for name, content in (("accel_00.csv", accel), ("gps_00.csv", gps)):
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError) as caught:
        read_folder(folder)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"{folder}/")
    return line.removeprefix(f"{folder}/")


def with_field(text: str, line: int, column: int, value: str) -> str:
    """Replace a field; lines count from 1, columns from 0."""
    lines = text.splitlines()
    fields = lines[line - 1].split(",")
    fields[column] = value
    lines[line - 1] = ",".join(fields)
    return "\n".join(lines) + "\n"


def test_the_example_is_what_its_script_writes(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location(
        "make_csv_example", EXAMPLE.parent / "make_csv_example.py"
    )
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main(tmp_path)
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (EXAMPLE / path.name).read_bytes()


def test_a_folder_is_read_exactly() -> None:
    (run,) = read_folder(EXAMPLE)
    assert tuple(run.channels) == CHANNELS
    assert run.rate_hz == 100
    assert len(run.accel_time_s) == 600
    line = ACCEL.splitlines()[123].split(",")
    assert run.accel_time_s[122] == float(line[0])
    assert [run.channels[name][122] for name in CHANNELS] == [float(field) for field in line[1:]]
    gps = [float(field) for field in GPS.splitlines()[30].split(",")]
    assert [float(column[29]) for column in run.gnss[:5]] == gps
    assert run.gnss.heading_deg is None


def test_the_independent_crossings_are_read(shared: Path) -> None:
    runs = {
        folder.name: read_folder(folder)
        for folder in (shared / "crossings").glob("d[1-9]_*")
        if folder.is_dir()
    }
    assert {name: len(found) for name, found in runs.items()} == {
        "d1_clean_const_speed": 1,
        "d2_mems_gps_bias": 1,
        "d3_edge_damage_4_runs": 4,
        "d4_bearings_that_give": 2,
        "d5_swinging_bridge": 1,
        "d6_leaf_springs": 2,
        "d7_two_spans": 1,
        "d8_real_road_12_runs": 12,
        "d9_everything_16_runs": 16,
    }
    for name, found in runs.items():
        for run in found:
            assert run.rate_hz == (1000 if name < "d4" else 500)
            assert tuple(run.channels) == CHANNELS
            within = 1.0 if name < "d4" else 2.0
            assert run.gnss.speed_m_per_s.mean() == pytest.approx(10.0, abs=within)
    starts = [run.accel_time_s[0] for run in runs["d3_edge_damage_4_runs"]]
    assert starts == sorted(starts)


def test_columns_are_the_channels_that_the_site_names(shared: Path) -> None:
    folder = shared / "crossings" / "d10_left_and_right_8_runs"
    channels = load_site(folder / "site.toml").vehicles[0].channels
    runs = read_folder(folder, channels=channels)
    assert len(runs) == 8
    assert all(set(run.channels) == set(channels) for run in runs)
    with pytest.raises(InputError, match='line 1: unknown column "sprung_front_right", the colu'):
        read_folder(folder)


def named_columns(folder: Path, header: str) -> tuple[Path, Path]:
    lines = ACCEL.splitlines()
    (folder / "accel_00.csv").write_text("\n".join([header, *lines[1:]]) + "\n")
    (folder / "gps_00.csv").write_text(GPS)
    return folder / "accel_00.csv", folder / "gps_00.csv"


def test_columns_are_named_in_any_order(tmp_path: Path) -> None:
    files = named_columns(tmp_path, "time_s,axle_1_left,f,r,axle_1_right")
    run = read_pair(*files, ("f", "r", "axle_1_left", "axle_1_right", "absent"))
    assert tuple(run.channels) == ("axle_1_left", "f", "r", "axle_1_right")
    with pytest.raises(InputError) as caught:
        read_pair(*files, ("f", "r", "axle_1_left"))
    assert str(caught.value) == (
        f'{files[0]}: line 1: unknown column "axle_1_right", the columns time_s and f, r, '
        "axle_1_left expected"
    )


def test_without_a_site_any_name_of_a_channel_will_do(tmp_path: Path) -> None:
    files = named_columns(tmp_path, "time_s,a,b,c,sprung_front")
    assert tuple(read_pair(*files, None).channels) == ("a", "b", "c", "sprung_front")
    for bad in ("Front", "latitude_deg"):
        files = named_columns(tmp_path, f"time_s,a,b,c,{bad}")
        with pytest.raises(InputError, match=f'unknown column "{bad}"'):
            read_pair(*files, None)


def test_a_named_channel_has_limits(tmp_path: Path) -> None:
    files = named_columns(tmp_path, "time_s,a,b,c,d")
    text = files[0].read_text().splitlines()
    fields = text[5].split(",")
    text[5] = ",".join([*fields[:2], "1e5", *fields[3:]])
    files[0].write_text("\n".join(text))
    with pytest.raises(InputError, match="line 6: b is 1e5, it must be an acceleration in m/s²"):
        read_pair(*files, ("a", "b", "c", "d"))


def test_columns_may_be_missing_and_in_any_order(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "unsprung_rear , time_s\r\n0.5,1790000001\r\n\r\n0.25,1790000002\r\n"
    )
    (tmp_path / "g.csv").write_bytes(b"\xef\xbb\xbf" + GPS.encode())
    run = read_pair(tmp_path / "a.csv", tmp_path / "g.csv")
    assert list(run.channels) == ["unsprung_rear"]
    assert run.channels["unsprung_rear"].tolist() == [0.5, 0.25]
    assert run.rate_hz == 1


@pytest.mark.parametrize(
    ("line", "column", "value", "words"),
    [
        (
            1,
            2,
            "sprung_middle",
            'accel_00.csv: line 1: unknown column "sprung_middle", the columns',
        ),
        (1, 2, "sprung_front", 'accel_00.csv: line 1: column "sprung_front" is there twice'),
        (1, 0, "time_ms", 'accel_00.csv: line 1: unknown column "time_ms"'),
        (1, 0, "unsprung", "accel_00.csv: line 1: unknown column"),
        (
            7,
            2,
            "nan",
            "accel_00.csv: line 7: sprung_rear is nan, it must be an acceleration in m/s²",
        ),
        (7, 4, "inf", "accel_00.csv: line 7: unsprung_rear is inf, it must be"),
        (7, 4, "1e9", "accel_00.csv: line 7: unsprung_rear is 1e9, it must be"),
        (7, 1, "", "accel_00.csv: line 7: sprung_front is empty, it must be"),
        (7, 1, "1_0", "accel_00.csv: line 7: sprung_front is 1_0, it must be"),
        (7, 1, "zwei", "accel_00.csv: line 7: sprung_front is zwei, it must be"),
        (7, 1, "1,2", "accel_00.csv: line 7: has 6 fields, 5 expected"),
        (
            9,
            0,
            "1790000000.060000",
            "accel_00.csv: line 9: time_s is 1790000000.060000, it must be l",
        ),
        (
            9,
            0,
            "1790000000.050000",
            "accel_00.csv: line 9: time_s is 1790000000.050000, it must be l",
        ),
        (2, 0, "12.5", "accel_00.csv: line 2: time_s is 12.5, it must be seconds since 1970 UTC"),
    ],
)
def test_wrong_accelerations_are_named(
    tmp_path: Path, line: int, column: int, value: str, words: str
) -> None:
    assert complaint(tmp_path, accel=with_field(ACCEL, line, column, value)).startswith(words)


@pytest.mark.parametrize(
    ("line", "column", "value", "words"),
    [
        (
            1,
            4,
            "speed_kmh",
            'gps_00.csv: line 1: unknown column "speed_kmh", the columns time_s, lat',
        ),
        (3, 1, "91", "gps_00.csv: line 3: latitude_deg is 91, it must be a latitude in degrees"),
        (3, 2, "NaN", "gps_00.csv: line 3: longitude_deg is NaN, it must be a longitude"),
        (3, 0, "1790000000.000", "gps_00.csv: line 3: time_s is 1790000000.000, it must be later"),
    ],
)
def test_wrong_positions_are_named(
    tmp_path: Path, line: int, column: int, value: str, words: str
) -> None:
    assert complaint(tmp_path, gps=with_field(GPS, line, column, value)).startswith(words)


def test_files_that_are_no_tables(tmp_path: Path) -> None:
    header = ACCEL.splitlines()[0]
    assert complaint(tmp_path, accel="").startswith("accel_00.csv: line 1: is empty")
    assert complaint(tmp_path, accel=header).startswith("accel_00.csv: has 0 lines of data")
    assert complaint(tmp_path, accel="\n".join(ACCEL.splitlines()[:2])).startswith(
        "accel_00.csv: has 1 lines of data, at least 2"
    )
    assert complaint(tmp_path, accel="time_s\n1790000000\n1790000001").startswith(
        "accel_00.csv: line 1: no accelerations"
    )
    assert complaint(tmp_path, accel=header.replace("time_s,", "")).startswith(
        'accel_00.csv: line 1: no column "time_s"'
    )
    assert complaint(tmp_path, gps="time_s,latitude_deg\n1,2").startswith(
        'gps_00.csv: line 1: no column "longitude_deg"'
    )
    assert complaint(tmp_path, accel=b"time_s,sprung_front\n\xff\xfe").startswith(
        "accel_00.csv: line 2: is not UTF-8 text"
    )


def test_positions_of_another_time(tmp_path: Path) -> None:
    line = complaint(tmp_path, gps=GPS.replace("17900000", "17900001"))
    assert line.startswith(
        "gps_00.csv: time_s goes from 1790000100.000 to 1790000105.900 s, it must"
    )


def test_folders_that_are_not_pairs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_folder(tmp_path / "none")
    with pytest.raises(InputError, match=r"holds no accel_NN\.csv"):
        read_folder(tmp_path)
    (tmp_path / "accel_00.csv").write_text(ACCEL)
    with pytest.raises(InputError, match=r"gps_00\.csv: no such file, positions for accel_00\.csv"):
        read_folder(tmp_path)
    (tmp_path / "gps_00.csv").write_text(GPS)
    (tmp_path / "gps_01.csv").write_text(GPS)
    with pytest.raises(InputError, match=r"accel_01\.csv: no such file"):
        read_folder(tmp_path)
    (tmp_path / "accel_01.csv").write_text(ACCEL)
    with pytest.raises(
        InputError, match=r"accel_01\.csv: begins at .* before .*accel_00\.csv ends"
    ):
        read_folder(tmp_path)


def outcome(folder: Path, accel: str, gps: str) -> Run | str:
    (folder / "a.csv").write_bytes(accel.encode("utf-8", "surrogatepass"))
    (folder / "g.csv").write_bytes(gps.encode("utf-8", "surrogatepass"))
    try:
        return read_pair(folder / "a.csv", folder / "g.csv")
    except InputError as error:
        return str(error)


def check(folder: Path, found: Run | str) -> None:
    """Whatever was read, it is a usable run or one line that names a file."""
    if isinstance(found, str):
        assert len(found.splitlines()) == 1
        assert found.startswith((f"{folder}/a.csv: ", f"{folder}/g.csv: "))
        return
    assert np.all(np.diff(found.accel_time_s) > 0)
    assert np.all(np.diff(found.gnss.time_s) > 0)
    for values in [*found.channels.values(), *found.gnss[:5]]:
        assert np.all(np.isfinite(values))
    assert {len(values) for values in found.channels.values()} == {len(found.accel_time_s)}


relaxed = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@relaxed
@given(accel=st.text(max_size=300), gps=st.text(max_size=300))
def test_any_text_is_a_run_or_one_line(tmp_path: Path, accel: str, gps: str) -> None:
    check(tmp_path, outcome(tmp_path, accel, GPS))
    check(tmp_path, outcome(tmp_path, ACCEL, gps))


fields = st.floats().map(repr) | st.text(max_size=6) | st.integers().map(str) | st.just("-0")


@relaxed
@given(line=st.integers(1, 40), column=st.integers(0, 4), field=fields, in_gps=st.booleans())
def test_any_field_is_accepted_or_named(
    tmp_path: Path, line: int, column: int, field: str, in_gps: bool
) -> None:
    accel = "\n".join(ACCEL.splitlines()[:41])
    if in_gps:
        check(tmp_path, outcome(tmp_path, accel, with_field(GPS, line, column, field)))
    else:
        check(tmp_path, outcome(tmp_path, with_field(accel, line, column, field), GPS))


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    """Nobody writes to it: reading would never end."""
    (tmp_path / "accel_00.csv").write_text(ACCEL)
    os.mkfifo(tmp_path / "gps_00.csv")
    with pytest.raises(InputError, match=r"gps_00\.csv: is not an ordinary file"):
        read_folder(tmp_path)
