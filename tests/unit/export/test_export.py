"""`driveby export`: what it writes says what was measured and found, and comes back by import."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from schemas.results import Results, load_results
from schemas.site_file import load_site
from services.cli import main as cli
from services.common.geodesy import bridge_frame, to_chainage
from services.drives.signals import signals_of_recording
from services.recordings.recording import read_messages, read_site
from services.recordings.writer import write_recording
from tests.builders.commands import run
from tests.unit.drives.recorded import drive


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def sample(project: Path) -> Path:
    return project / "recordings/sample/crossing.mcap"


@pytest.fixture
def results(tmp_path: Path, sample: Path) -> Path:
    """Results of the sample: one good crossing, one that was rejected."""
    return write_results(tmp_path / "found.json", sample)


def write_results(path: Path, sample: Path) -> Path:
    from schemas.site_file import parse_site, site_hash
    from services.recordings.recording import read_site

    toml = read_site(sample)
    assert toml is not None

    def value(mean: float, unit: str) -> dict[str, Any]:
        spread = {"std": 0.1 * mean, "q025": 0.8 * mean, "q50": mean, "q975": 1.2 * mean}
        return {"unit": unit, "mean": mean} | spread

    common = {
        "realm": "sim-drive", "vehicle": "truck-1", "bridge": "bridge-1", "method": "pre",
        "entry_time": 1.7e9 + 0.25, "exit_time": 1.7e9 + 4, "speed_m_per_s": 10.0,
    }  # fmt: skip
    good = common | {
        "crossing_id": "a", "direction": "start_to_end", "verdict": "good", "chi2_per_dof": 1.0,
        "parameters": {f"EI_{n}": value(n * 1e9, "N·m²") for n in range(1, 8)}
        | {"c_s1": value(2e4, "N·s/m")},
        "road": {
            "x_m": [0.0, 0.5], "front_m": [0.0, 1e-3], "rear_m": [0.0, 1e-3], "mean_m": [0.0, 1e-3],
            "iri_m_per_km": 2.5, "iso_class": "A",
        },
    }  # fmt: skip
    bad = common | {
        "crossing_id": "b", "direction": "end_to_start", "verdict": "rejected",
        "reasons": ["model_misfit"], "parameters": None,
    }  # fmt: skip
    elements = {
        f"EI_{n}": {"mean": n * 1e9, "std": 1e8, "q025": 0.8e9 * n, "q975": 1.2e9 * n}
        for n in range(1, 8)
    }
    content = {
        "version": "0", "created": 1.7e9, "site_hash": site_hash(parse_site(toml, "x")),
        "settings": {}, "seed": 1, "crossings": [good, bad],
        "bridges": {"bridge-1": elements | {"crossings_used": ["a"]}},
    }  # fmt: skip
    path.write_text(Results.model_validate(content).model_dump_json())
    return path


def test_csv_files_of_a_drive_are_imported_as_they_were(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, csv_example: Path
) -> None:
    """The example measures with gravity and signs of its own; what is exported does not."""
    site = csv_example / "site.toml"
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    assert run(capsys, "import", csv_example, "--site", site, "-o", first)[0] == 0
    folder = tmp_path / "new" / "tables"
    code, out, err = run(capsys, "export", first, "--to", folder)
    assert (code, err) == (0, "")
    assert f"{folder / 'accel_00.csv'}: 600 rows\n" in out
    again = ("import", folder, "--site", folder / "site.toml", "-o", second)
    assert run(capsys, *again)[0] == 0
    (was,), (is_now,) = signals_of_recording(first), signals_of_recording(second)
    assert was.channels.keys() == is_now.channels.keys()
    for name, (time_ns, values) in was.channels.items():
        np.testing.assert_array_equal(is_now.channels[name].time_ns, time_ns)
        np.testing.assert_array_equal(is_now.channels[name].acceleration_m_per_s2, values)
    np.testing.assert_array_equal(is_now.fixes.latitude_deg, was.fixes.latitude_deg)
    np.testing.assert_array_equal(is_now.fixes.speed_m_per_s, was.fixes.speed_m_per_s)


def test_parquet_holds_all_runs_with_exact_times(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "two.mcap"
    both = [*drive(leave_out=range(100, 130)), *drive("truck-2", begin_s=0.5)]
    write_recording(path, both, site_toml=None, reason="test")
    code, out, _ = run(capsys, "export", path, "--to", tmp_path / "t", "--format", "parquet")
    assert code == 0
    assert "no site file: positions of bridges are unknown, so no GeoJSON is written" in out
    table = pq.read_table(tmp_path / "t" / "accelerations.parquet").to_pandas()
    assert len(table) == (170 + 200) * 50
    assert set(table["vehicle"]) == {"truck-1", "truck-2"}
    (one, _) = signals_of_recording(path)
    ours = table[table["vehicle"] == "truck-1"]
    np.testing.assert_array_equal(
        ours["time"].astype("int64"), one.channels["sprung_front"].time_ns
    )
    assert str(table["time"].dtype) == "datetime64[ns, UTC]"
    assert table["sprung_rear"].isna().all()  # a channel that the truck lacks
    fixes = pq.read_table(tmp_path / "t" / "fixes.parquet").to_pandas()
    assert len(fixes) == 200
    assert fixes["heading_deg"].isna().all()


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_results_are_tables_with_places_and_ratios(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, sample: Path, results: Path, form: str
) -> None:
    to = tmp_path / "t"
    assert run(capsys, "export", sample, results, "--to", to, "--format", form)[0] == 0

    def table(name: str) -> list[dict[str, Any]]:
        if form == "csv":
            return list(rows(to / f"{name}.csv"))
        return pq.read_table(to / f"{name}.parquet").to_pylist()  # type: ignore[no-any-return]

    nominal = load_results_nominal(sample)
    elements = table("elements")
    assert [row["element"] for row in elements] == [f"EI_{n}" for n in range(1, 8)]
    assert float(elements[3]["from_m"]) == pytest.approx(3 * 30 / 7)
    assert float(elements[3]["to_m"]) == pytest.approx(4 * 30 / 7)
    assert float(elements[3]["ratio"]) == pytest.approx(4e9 / nominal)
    assert float(elements[3]["ei_q975_nm2"]) == pytest.approx(4.8e9)
    good, bad = table("crossings")
    assert (good["verdict"], bad["verdict"], bad["reasons"]) == ("good", "rejected", "model_misfit")
    assert bad["chi2_per_dof"] in ("", None)
    if form == "csv":
        assert good["entry_s"] == "1700000000.250000000"
    else:
        assert good["entry"].timestamp() == 1_700_000_000.25
    assert {row["name"] for row in table("parameters")} >= {"EI_1", "c_s1"}
    assert [float(row["x_m"]) for row in table("roads")] == [0.0, 0.5]
    assert [row["crossings_used"] for row in table("bridges")] == ["a"] * 7


def load_results_nominal(sample: Path) -> float:
    from schemas.site_file import parse_site
    from services.recordings.recording import read_site

    return parse_site(read_site(sample) or "", "x").bridges[0].nominal_flexural_rigidity_nm2[0]


def test_on_a_map_elements_are_where_they_are(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, sample: Path, results: Path
) -> None:
    assert run(capsys, "export", sample, results, "--to", tmp_path / "t")[0] == 0
    site = load_site(tmp_path / "t" / "site.toml")
    frame = bridge_frame(site.bridges[0])

    def chainages(feature: dict[str, Any]) -> list[float]:
        assert feature["geometry"]["type"] == "LineString"
        longitude, latitude = zip(*feature["geometry"]["coordinates"], strict=True)
        along, beside = to_chainage(frame, latitude, longitude)
        assert np.abs(beside).max() < 1e-3
        return [float(x) for x in along]

    elements = json.loads((tmp_path / "t" / "elements.geojson").read_text())
    assert elements["type"] == "FeatureCollection"
    for number, feature in enumerate(elements["features"]):
        ends = [number * 30 / 7, (number + 1) * 30 / 7]
        assert chainages(feature) == pytest.approx(ends, abs=1e-3)
        assert feature["properties"]["ei_mean_nm2"] == (number + 1) * 1e9
    there, back = json.loads((tmp_path / "t" / "crossings.geojson").read_text())["features"]
    assert chainages(there) == pytest.approx([0.0, 30.0], abs=1e-3)
    assert chainages(back) == pytest.approx([30.0, 0.0], abs=1e-3)  # in the direction of travel
    assert there["properties"]["entry_time"] == "2023-11-14T22:13:20.250Z"
    assert back["properties"]["reasons"] == ["model_misfit"]


def test_without_results_crossings_are_those_in_the_positions(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, sample: Path
) -> None:
    assert run(capsys, "export", sample, "--to", tmp_path / "t")[0] == 0
    (feature,) = json.loads((tmp_path / "t" / "crossings.geojson").read_text())["features"]
    assert feature["properties"]["verdict"] is None
    assert feature["properties"]["entry_time"].startswith("2026-01-01T00:00:02.")
    elements = json.loads((tmp_path / "t" / "elements.geojson").read_text())["features"]
    assert {feature["properties"]["ei_mean_nm2"] for feature in elements} == {None}


def test_results_alone_find_their_site_beside_them_or_do_without(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, sample: Path
) -> None:
    alone = write_results(tmp_path / "found.json", sample)
    code, out, _ = run(capsys, "export", alone, "--to", tmp_path / "t")
    assert (code, "no GeoJSON" in out) == (0, True)
    assert rows(tmp_path / "t" / "elements.csv")[0]["from_m"] == ""
    (tmp_path / "drive.mcap").write_bytes(sample.read_bytes())
    code, out, _ = run(capsys, "export", alone, "--to", tmp_path / "t")
    assert (code, "no GeoJSON" in out) == (0, False)
    assert rows(tmp_path / "t" / "elements.csv")[0]["from_m"] == "0.0"


def test_what_cannot_be_exported_is_one_line(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    sample: Path,
    results: Path,
    csv_example: Path,
) -> None:
    stale = tmp_path / "stale"
    stale.mkdir()
    (stale / "accel_01.csv").touch()
    (tmp_path / "file").touch()
    to = ("--to", tmp_path / "t")
    for arguments, words in (
        ((sample, "--to", stale), "holds accel_01.csv of another drive"),
        ((sample, "--to", tmp_path / "file"), "is a file, give the name of a folder"),
        ((results, results.with_name("x.json"), *to), "is a second results file; fuse them first"),
        ((results, results.with_name("x.json"), *to), f"driveby fuse {results} "),
        ((tmp_path / "none.mcap", *to), "no such file"),
        ((tmp_path / "none.json", *to), "no such file"),
        (
            (results, "--site", csv_example / "site.toml", *to),
            "found.json: has results of bridge-1, which",
        ),
    ):
        code, out, err = run(capsys, "export", *arguments)
        assert (code, out) == (2, ""), words
        assert words in err
        assert err.count("\n") == 1
    assert not (tmp_path / "t").exists()
    assert load_results(results).crossings


def test_a_recording_whose_sequences_run_backwards_is_exported_by_time(
    sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A clock that is set back gives such batches; rows are in the order of time all the same."""
    messages = list(read_messages(sample))
    last = max(message.sequence for message in messages)
    backwards = tmp_path / "backwards.mcap"
    write_recording(
        backwards,
        [message._replace(sequence=last - message.sequence) for message in messages],
        site_toml=read_site(sample),
        reason="test",
    )
    out: list[dict[str, str]] = []
    for path in (sample, backwards):
        folder = tmp_path / path.stem
        assert cli.main(["export", str(path), "--to", str(folder)]) == 0
        capsys.readouterr()
        out.append({one.name: one.read_text() for one in folder.glob("*.csv")})
    assert out[0] == out[1]
