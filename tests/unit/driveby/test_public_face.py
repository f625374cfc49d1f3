"""`import driveby`: what a notebook gets, and that it gets the same numbers as the command line."""

import ast
import inspect
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import driveby
from schemas.results import (
    CrossingResult,
    ElementState,
    Parameter,
    Prior,
    ResultHeader,
    Results,
    results,
)
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS
from schemas.topics import Message
from schemas.validation_records import METHOD_EDITION
from services.cli import main as cli
from services.common import extras
from services.common.extras import install_command
from services.common.field_docs import with_field_docs
from services.notebook import identify as identifying
from services.notebook import inference
from services.notebook import simulate as simulating
from services.recordings.recording import read_messages
from services.recordings.writer import write_recording
from services.simulation import drive as driving
from services.simulation.drive import SimulatedDrive, declared_site, paper_site
from tests.unit.identification.test_fusing import crossing, write


@pytest.fixture(scope="module")
def simulation(scenario_6: SimulatedDrive) -> driveby.Simulation:
    """Without noise: least squares find what was put in."""
    return driveby.Simulation(scenario_6, paper_site())


@pytest.fixture(scope="module")
def sample(request: pytest.FixtureRequest) -> Path:
    project: Path = request.getfixturevalue("project")
    return project / "recordings" / "sample" / "crossing.mcap"


@pytest.fixture(scope="module")
def found(sample: Path) -> driveby.Identification:
    return driveby.identify(sample)


@pytest.fixture(scope="module")
def exact(simulation: driveby.Simulation) -> driveby.Identification:
    return driveby.identify(simulation, method="least-squares")


def without(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    """As if these had not been installed."""
    find = extras.find_spec
    monkeypatch.setattr(extras, "find_spec", lambda m: None if m in modules else find(m))


def test_import_waits_for_nothing() -> None:
    code = (
        "import sys, driveby\n"
        "print(sorted({'numpy', 'numba', 'scipy', 'pandas', 'xarray', 'matplotlib', 'pydantic'}"
        " & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_every_name_is_there_and_typed_as_what_it_is() -> None:
    """A type checker reads the imports, Python the table of places: both must say the same."""
    source = ast.parse(Path(driveby.__file__).read_text())
    (block,) = (node for node in source.body if isinstance(node, ast.If))
    typed = {
        alias.name: statement.module
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
    assert typed == driveby._PLACES
    assert sorted(typed) == sorted(driveby.__all__)
    for name in driveby.__all__:
        assert getattr(driveby, name) is not None
        assert name in dir(driveby)
    assert driveby.__version__
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = driveby.nothing


def test_help_explains_every_field() -> None:
    """Python's own docstring of a field is "Alias for field number 0"."""
    named = [
        value for value in map(driveby.__getattr__, driveby.__all__) if hasattr(value, "_fields")
    ]
    assert len(named) == 6
    for one in named:
        for field in one._fields:
            text = getattr(one, field).__doc__
            assert text.endswith("."), f"{one.__name__}.{field}: {text}"
    assert driveby.Solution.draws.__doc__ == (
        "Draws of each parameter, arrays (chain, draw).\n\n"
        "They are empty for a rejected crossing, without `draws=True`, and for methods without "
        "draws\n(`least_squares`, `random_walk`)."
    )


def test_class_without_source_keeps_its_docstrings() -> None:
    names: dict[str, Any] = {"__name__": "frozen"}
    exec("from typing import NamedTuple\nclass One(NamedTuple):\n    a: int\n", names)  # noqa: S102
    assert with_field_docs(names["One"]).a.__doc__ == "Alias for field number 0"


# -- read


def test_a_recording_reads_as_what_was_measured(
    simulation: driveby.Simulation, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    simulation.write(path)
    (read,) = driveby.read(path)
    measured = simulation.signals
    assert (read.source, read.vehicle, read.run) == (str(path), "truck-1", 0)
    assert tuple(read.channels) == CHANNELS == driveby.CHANNELS
    for name, series in read.channels.items():
        np.testing.assert_array_equal(
            series.acceleration_m_per_s2, measured.channels[name].acceleration_m_per_s2
        )
        np.testing.assert_array_equal(series.time_ns, measured.channels[name].time_ns)
    for mine, theirs in zip(read.fixes, measured.fixes, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_tables_of_a_recording(sample: Path) -> None:
    (read,) = driveby.read(str(sample))
    table = read.accelerations()
    assert list(table.columns) == list(CHANNELS)
    assert str(table.index.dtype) == "datetime64[ns, UTC]"
    assert table.index[0].isoformat() == "2026-01-01T00:00:00+00:00"
    assert (table.index[1] - table.index[0]).total_seconds() == 0.001
    assert not table.isna().any().any()
    positions = read.positions()
    assert len(positions) == read.fixes.time_ns.size
    assert positions["latitude_deg"].iloc[0] == read.fixes.latitude_deg[0]
    assert positions["speed_m_per_s"].mean() == pytest.approx(11, abs=2)


@pytest.fixture
def two_boots(sample: Path, tmp_path: Path) -> Path:
    """The sample's messages, out of order, some twice, and a later boot of the same truck."""
    messages = [m for m in read_messages(sample) if m.key.stream in ("accel", "gnss")]
    later = [again(m) for m in messages]
    path = tmp_path / "two.mcap"
    write_recording(path, [*later, *messages[::-1], *messages[:40]], site_toml=None, reason="test")
    return path


def again(message: Message) -> Message:
    from schemas.signals import decode_accel, decode_gnss, encode_accel, encode_gnss

    hour = 3_600_000_000_000
    boot = message.boot_id + hour
    if message.key.stream == "accel":
        batch = decode_accel(message.payload)
        moved = batch._replace(boot_id=boot, wall_time_ns=batch.wall_time_ns + hour)
        payload = encode_accel(moved)
    else:
        fix = decode_gnss(message.payload)
        payload = encode_gnss(fix._replace(boot_id=boot, wall_time_ns=fix.wall_time_ns + hour))
    return message._replace(payload=payload, boot_id=boot, log_time_ns=message.log_time_ns + hour)


def test_each_boot_is_a_run_in_order_and_without_repetitions(sample: Path, two_boots: Path) -> None:
    (only,) = driveby.read(sample)
    first, second = driveby.read(two_boots)
    assert (first.run, second.run) == (0, 1)
    for read, hours in ((first, 0), (second, 1)):
        for name, series in read.channels.items():
            expected = only.channels[name]
            np.testing.assert_array_equal(
                series.time_ns, expected.time_ns + hours * 3_600_000_000_000
            )
            np.testing.assert_array_equal(
                series.acceleration_m_per_s2, expected.acceleration_m_per_s2
            )
        np.testing.assert_array_equal(read.fixes.latitude_deg, only.fixes.latitude_deg)


def test_channels_of_two_rates_stand_in_one_table(simulation: driveby.Simulation) -> None:
    signals = simulation.signals
    slow = signals.channels["unsprung_rear"]
    slow = slow._replace(
        time_ns=slow.time_ns[::2], acceleration_m_per_s2=slow.acceleration_m_per_s2[::2]
    )
    mixed = signals._replace(channels={**signals.channels, "unsprung_rear": slow})
    table = mixed.accelerations()
    assert len(table) == signals.channels["sprung_front"].time_ns.size
    assert table["unsprung_rear"].isna().to_numpy().tolist()[:4] == [False, True, False, True]
    assert not table["sprung_front"].isna().any()


def with_gravity(path: Path, up: list[float]) -> None:
    """Let the accelerometers of a file feel gravity, mounted this way up."""
    heading, *lines = path.read_text().splitlines()
    rows = [[float(cell) for cell in line.split(",")[1:]] for line in lines]
    felt = np.array(rows) + 9.80665 * np.array(up)
    times = [line.split(",")[0] for line in lines]
    text = [
        ",".join([time_s, *(f"{a:.6f}" for a in row)])
        for time_s, row in zip(times, felt, strict=True)
    ]
    path.write_text("\n".join([heading, *text, ""]))


def test_folder_that_needs_options_is_referred_to_import(csv_example: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(csv_example, tmp_path / "folder")
    for path in (folder / "accel_00.csv", folder / "gps_00.csv"):
        head, *rows = path.read_text().splitlines()
        cells = [row.split(",", 1) for row in rows]
        dated = [
            f"{datetime.fromtimestamp(float(s), UTC):%d.%m.%Y %T.%f},{rest}" for s, rest in cells
        ]
        path.write_text("\n".join([head, *dated, ""]))
    words = "give --zone UTC.*these are options of driveby import: convert the folder with it"
    for function in (driveby.read, driveby.identify):
        with pytest.raises(driveby.InputError, match=words):
            function(folder)


def test_a_folder_is_read_as_its_site_file_says(csv_example: Path, tmp_path: Path) -> None:
    (plain,) = driveby.read(csv_example)
    assert plain.vehicle != ""
    folder = shutil.copytree(csv_example, tmp_path / "folder")
    site = folder / "site.toml"
    text = site.read_text().replace(
        "[sensor]", "[sensor]\nup = [1, 1, -1, -1]\ngravity_included = true"
    )
    site.write_text(text)
    with_gravity(folder / "accel_00.csv", [1.0, 1.0, -1.0, -1.0])
    (turned,) = driveby.read(folder)
    measured = plain.channels["unsprung_front"].acceleration_m_per_s2 - 9.80665
    np.testing.assert_allclose(
        turned.channels["unsprung_front"].acceleration_m_per_s2, -measured - 9.80665, atol=1e-9
    )
    elsewhere = site.rename(tmp_path / "elsewhere.toml")
    (raw,) = driveby.read(folder)
    assert raw.vehicle == ""
    np.testing.assert_allclose(
        raw.channels["unsprung_front"].acceleration_m_per_s2, measured, atol=1e-9
    )
    for site_given in (elsewhere, str(elsewhere), driveby.load_site(elsewhere)):
        (given,) = driveby.read(folder, site=site_given)
        np.testing.assert_array_equal(
            given.channels["unsprung_front"].acceleration_m_per_s2,
            turned.channels["unsprung_front"].acceleration_m_per_s2,
        )


def test_the_independent_crossings_are_read(shared: Path) -> None:
    runs = driveby.read(shared / "crossings" / "d3_edge_damage_4_runs")
    assert [run.run for run in runs] == [0, 1, 2, 3]
    assert {run.vehicle for run in runs} == {"truck-3"}
    assert all(np.diff(run.fixes.time_ns).min() > 0 for run in runs)


# -- identify


def test_draws_results_and_tables_say_the_same(
    found: driveby.Identification, sample: Path, tmp_path: Path
) -> None:
    (solution,) = found.solutions
    assert (solution.verdict, solution.reasons) == ("good", ())
    assert solution.stats["r_hat"] < 1.05
    table = found.elements()
    assert list(table.columns) == [
        *("crossing", "bridge", "vehicle", "method", "verdict", "element", "from_m", "to_m"),
        *("mean", "std", "q025", "q50", "q975", "nominal", "ratio"),
    ]
    assert list(table["element"]) == [f"EI_{n}" for n in range(1, 8)]
    assert table["to_m"].iloc[-1] == pytest.approx(30.0)
    assert list(table["from_m"].iloc[1:]) == pytest.approx(list(table["to_m"].iloc[:-1]))
    fourth = table.iloc[3]
    assert fourth["ratio"] == pytest.approx(0.4, abs=0.05)
    draws = solution.draws["EI_4"]
    assert fourth["mean"] == pytest.approx(draws.mean(), rel=1e-12)
    assert fourth["std"] == pytest.approx(draws.std(), rel=1e-12)
    for column, share in (("q025", 0.025), ("q50", 0.5), ("q975", 0.975)):
        assert fourth[column] == pytest.approx(np.quantile(draws, share), rel=1e-12)
    unknowns = found.parameters().set_index("name")
    assert unknowns["mean"]["EI_4"] == fourth["mean"]
    assert unknowns["unit"]["k_s1"] == "N/m"
    one = solution.posterior()
    assert one["EI_4"].dims == ("chain", "draw")
    np.testing.assert_array_equal(one["EI_4"], draws)
    whole = found.posterior()
    assert whole["EI_4"].dims == ("chain", "draw", "crossing")
    assert list(whole["crossing"].values) == [solution.crossing.crossing_id]
    assert table.equals(solution.elements())


def test_the_command_line_says_the_same(
    found: driveby.Identification, sample: Path, tmp_path: Path
) -> None:
    paths = [tmp_path / name for name in ("a.json", "b.json", "a.nc", "b.nc")]
    assert (
        cli.main(["identify", str(sample), "--json", str(paths[0]), "--draws", str(paths[2])]) == 0
    )
    found.to_json(paths[1])
    found.to_netcdf(paths[3])
    mine, theirs = (json.loads(path.read_text()) for path in paths[:2])
    for result in (mine, theirs):
        del result["created"]
        del result["crossings"][0]["diagnostics"]["seconds"]
    assert mine == theirs
    import arviz

    first, second = (arviz.from_netcdf(path) for path in paths[2:])
    assert first.groups() == second.groups() == ["posterior", "sample_stats", "prior"]
    assert first.prior.equals(second.prior)
    assert first.posterior.equals(second.posterior)
    for group in (first.posterior, second.sample_stats):
        assert group.attrs["inference_library_version"] == mine["version"]
        assert group.attrs["site_hash"] == mine["site_hash"]
        assert json.loads(group.attrs["settings"]) == mine["settings"]
    assert mine["settings"]["method_edition"] == METHOD_EDITION
    assert first.posterior.equals(found.posterior())


def as_in_the_terminal(found: Parameter | ElementState, nominal: float) -> list[str]:
    mean, low, high = (f"{value / 1e9:.2f}" for value in (found.mean, found.q025, found.q975))
    return [mean, f"{low} to {high}", f"{found.mean / nominal:.3f}"]


def test_every_draw_has_its_estimate_and_its_prior(found: driveby.Identification) -> None:
    """Wheelbase and slow error of the receiver are parameters like all others."""
    (solution,) = found.solutions
    prior = found.prior()
    assert set(prior) == set(found.posterior())
    receiver, vehicle = found.site.receiver, found.site.vehicles[0]
    late_m = receiver.latency_spread_s * solution.crossing.speed_m_per_s
    expected = {
        "wheelbase_m": ("log_normal", vehicle.wheelbase_m, vehicle.wheelbase_m_spread),
        "position_offset_m": ("normal", 0.0, np.hypot(receiver.position_spread_m, late_m)),
    }
    for name, (distribution, location, scale) in expected.items():
        value = solution.value[name]
        assert (value.unit, value.prior.distribution) == ("m", distribution)
        assert value.prior.location == location
        assert value.prior.scale == pytest.approx(scale, rel=1e-2)
        assert value.mean == pytest.approx(solution.draws[name].mean(), rel=1e-9)
        assert prior[name].attrs["units"] == "m"


def test_results_are_short_in_a_notebook(
    found: driveby.Identification, simulation: driveby.Simulation
) -> None:
    """All of it was 212,951 characters."""
    (solution,) = found.solutions
    for one in (found, solution, simulation, simulation.signals):
        assert len(repr(one)) < 500
    assert f"{solution.crossing.crossing_id}: good" in repr(found)
    assert repr(solution) in repr(found)
    many = found._replace(solutions=(solution,) * 1000)
    assert repr(many).endswith("980 more")
    for page in (found._repr_html_(), solution._repr_html_()):
        assert len(page) < 5000
        assert page.count("<tr>") == 8
        (row,) = re.findall("<td>EI_4</td><td>12.9 to 17.1</td>(.*?)</tr>", page)
        assert re.findall(r"<td>(.*?)</td>", row) == as_in_the_terminal(
            solution.value["EI_4"], 15.6e9
        )
    assert "980 more crossings" in many._repr_html_()
    mass = {"prior_z_rhoA": 25.5}
    far = solution.crossing.model_copy(update={"diagnostics": mass})
    assert (
        "<li>The estimate of the mass per length" in solution._replace(crossing=far)._repr_html_()
    )
    named = solution.crossing.model_copy(update={"vehicle": "<b>x</b>"})
    assert "<b>x" not in solution._replace(crossing=named)._repr_html_()


def test_draws_may_be_forgotten(
    exact: driveby.Identification,
    simulation: driveby.Simulation,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    chains = {"EI_1": np.ones((2, 3))}

    def found_at_once(*arguments: Any) -> Any:
        executor = arguments[3]
        executor._keep(exact.results.crossings[0].crossing_id, chains)
        return exact.results

    monkeypatch.setattr(identifying, "identify_drives", found_at_once)
    assert driveby.identify(simulation).solutions[0].draws == chains
    forgetful = driveby.identify(simulation, draws=False)
    assert forgetful.solutions[0].draws == {}
    with pytest.raises(driveby.InputError, match="no crossing has draws"):
        forgetful.to_netcdf(tmp_path / "draws.npz")
    needing = (driveby.plot_posterior, driveby.plot_chains, driveby.Identification.posterior)
    for function in needing:
        with pytest.raises(
            driveby.InputError, match=r"method pre has, with identify\(\.\.\., draws=T"
        ):
            function(forgetful)


def test_every_method_gives_the_same_type(
    found: driveby.Identification,
    exact: driveby.Identification,
    simulation: driveby.Simulation,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quick = IdentificationSettings(method="random_walk", particles=8, steps=3)
    monkeypatch.setattr(identifying, "_settings", lambda method, seed: quick)
    walked = driveby.identify(simulation, method="random_walk")
    columns = list(found.elements().columns)
    for one in (found, exact, walked):
        (solution,) = one.solutions
        assert isinstance(solution, driveby.Solution)
        assert solution.value["EI_4"].mean == one.elements()["mean"][3]
        assert solution.stats["iterations"] >= 3
        assert list(one.elements().columns) == columns
        if one is found:
            assert set(one.posterior().data_vars) == set(solution.draws)
            assert set(solution.posterior().data_vars) == set(solution.draws)
            continue
        for call in (one.posterior, solution.posterior):
            with pytest.raises(driveby.InputError, match="no crossing has draws; method pre has"):
                call()
    assert exact.elements()["ratio"].to_list() == pytest.approx([1, 1, 1, 0.4, 1, 1, 1], rel=0.01)


def test_an_interval_without_meaning_is_no_number(exact: driveby.Identification) -> None:
    (solution,) = exact.solutions
    assert solution.value["EI_4"].std > 0  # as in results.json
    table = exact.elements()
    assert table[["std", "q025", "q975"]].isna().all().all()
    assert not table[["mean", "q50", "ratio"]].isna().any().any()


def test_a_rejected_crossing_has_rows_without_numbers(sample: Path) -> None:
    rejected = driveby.identify(sample, method="least_squares")
    (solution,) = rejected.solutions
    assert (solution.verdict, solution.value, solution.draws) == ("rejected", {}, {})
    table = rejected.elements()
    assert list(table["verdict"]) == ["rejected"] * 7
    assert table[["mean", "std", "q025", "q50", "q975", "ratio"]].isna().all().all()
    assert rejected.parameters().empty


def test_a_folder_with_its_site_is_identified(
    simulation: driveby.Simulation, exact: driveby.Identification, tmp_path: Path
) -> None:
    from schemas.site_file import site_toml

    signals = simulation.signals
    time = next(iter(signals.channels.values())).time_ns / 1e9
    columns = np.stack([time, *(c.acceleration_m_per_s2 for c in signals.channels.values())])
    header = ",".join(["time_s", *signals.channels])
    write = {"delimiter": ",", "comments": "", "fmt": "%.17g"}
    np.savetxt(tmp_path / "accel_00.csv", columns.T, header=header, **write)
    fixes = np.stack([signals.fixes.time_ns / 1e9, *signals.fixes[1:5]])
    header = "time_s,latitude_deg,longitude_deg,altitude_m,speed_mps"
    np.savetxt(tmp_path / "gps_00.csv", fixes.T, header=header, **write)
    with pytest.raises(driveby.InputError, match="no site file is stored with it"):
        driveby.identify(tmp_path, method="least_squares")
    (tmp_path / "site.toml").write_text(site_toml(simulation.site))
    same = driveby.identify([tmp_path], method="least_squares")
    assert same.elements()["mean"].to_list() == pytest.approx(
        exact.elements()["mean"].to_list(), rel=1e-9
    )


# -- simulate and plot


def test_simulate_is_the_command(tmp_path: Path) -> None:
    mine, theirs = tmp_path / "a.mcap", tmp_path / "b.mcap"
    options = ["--noise", "25", "--gps-noise", "--speed", "12:14", "--seed", "3", "--rate", "200"]
    options += ["--direction", "end_to_start", "--road", "B"]
    ratios = [1.0, 1.0, 0.5, 1.0, 1.0, 1.0, 1.0]
    ei = ["--ei", ",".join(str(ratio) for ratio in ratios)]
    assert cli.main(["simulate", *ei, *options, "-o", str(theirs)]) == 0
    simulation = driveby.simulate(
        ei=ratios,
        noise=25.0,
        gps_noise=True,
        speed=(12.0, 14.0),
        seed=3,
        rate=200.0,
        direction="end_to_start",
        road="B",
    )
    simulation.write(mine)
    assert mine.read_bytes() == theirs.read_bytes()
    assert simulation.ei_ratios.tolist() == ratios
    with pytest.raises(driveby.InputError, match=r"is replaced only with force=True;"):
        simulation.write(mine)
    simulation.write(mine, force=True)
    assert mine.read_bytes() == theirs.read_bytes()


def test_arrays_and_lists_stand_for_numbers_as_tuples_do(
    scenario_6: SimulatedDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, int, Any]] = []

    def spy(_: object, ratios: Any, road: Any, *__: object, **options: Any) -> SimulatedDrive:
        asked.append((ratios, road.seed, options["speed_m_per_s"]))
        return scenario_6

    monkeypatch.setattr(simulating, "simulate_drive", spy)
    ratios = [1.0, 1.0, 0.4, 1.0, 1.0, 1.0, 1.0]
    for kind in (list, tuple, np.array):
        driveby.simulate(ei=kind(ratios), speed=kind([9.0, 11.0]), seed=np.int64(3))
        found, seed, speed = asked.pop()
        assert (found.tolist(), seed, speed) == (ratios, 3, (9.0, 11.0))
    driveby.simulate(scenario=np.int64(6), speed=np.float32(12.0))
    assert asked.pop()[1:] == (1, (12.0, 12.0))


@pytest.mark.parametrize("speed", [2.5, (2.0, 3.0)])
def test_simulation_too_slow_to_be_identified_brings_a_warning(
    speed: float | tuple[float, float], scenario_6: SimulatedDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulating, "simulate_drive", lambda *_, **__: scenario_6)
    words = r"speed is 2\.5 m/s on average: identify\(\) rejects crossings below 3 m/s"
    with pytest.warns(UserWarning, match=words) as warned:
        driveby.simulate(scenario=6, speed=speed)
    assert [one.filename for one in warned] == [__file__]
    driveby.simulate(scenario=6, speed=3.0)  # a warning would be an error


def test_true_profile_of_the_opposite_direction_has_the_mirrored_range(
    simulation: driveby.Simulation,
) -> None:
    """As docs/python.md states for a given profile, which must reach as far."""
    opposite = driveby.simulate(scenario=6, direction="end_to_start")
    forward_m, backward_m = (one.road_m[0] for one in (simulation, opposite))
    assert (forward_m[0], forward_m[-1] - 30.0) == pytest.approx((-66.0, 35.0), abs=0.5)
    assert (backward_m[-1] - 30.0, -backward_m[0]) == pytest.approx((66.0, 35.0), abs=0.5)


def test_simulate_is_exact_by_default(
    scenario_6: SimulatedDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def spy(*arguments: object, **_: object) -> SimulatedDrive:
        asked[:] = arguments
        return scenario_6

    monkeypatch.setattr(simulating, "simulate_drive", spy)
    simulation = driveby.simulate(scenario=6)
    measured = asked[3]
    assert (measured.noise_ug_per_rthz, measured.has_receiver_errors) == (0.0, False)
    assert simulation.site == driveby.simulate(scenario=6, noise=0.0).site
    assert simulation.site != driveby.simulate(scenario=6, noise=1.0).site


def test_simulate_drives_over_a_given_profile(
    scenario_6: SimulatedDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def spy(*arguments: object, **_: object) -> SimulatedDrive:
        asked[:] = arguments
        return scenario_6

    monkeypatch.setattr(simulating, "simulate_drive", spy)
    x_m = np.arange(-50.0, 90.0, 0.05)
    driveby.simulate(scenario=6, road=(x_m, 0.002 * np.sin(x_m)))
    driven = driving._profile(-61.3, 75.2, asked[2].kind, 1)
    assert np.allclose(np.diff(driven.x_m), 0.01)
    assert (driven.x_m[0], driven.x_m[-1]) == pytest.approx((-62.0, 76.0))
    inside = (driven.x_m > -50.0) & (driven.x_m < 89.0)
    assert np.allclose(driven.height_m[inside], 0.002 * np.sin(driven.x_m[inside]), atol=1e-6)
    assert np.ptp(driven.height_m[driven.x_m < -50.0]) == 0.0


def test_simulate_computes_with_one_thread_of_blas(
    scenario_6: SimulatedDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside: list[int] = []

    def spy(*_: object, **__: object) -> SimulatedDrive:
        inside.extend(x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas")
        return scenario_6

    monkeypatch.setattr(simulating, "simulate_drive", spy)
    with threadpool_limits(limits=2, user_api="blas"):
        driveby.simulate(scenario=6)
    assert set(inside) == {1}


def test_plot_draws_estimate_and_truth(
    exact: driveby.Identification, simulation: driveby.Simulation
) -> None:
    def labels(figure: Any) -> set[str]:
        legend = figure.axes[0].get_legend()
        return {text.get_text() for text in legend.get_texts()}

    assert "truth" in labels(driveby.plot(exact, truth=simulation))
    figure = driveby.plot(exact.solutions[0])
    assert "estimate, doubtful" in labels(figure)  # without a noise model it is
    assert "truth" not in labels(figure)
    tilted = simulation.drive.road._replace(
        height_m=simulation.drive.road.height_m + 0.02 + 1e-3 * simulation.drive.road.x_m
    )
    errors = [
        next(one.get_ydata() for one in shown.axes[2].lines if "truth" in str(one.get_label()))
        for shown in (
            driveby.plot(exact, truth=simulation),
            driveby.plot(
                exact, truth=simulation._replace(drive=simulation.drive._replace(road=tilted))
            ),
        )
    ]
    road = exact.solutions[0].crossing.road
    assert road is not None
    panel = driveby.plot(
        exact, truth=simulation._replace(drive=simulation.drive._replace(road=tilted))
    )
    (true_mm,) = (one.get_ydata() for one in panel.axes[1].lines if one.get_label() == "truth")
    apart_mm = np.asarray(true_mm) - 1e3 * np.array(road.mean_m)
    assert abs(np.polynomial.Polynomial.fit(road.x_m, apart_mm, 2).coef).max() < 1e-9
    assert np.nanmax(np.abs(errors[0] - errors[1])) < 1e-6 * np.nanmax(np.abs(errors[0]))
    assert (
        "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()
    )
    twice = exact._replace(solutions=exact.solutions * 2)
    with pytest.raises(driveby.InputError, match="plot draws one crossing, these are 2"):
        driveby.plot(twice)


def test_site_without_noise_is_warned_of_before_pre(
    simulation: driveby.Simulation,
    exact: driveby.Identification,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(identifying, "identify_drives", lambda *_: exact.results)
    quiet = simulation._replace(site=declared_site(simulation.site, 0.0, 1000.0))
    with pytest.warns(UserWarning, match="sensors without noise, which method pre cannot use") as w:
        driveby.identify(quiet)
    assert w[0].filename == __file__
    driveby.identify(simulation)  # with noise; a warning would be an error
    driveby.identify(quiet, method="random_walk")


def test_simulations_are_identified_one_by_one(simulation: driveby.Simulation) -> None:
    with pytest.raises(driveby.InputError) as caught:
        driveby.identify([simulation, simulation])
    assert str(caught.value).startswith("source is a list with a simulation, it must be one simul")
    assert 'b = b.started_at("2026-05-01T09:30:00Z")' in str(caught.value)


# -- what is wrong is said in one line


ROAD = "it must be a class from A to E or a pair of arrays (x_m, height_m)"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: driveby.read(), "no source given"),
        (lambda: driveby.read("nowhere.mcap"), "nowhere.mcap: no such file"),
        (lambda: driveby.identify("nowhere"), "nowhere: no such file"),
        (lambda: driveby.identify("x", method="magic"), 'method is "magic", it must be one of pre'),
        (lambda: driveby.identify("x", seed=-1), "seed is -1"),
        (lambda: driveby.simulate(), "give either scenario= or ei="),
        (lambda: driveby.simulate(scenario=6, ei=[1.0]), "give either scenario= or ei="),
        (lambda: driveby.simulate(), "such as scenario=6 or ei=[1, 1, 1, 0.4, 1, 1, 1]"),
        (
            lambda: driveby.simulate(scenario=13),
            "scenario is 13, it must be a whole number from 1 to 12",
        ),
        (lambda: driveby.simulate(ei=[1.0, 0.5]), "ei: gives 2 elements"),
        (lambda: driveby.simulate(ei=[0.0] * 7), "ei is 0, it must be from 0.001 to 1000"),
        (lambda: driveby.simulate(scenario=6, road="F"), f'road is "F", {ROAD}'),
        (lambda: driveby.simulate(scenario=6, road=np.zeros(9)), f"of shape (9,), {ROAD}"),
        (lambda: driveby.simulate(scenario=6, road=np.ones((9, 2))), f"of shape (9, 2), {ROAD}"),
        (lambda: driveby.simulate(scenario=6, road=1.0), f"road is of type float, {ROAD}"),
        (lambda: driveby.simulate(scenario=6, road=([0, 1], [0])), "road has shapes (2,) and (1,)"),
        (lambda: driveby.simulate(scenario=6, road=([0, 0], [0, 1])), "that do not increase"),
        (lambda: driveby.simulate(scenario=6, road=([0, 1], [0, np.nan])), "not finite numbers"),
        (lambda: driveby.simulate(scenario=6, road=([0, 1], "ab")), "that are no numbers"),
        (lambda: driveby.simulate(scenario=6, speed=0.0), "speed is 0, it must be from 0.1 to 60"),
        (lambda: driveby.simulate(scenario=6, rate=0.0), "rate is 0, it must be from 50"),
        (lambda: driveby.simulate(scenario=6, noise=-1.0), "noise is -1"),
        (lambda: driveby.simulate(scenario=6, direction="up"), 'direction is "up"'),
        (lambda: driveby.simulate(scenario=6, site="no.toml"), "no.toml: no such file"),
        (lambda: driveby.simulate(scenario=6, site=3), "site is 3, it must be the name of a site"),
        (lambda: driveby.simulate(scenario=6, seed=1.5), "seed is 1.5, it must be a whole number"),
        (lambda: driveby.simulate(scenario="6"), 'scenario is "6", it must be a whole number'),
        (lambda: driveby.simulate(scenario=6, noise="25"), 'noise is "25", it must be a number'),
        (lambda: driveby.simulate(scenario=6, noise=[1]), "noise is [1], it must be a number"),
        (lambda: driveby.simulate(scenario=6, speed="10"), 'speed is "10", it must be a number'),
        (lambda: driveby.simulate(scenario=6, speed=(9, 10, 11)), "or a pair (start, end)"),
        (lambda: driveby.simulate(ei=0.5), "ei is 0.5, it must be a ratio for each element"),
        (lambda: driveby.simulate(ei="1,1"), 'ei is "1,1", it must be a ratio for each element'),
        (lambda: driveby.simulate(ei=np.ones((1, 7))), "ei is a ndarray, it must be a ratio"),
        (lambda: driveby.simulate(ei=[None] * 7), "ei is nan, it must be from 0.001"),
        (lambda: driveby.identify("x", seed=1.5), "seed is 1.5, it must be a whole number"),
        (lambda: driveby.identify("x", seed="1"), 'seed is "1", it must be a whole number'),
        (lambda: driveby.identify("x", method=3), "method is 3, it must be one of pre"),
        (lambda: driveby.identify(None), "source is None, it must be a recording"),
        (lambda: driveby.identify([3]), "source is 3, it must be a recording"),
        (lambda: driveby.read(["a.mcap"]), "source is ['a.mcap'], it must be a recording"),
        (lambda: driveby.load_site(3), "site is of type int, it must be the name of a site file"),
        (lambda: driveby.with_values("a", {}), "site is of type str, it must be what load_site()"),
        (
            lambda: driveby.with_values(paper_site(), None),
            "values is of type NoneType, it must be values by their names, such as {",
        ),
        (
            lambda: driveby.with_values(paper_site(), {3: 4.0}),
            "3: is unknown, it must be TABLE.KEY",
        ),
        (
            lambda: driveby.with_values(paper_site(), {"bridge.span_m": None}),
            "the site: bridge.span_m is missing",
        ),
        (lambda: driveby.survey(paper_site(), crossings=2.5), "crossings is 2.5, it must be a"),
        (lambda: driveby.survey(paper_site(), speed="9"), 'speed is "9", it must be a number'),
        (lambda: driveby.survey(paper_site(), speed=[11, 9]), "speed is 9, it must be from 11"),
        (lambda: driveby.survey(paper_site(), noise="9"), 'noise is "9", it must be a number'),
        (lambda: driveby.fuse(3), "source is 3, it must be the name of a results file"),
        (lambda: driveby.fuse([3]), "source is 3, it must be the name of a results file"),
        (lambda: driveby.fuse([["a"]]), "source is ['a'], it must be the name of a"),
        (lambda: driveby.fuse([]), "no results given, results.json or the value of identify() "),
        (lambda: driveby.report(["a.json"]), "source is ['a.json'], it must be the name of a"),
        (
            lambda: driveby.simulate(start="x"),
            "simulate: got an unexpected keyword argument 'start'",
        ),
        (lambda: driveby.simulate(start="x"), "Simulation.started_at() sets the start"),
        (lambda: driveby.identify(), "identify: missing a required argument: 'source'"),
        (lambda: driveby.fuse("a", sites="b"), "its arguments are sources, baseline, fuse_suspect"),
        (lambda: driveby.report("a.json", title="b"), "report: got an unexpected keyword argument"),
        (lambda: driveby.survey(), "survey: missing a required argument: 'site'"),
        (lambda: driveby.read("a", b=3), "read: got an unexpected keyword argument 'b'"),
        (lambda: driveby.plot("a.json"), 'found is "a.json", it must be what identify() or'),
        (lambda: driveby.plot_chains(3), "solution is 3, it must be what identify() returns"),
    ],
)
def test_wrong_input_gives_one_line(call: Callable[[], object], words: str) -> None:
    with pytest.raises(driveby.InputError) as caught:
        call()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "--" not in str(caught.value)


@pytest.mark.parametrize(
    ("module", "call"),
    [
        ("pandas", lambda found, signals: found.elements()),
        ("pandas", lambda found, signals: found.parameters()),
        ("pandas", lambda found, signals: signals.accelerations()),
        ("pandas", lambda found, signals: signals.positions()),
        ("xarray", lambda found, signals: found.posterior()),
        ("h5netcdf", lambda found, signals: found.to_netcdf("draws.nc")),
    ],
)
def test_what_is_not_installed_is_named(
    monkeypatch: pytest.MonkeyPatch,
    exact: driveby.Identification,
    simulation: driveby.Simulation,
    module: str,
    call: Callable[[driveby.Identification, driveby.Signals], object],
) -> None:
    without(monkeypatch, module)
    with pytest.raises(driveby.InputError) as caught:
        call(exact, simulation.signals)
    line = f"needs {module}, which is not installed: {install_command('notebook')}"
    assert line in str(caught.value)


def test_a_text_is_a_path(csv_example: Path) -> None:
    path = csv_example / "site.toml"
    assert driveby.load_site(str(path)) == driveby.load_site(path)
    with pytest.raises(driveby.InputError, match=r"none\.toml: no such file"):
        driveby.load_site("none.toml")


# -- fuse, survey, report


def test_fused_bridge_is_that_of_the_command_line(tmp_path: Path) -> None:
    one = write(tmp_path / "one.json", [crossing(n) for n in range(3)])
    other = write(tmp_path / "other.json", [crossing(n) for n in range(2, 5)])
    assert cli.main(["fuse", str(one), str(other), "--json", str(tmp_path / "a.json")]) == 0
    fused = driveby.fuse(one, str(other))
    for given in ([one, str(other)], (one, str(other))):
        assert driveby.fuse(given).results.bridges == fused.results.bridges
    fused.to_json(tmp_path / "b.json")
    mine, theirs = (json.loads((tmp_path / n).read_text()) for n in ("a.json", "b.json"))
    del mine["created"], theirs["created"]
    assert mine == theirs
    assert list(fused.bridges) == ["bridge-1"]
    assert repr(fused).startswith("<Fusion bridge-1: 5 crossings fused, good")
    cells = as_in_the_terminal(fused.bridges["bridge-1"].elements["EI_1"], 16e9)
    row = "".join(f"<td>{cell}</td>" for cell in cells)
    assert f"<td>EI_1</td>{row}" in fused._repr_html_()
    with pytest.warns(UserWarning, match="bridge-1: The baseline consists of the same crossings"):
        again = driveby.fuse(fused.results, baseline=fused.results)
    assert again.bridges["bridge-1"].probability_of_loss is not None
    with pytest.raises(driveby.InputError, match="no results given"):
        driveby.fuse()


def test_elements_of_a_fusion_are_a_table() -> None:
    table = driveby.fuse(of_estimates(*[crossing(n) for n in range(3)])).elements()
    assert list(table.columns) == [
        *("bridge", "verdict", "crossings", "element", "from_m", "to_m"),
        *("mean", "std", "q025", "q975", "nominal", "ratio"),
    ]
    assert list(table["element"]) == [f"EI_{n}" for n in range(1, 6)]
    third = table.iloc[2]
    assert (third["bridge"], third["crossings"]) == ("bridge-1", 3)
    assert (third["from_m"], third["to_m"]) == (12.0, 18.0)
    assert third["ratio"] == pytest.approx(third["mean"] / 1.6e10) == pytest.approx(0.6, abs=0.05)
    assert third["q025"] < third["mean"] < third["q975"]


def of_estimates(*crossings: CrossingResult) -> Results:
    return results(ResultHeader("1", 5.0, "0" * 16, {}, 1), list(crossings), {})


def test_crossings_of_one_identifier_must_be_the_same(found: driveby.Identification) -> None:
    """Of two crossings under one identifier all but one would be dropped."""
    (one,) = found.results.crossings
    assert one.parameters is not None
    again = driveby.fuse(found, found.results, driveby.fuse(found))
    assert again.bridges["bridge-1"].crossings_used == (one.crossing_id,)
    changed = one.parameters | {"rhoA": one.parameters["rhoA"].model_copy(update={"mean": 1.0})}
    other = of_estimates(one.model_copy(update={"parameters": changed}))
    with pytest.raises(driveby.InputError) as caught:
        driveby.fuse(found, other)
    assert str(caught.value).startswith(f"{one.crossing_id}: two crossings with this identifier")
    assert "simulation.started_at(" in str(caught.value)


def test_report_of_different_crossings_of_one_identifier_is_refused(
    found: driveby.Identification, tmp_path: Path
) -> None:
    """Of two simulations with one start the report would show the newest alone."""
    (one,) = found.results.crossings
    assert one.parameters is not None
    changed = one.parameters | {"rhoA": one.parameters["rhoA"].model_copy(update={"mean": 1.0})}
    other = found._replace(results=of_estimates(one.model_copy(update={"parameters": changed})))
    with pytest.raises(driveby.InputError) as caught:
        driveby.report(found, other, output=tmp_path / "a.html")
    assert str(caught.value).startswith(f"{one.crossing_id}: two crossings with this identifier")
    assert not (tmp_path / "a.html").exists()


@pytest.mark.parametrize(
    "write",
    [
        lambda found, simulation: found.to_json(3),
        lambda found, simulation: found.to_netcdf(3),
        lambda found, simulation: simulation.write(3),
    ],
)
def test_file_of_no_name_is_one_line(
    found: driveby.Identification,
    simulation: driveby.Simulation,
    write: Callable[[driveby.Identification, driveby.Simulation], None],
) -> None:
    with pytest.raises(driveby.InputError, match="path is 3, it must be the name of a file to wri"):
        write(found, simulation)


def test_stored_results_are_the_same_as_those_in_memory(
    found: driveby.Identification, tmp_path: Path
) -> None:
    found.to_json(tmp_path / "found.json")
    fused = driveby.fuse(found, tmp_path / "found.json")
    assert len(fused.results.crossings) == 1


def test_simulation_started_at_another_time_is_another_crossing(
    simulation: driveby.Simulation, exact: driveby.Identification
) -> None:
    later = simulation.started_at("2026-05-01T09:30:00+02:00")
    (solution,) = driveby.identify(later, method="least_squares").solutions
    assert exact.solutions[0].crossing.crossing_id == "truck-1.bridge-1.20260101T000003.000Z"
    assert solution.crossing.crossing_id == "truck-1.bridge-1.20260501T073003.000Z"
    for start, words in (
        ("2026-05-01T09:30:00", "which has no zone"),
        ("1900-01-01T00:00:00Z", "it must be a time from 1970 to 2100"),
        (3, "start is 3, it must be a time as 2026"),
    ):
        with pytest.raises(driveby.InputError, match=words) as caught:
            simulation.started_at(start)  # type: ignore[arg-type]
        assert str(caught.value).startswith("start")


def test_recording_of_a_simulation_keeps_its_start(
    simulation: driveby.Simulation, tmp_path: Path
) -> None:
    """Recordings of one time are one crossing, of which all but one would be dropped."""
    for day in ("2026-05-01", "2026-05-02"):
        later = simulation.started_at(f"{day}T09:30:00Z")
        later.write(tmp_path / f"{day}.mcap")
        (signals,) = driveby.read(tmp_path / f"{day}.mcap")
        begin = signals.channels["unsprung_front"].time_ns[0]
        assert str(begin.astype("datetime64[ns]").astype("datetime64[s]")) == f"{day}T09:30:00"


def test_plot_draws_a_fused_bridge(found: driveby.Identification, tmp_path: Path) -> None:
    fused = driveby.fuse(found)
    panel, *_ = driveby.plot(fused, bridge="bridge-1").axes
    tops = sorted(f"{e.mean / 1e9:.2f}" for e in fused.bridges["bridge-1"].elements.values())
    assert len(tops) == 7
    assert panel.get_ylim()[1] > float(tops[-1])
    with pytest.warns(UserWarning, match="The baseline consists of the same crossings"):
        compared = driveby.fuse(found, baseline=found)
    before = driveby.plot(compared).axes[0].get_legend()
    assert "baseline" in " ".join(text.get_text() for text in before.get_texts())
    found.to_json(tmp_path / "found.json")
    stored = driveby.fuse(tmp_path / "found.json")
    for call in (driveby.plot, lambda one: driveby.report(one, output=tmp_path / "a.html")):
        with pytest.raises(driveby.InputError, match="bridge-1: has no site file, fuse"):
            call(stored)
    drawn = driveby.plot(driveby.fuse(tmp_path / "found.json", site=found.site))
    assert drawn.axes[0].get_ylim() == panel.get_ylim()
    with pytest.raises(driveby.InputError, match='bridge is "x", it must be one of bridge-1'):
        driveby.plot(fused, bridge="x")
    with pytest.raises(driveby.InputError, match="truth is drawn with a single crossing"):
        driveby.plot(fused, truth=driveby.simulate(scenario=6))


def test_report_of_a_fused_bridge_has_its_numbers(
    found: driveby.Identification, tmp_path: Path
) -> None:
    of_fused = driveby.report(driveby.fuse(found), output=tmp_path / "fused.html").read_text()
    of_found = driveby.report(found, output=tmp_path / "found.html").read_text()
    time = re.compile(r"[\d-]+ [\d:]+ UTC(?=</td>)")
    named = of_fused.replace(">fusion; ", ">identification; ")
    assert time.sub("", named) == time.sub("", of_found)
    given = driveby.report(found, site=found.site, output=tmp_path / "site.html")
    assert given.read_text() == of_found


def test_report_of_a_comparison_shows_both_states(
    found: driveby.Identification, tmp_path: Path
) -> None:
    """What `fuse` compared with is shown without being named once more; or another one instead."""
    with pytest.warns(UserWarning, match="the same crossings"):
        fused = driveby.fuse(found, baseline=found)
    found.to_json(tmp_path / "then.json")
    compared = {
        "given to fuse": driveby.report(fused, output=tmp_path / "a.html"),
        "fusion": driveby.report(found, baseline=fused, output=tmp_path / "b.html"),
        "then.json": driveby.report(
            fused, baseline=tmp_path / "then.json", output=tmp_path / "c.html"
        ),
    }
    for name, page in compared.items():
        assert f"<td>the baseline {name}: 1 crossing" in page.read_text()
    alone = driveby.report(driveby.fuse(found), output=tmp_path / "d.html").read_text()
    assert "<td>the baseline" not in alone


@pytest.mark.slow
def test_survey_is_that_of_the_command_line(
    tmp_path: Path, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site, out = project / "docs/site.example.toml", tmp_path / "a.json"
    given = ["--crossings", "2", "--speed", "10", "--json", str(out)]
    assert cli.main(["survey", "--site", str(site), *given]) == 0
    found = driveby.survey(site, crossings=2, speed=10.0)
    assert json.loads(out.read_text()) == json.loads(json.dumps(found.as_dict()))
    assert repr(found) == capsys.readouterr().out.strip()
    with pytest.raises(
        driveby.InputError, match="crossings is 0, it must be a whole number from 1 to 300"
    ):
        driveby.survey(site, crossings=0)
    with pytest.raises(driveby.InputError, match='road is "F", it must be one of A, B, C, D, E'):
        driveby.survey(site, road="F")


def test_report_is_that_of_the_command_line(
    found: driveby.Identification, sample: Path, tmp_path: Path
) -> None:
    found.to_json(tmp_path / "found.json")
    shutil.copy(sample, tmp_path)
    theirs = tmp_path / "theirs.html"
    assert cli.main(["report", str(tmp_path / "found.json"), "-o", str(theirs)]) == 0
    mine = driveby.report(found, output=tmp_path / "mine.html")
    named = mine.read_text().replace(">identification; ", ">found.json; ")
    assert named == theirs.read_text()
    again = driveby.report(tmp_path / "found.json", output=tmp_path / "again.html")
    assert again.read_text() == theirs.read_text()
    with pytest.raises(driveby.InputError, match="the name of an HTML file"):
        driveby.report(found, output=tmp_path / "mine.pdf")


def test_simulate_recording_takes_the_options_of_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = []

    def command(asked: Any, console: Any) -> int:
        given.append(asked)
        return 0

    monkeypatch.setattr("services.simulation.command.simulate_command", command)
    path = driveby.simulate_recording(
        "drive.mcap", site=paper_site(), ei=[1, 1, 0.5], speed=(9, 11), runs=3, road_surface=True
    )
    assert path == Path("drive.mcap")
    (options,) = given
    assert (options.ei, options.speed) == ((1.0, 1.0, 0.5), (9.0, 11.0))
    assert (options.runs, options.road_surface, options.gps_noise) == (3, True, False)
    assert options.output == path
    with pytest.raises(driveby.InputError, match="rnus: is unknown, did you mean runs"):
        driveby.simulate_recording("drive.mcap", scenario=6, rnus=3)
    with pytest.raises(driveby.InputError, match="--runs"):
        driveby.simulate_recording("drive.mcap", scenario=6, runs=0)
    assert len(given) == 1


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ({"ei": [100] * 7}, "ei is up to 100 times nominal: is it in per cent"),
        ({"ei": [1] * 7, "speed": 36}, "speed is 36 m/s, 130 km/h: is it in km/h"),
        (
            {"scenario": 6, "road": ([-70, 0, 1, 2, 70], [0, 0, 2, 0, 0])},
            "road has an rms slope of 1.4: are its heights in mm",
        ),
    ],
)
def test_likely_errors_of_units_are_warned_of(named: Any, words: str) -> None:
    with pytest.warns(UserWarning, match=words):
        driveby.simulate(**named)


def test_results_have_edges_and_nominal_rigidity_of_the_elements(
    found: driveby.Identification,
) -> None:
    (solution,) = found.solutions
    table = found.elements()
    for one in (solution.crossing, *driveby.fuse(found).bridges.values()):
        assert one.element_edges_m is not None
        assert one.nominal_ei_nm2 is not None
        assert list(one.element_edges_m[:-1]) == pytest.approx(list(table["from_m"]))
        assert list(one.element_edges_m[1:]) == pytest.approx(list(table["to_m"]))
        assert list(one.nominal_ei_nm2) == pytest.approx(list(table["nominal"]))


def test_signature_of_simulate_is_short() -> None:
    assert len(str(inspect.signature(driveby.simulate))) < 500


def prior_seen(axes: Any) -> float:
    """Return the largest height of the prior within the axis, over that of the panel."""
    at, heights = axes.collections[0].get_paths()[0].vertices.T
    low, high = axes.get_xlim()
    is_inside = (at >= low) & (at <= high)
    return float(heights[is_inside].max(initial=0.0) / axes.get_ylim()[1])


@pytest.mark.parametrize("distribution", ["log_normal", "half_normal", "normal", "uniform"])
def test_density_of_a_prior_is_that_of_its_draws(distribution: Any) -> None:
    prior = Prior(distribution=distribution, location=2.0, scale=0.5)
    at = np.linspace(-1.0, 8.0, 9001)
    density = inference.prior_density(prior, at)
    share = np.cumsum(density) / density.sum()
    draws = inference.prior_draws(prior)
    for probability in (0.1, 0.5, 0.9):
        below = np.mean(draws <= at[np.searchsorted(share, probability)])
        assert below == pytest.approx(probability, abs=0.03)  # 2000 draws: 0.011 at 0.5


def test_prior_far_from_the_posterior_is_in_the_plot(found: driveby.Identification) -> None:
    (solution,) = found.solutions
    beta = solution.value["beta"]
    assert beta.prior is not None
    for factor in (0.01, 1.0, 100.0):
        away = beta.prior.model_copy(update={"location": factor * beta.prior.location})
        parameters = solution.value | {"beta": beta.model_copy(update={"prior": away})}
        crossing = solution.crossing.model_copy(update={"parameters": parameters})
        (axes,) = driveby.plot_posterior(solution._replace(crossing=crossing), ["beta"]).axes
        assert prior_seen(axes) >= 0.2
        low, high = axes.get_xlim()
        assert low < beta.mean < high


def test_draws_that_are_all_zero_are_drawn(found: driveby.Identification) -> None:
    """As those of a torsion without any effect; a warning of Matplotlib would fail here."""
    (solution,) = found.solutions
    zero = dict.fromkeys(("mean", "std", "q025", "q50", "q975"), 0.0)
    beta = solution.value["beta"].model_copy(update=zero)
    for value in (beta, beta.model_copy(update={"prior": None})):
        crossing = solution.crossing.model_copy(
            update={"parameters": solution.value | {"beta": value}}
        )
        draws = solution.draws | {"beta": np.zeros_like(solution.draws["beta"])}
        zeros = solution._replace(crossing=crossing, draws=draws)
        (axes,) = driveby.plot_posterior(zeros, ["beta"]).axes
        (posterior,) = axes.patches
        low, high = axes.get_xlim()
        assert low <= 0.0 < high
        assert 0.01 * (high - low) < np.ptp(posterior.get_data().edges) < 0.1 * (high - low)
        (note,) = axes.texts
        assert note.get_text() == "zero in all draws"


def test_probabilities_of_zero_are_bars_in_the_plot(found: driveby.Identification) -> None:
    """The site file leaves restraint, compliance and torsion a probability of one half of zero."""
    (solution,) = found.solutions
    for name in ("f_start", "k_rot_end", "torsion"):
        prior = solution.value[name].prior
        assert prior is not None
        assert prior.probability_zero == 0.5
        share = np.mean(solution.draws[name] == 0.0)
        assert share > 0.5
        (axes,) = driveby.plot_posterior(solution, [name]).axes
        bars = {bar.get_label(): bar.get_data() for bar in axes.patches}
        assert bars["prior at zero"].values == [0.5]
        assert bars["posterior at zero"].values == pytest.approx([share])
        low, high = axes.get_xlim()
        assert -0.2 * high < low < 0.0 < high
        (note,) = axes.texts
        is_all = share == 1.0
        assert ("zero in all draws" in note.get_text()) == is_all
        assert ("posterior" in bars) != is_all
        size = "M" if solution.value[name].mean >= 1e6 else "k"
        units = {"k_rot_end": f"{size}N·m/rad", "f_start": "mm/MN", "torsion": "1/GN"}
        assert axes.get_xlabel() == units[name]
    rho_a = solution.value["rhoA"].prior
    assert rho_a is not None
    assert rho_a.probability_zero is None


def test_residual_has_a_band_of_its_expected_size(found: driveby.Identification) -> None:
    """Nearly all differences of a good crossing lie in it, and they fill it."""
    (solution,) = found.solutions
    figure = driveby.plot_residual(solution)
    (axes,) = figure.axes
    (band,) = axes.collections
    vertices = band.get_paths()[0].vertices
    road = solution.crossing.road
    assert road is not None
    drawn = {line.get_label().split(":")[0]: line.get_ydata() for line in axes.lines}
    x_m = np.array(road.x_m)
    upper = np.array([vertices[np.isclose(vertices[:, 0], x), 1].max() for x in x_m])
    half_mm = upper - drawn["cubic trend"]
    size = np.abs(drawn["difference"] - drawn["cubic trend"]) / half_mm
    assert 0.8 < np.mean(size <= 1.0) <= 1.0
    assert np.max(size) > 0.3
    (legend,) = figure.legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert "expected range about the trend (95 %): sensor noise" in labels
    alone = driveby.plot_residual(solution._replace(site=None)).axes[0]
    assert (len(alone.collections) == 1) == (road.mismatch is not None)


def test_diagnostic_plots_have_a_panel_for_each_parameter(
    found: driveby.Identification, simulation: driveby.Simulation
) -> None:
    (solution,) = found.solutions
    (residual,) = driveby.plot_residual(solution).axes
    road = solution.crossing.road
    assert road is not None
    difference_mm = 1e3 * (np.array(road.front_m) - np.array(road.rear_m))
    drawn = {line.get_label().split(":")[0]: line.get_ydata() for line in residual.lines}
    assert drawn["difference"] == pytest.approx(difference_mm)
    assert np.polyfit(road.x_m, difference_mm - drawn["cubic trend"], 3) == pytest.approx(
        0, abs=1e-9
    )
    residual.get_figure().draw_without_rendering()
    (legend,) = residual.get_figure().legends
    explained = {text.get_text() for text in legend.get_texts()}
    assert "bridge" in explained
    rms_mm = f"{np.sqrt(np.mean(difference_mm**2)):.2g} mm RMS"
    assert any(text.startswith(f"difference: {rms_mm}, ") for text in explained)
    box = legend.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= residual.get_figure().bbox.width
    posterior = driveby.plot_posterior(solution).axes
    assert {axes.get_xlabel() for axes in posterior} == {"GN·m²"}
    low_gn, high_gn = posterior[3].get_xlim()
    assert len(posterior) == solution.bridge.elements
    (prior,), (above,) = posterior[0].collections, posterior[0].patches
    assert prior.get_zorder() <= above.get_zorder()
    assert above.get_alpha() < 0.9  # the prior behind it shows
    for name in ("beta", "EI_4", "rhoA"):
        (axes,) = driveby.plot_posterior(solution, [name]).axes
        assert prior_seen(axes) >= 0.2
    assert low_gn < solution.value["EI_4"].mean / 1e9 < high_gn
    chains = driveby.plot_chains(solution, ["rhoA", "EI_4"]).axes
    assert [axes.get_title(loc="left") for axes in chains] == ["rhoA", "EI_4"]
    assert len(chains[0].lines) == len(solution.draws["rhoA"])
    title = chains[0].get_figure().get_suptitle()
    assert f"largest R-hat {solution.crossing.diagnostics['r_hat']:.3f}" in title
    (alone,) = driveby.plot_posterior(found, names="rhoA").axes
    assert alone.get_title(loc="left") == "rhoA"
    with pytest.raises(driveby.InputError, match="EI_9: is unknown"):
        driveby.plot_posterior(solution, ["EI_9"])
    (wheelbase,) = driveby.plot_posterior(solution, ["wheelbase_m"]).axes
    assert (prior_seen(wheelbase) >= 0.2, wheelbase.get_xlabel()) == (True, "m")
    # The sample is not of this simulation: its truth is far away, and in the picture all the same.
    (with_truth,) = driveby.plot_posterior(solution, ["EI_4"], truth=simulation).axes
    ratio, nominal = simulation.ei_ratios[3], solution.bridge.nominal_flexural_rigidity_nm2[3]
    (drawn_at,) = (line for line in with_truth.lines if line.get_label() == "truth")
    assert drawn_at.get_xdata()[0] == pytest.approx(1e-9 * ratio * nominal)
    assert with_truth.get_xlim()[0] <= drawn_at.get_xdata()[0] <= with_truth.get_xlim()[1]
    with pytest.raises(
        driveby.InputError, match=r"truth is 3, it must be what simulate\(\) returns"
    ):
        driveby.plot_posterior(solution, truth=3)  # type: ignore[arg-type]
    with pytest.raises(driveby.InputError, match=r"names is \[5\], it must be a list of names"):
        driveby.plot_posterior(solution, [5])  # type: ignore[list-item]
