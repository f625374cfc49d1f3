"""The chains as a file, as ArviZ reads them: every unknown an array (chain, draw)."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pre_core.search.convergence import CHAINS
from schemas.results import load_results
from services.cli import main as cli
from services.common import extras
from services.history.draws import Draws, DrawsOfCrossing, posterior, write_draws

NAMES = ["EI_1", "wheelbase_m"]


@pytest.fixture
def draws() -> Draws:
    rng = np.random.default_rng(1)
    return {name: rng.standard_normal((CHAINS, 30)) for name in NAMES}


def test_the_draws_are_those_of_the_result_and_of_what_is_printed(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sample = project / "recordings" / "sample" / "crossing.mcap"
    out, drawn = tmp_path / "out.json", tmp_path / "draws.npz"
    arguments = ["identify", str(sample), "--json", str(out), "--draws", str(drawn)]
    assert cli.main(arguments) == 0
    (crossing,) = load_results(out).crossings
    assert crossing.parameters is not None
    assert crossing.covariance is not None
    assert crossing.scale_error is not None
    with np.load(drawn) as file:
        arrays = dict(file)
    assert arrays.keys() == {*crossing.covariance.names, "wheelbase_m", "position_offset_m"}
    length = round(crossing.diagnostics["draws"] / CHAINS)
    assert {values.shape for values in arrays.values()} == {(CHAINS, length)}
    for name in crossing.covariance.names:
        p = crossing.parameters[name]
        assert arrays[name].mean() == pytest.approx(p.mean, rel=1e-9)
        assert arrays[name].std() == pytest.approx(p.std, rel=1e-9)
        assert np.quantile(arrays[name], 0.975) == pytest.approx(p.q975, rel=1e-9)
    printed = capsys.readouterr().out
    assert "\nverdict good\n" in printed
    weak = crossing.parameters["EI_4"]
    for unit, digits in ((1e9, 2), (1.56e10, 3)):
        interval = f"{weak.q025 / unit:.{digits}f} … {weak.q975 / unit:.{digits}f}"
        assert re.search(rf"EI_4 .* {weak.mean / unit:.{digits}f} +{interval}", printed), printed
    assert f"common scale uncertainty: {100.0 * crossing.scale_error:.1f} %" in printed
    assert crossing.derived is not None
    giving = crossing.derived.probability_giving
    assert giving is not None
    start = f"{100.0 * giving.start:.0f} % at the start"
    assert f"probability of bearing compliance: {start}" in printed
    assert "weight of the truck's body equations: 100 %" in printed
    # The state of the bridge, as the report has it, is not without the variability.
    assert (
        "\nlowest EI/nominal in reports (interval includes between-crossing variability): EI_4 0.4"
        in printed
    )
    assert "pareto_k" in crossing.diagnostics


def of(
    crossing_id: str, draws: Draws, *, vehicle: str = "truck-1", bridge: str = "bridge-1"
) -> DrawsOfCrossing:
    return DrawsOfCrossing(crossing_id, vehicle, bridge, draws)


def opened(path: Path) -> Any:
    """What ArviZ reads; it warns of groups that it does not know, and warnings are errors here."""
    import arviz

    return arviz.from_netcdf(path)


def test_arviz_opens_the_draws_of_several_crossings(draws: Draws, tmp_path: Path) -> None:
    path = tmp_path / "draws.nc"
    path.write_text("of yesterday")
    other = {name: 2.0 * values for name, values in draws.items()}
    write_draws(path, [of("one", draws), of("two", other, bridge="bridge-2")])
    found = opened(path)
    assert found.groups() == ["posterior"]
    assert dict(found.posterior.sizes) == {"chain": CHAINS, "draw": 30, "crossing": 2}
    assert list(found.posterior.data_vars) == NAMES
    for name in NAMES:
        assert found.posterior[name].dims == ("chain", "draw", "crossing")
        np.testing.assert_array_equal(found.posterior[name].sel(crossing="one"), draws[name])
        np.testing.assert_array_equal(found.posterior[name].sel(crossing="two"), other[name])
    assert list(found.posterior["bridge"].values) == ["bridge-1", "bridge-2"]
    assert list(tmp_path.iterdir()) == [path]


def test_arviz_summarises_what_it_opened(draws: Draws, tmp_path: Path) -> None:
    import arviz

    path = tmp_path / "draws.nc"
    write_draws(path, [of("one", draws), of("two", draws)])
    table = arviz.summary(opened(path), round_to="none")
    assert list(table.index) == [f"{name}[{c}]" for name in NAMES for c in ("one", "two")]
    assert table["mean"]["EI_1[two]"] == pytest.approx(draws["EI_1"].mean(), rel=1e-12)


def test_longer_chains_are_thinned_to_the_shortest(draws: Draws) -> None:
    longer = {name: np.repeat(values, 3, axis=1) for name, values in draws.items()}
    found = posterior([of("one", draws), of("two", longer)])
    np.testing.assert_array_equal(found["EI_1"].sel(crossing="two"), draws["EI_1"])
    assert list(found["draws_sampled"].values) == [30, 90]


def test_crossings_of_other_unknowns_keep_their_names_apart(draws: Draws, tmp_path: Path) -> None:
    path = tmp_path / "draws.nc"
    more = {**draws, "EI_2": draws["EI_1"] + 1.0}
    crossings = [of("one", draws), of("two", more, bridge="bridge-2"), of("three", draws)]
    write_draws(path, crossings)
    found = opened(path).posterior
    first = found["truck-1.bridge-1.EI_1"]
    assert first.dims == ("chain", "draw", "truck-1.bridge-1.crossing")
    assert list(first["truck-1.bridge-1.crossing"].values) == ["one", "three"]
    second = found["truck-1.bridge-2.EI_2"]
    np.testing.assert_array_equal(second.values[..., 0], more["EI_2"])
    assert len(found.data_vars) == 2 + 3


def test_no_crossing_has_draws(tmp_path: Path) -> None:
    path = tmp_path / "draws.nc"
    write_draws(path, [of("rejected", {})])
    assert opened(path).groups() == []


def test_several_crossings_are_distinguished_by_name(draws: Draws, tmp_path: Path) -> None:
    path = tmp_path / "draws.npz"
    longer = {name: np.hstack([values, values]) for name, values in draws.items()}
    write_draws(path, [of("one", draws), of("rejected", {}), of("two", longer)])
    with np.load(path) as file:
        assert set(file) == {f"{crossing}/{name}" for crossing in ("one", "two") for name in NAMES}
        np.testing.assert_array_equal(file["one/EI_1"], draws["EI_1"])
        np.testing.assert_array_equal(file["two/EI_1"], longer["EI_1"])


def test_netcdf_without_its_extra_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = extras.find_spec
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "xarray" else found(name))
    monkeypatch.chdir(tmp_path)
    # The recording does not exist: whoever had begun to read it would say so.
    assert cli.main(["identify", "none.mcap", "--draws", "draws.nc"]) == 2
    err = capsys.readouterr().err
    assert err == (
        "driveby: draws.nc: NetCDF needs xarray, which is not installed: "
        f"{extras.install_command('notebook')} (or name a file .npz)\n"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--draws", "draws.csv"], "draws.csv: draws are written as .npz or .nc"),
        (
            ["--method", "least-squares", "--draws", "draws.npz"],
            "--draws: method least_squares has no draws, use --method pre",
        ),
        (["--draws", "no/such/draws.npz"], "draws.npz"),
    ],
)
def test_what_cannot_be_written_is_refused_before_any_work(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    # The recording does not exist: whoever had begun to read it would say so.
    assert cli.main(["identify", "none.mcap", *arguments]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert "none.mcap" not in err
    assert list(tmp_path.iterdir()) == []
