"""The chains as a file, as ArviZ reads them: every unknown an array (chain, draw)."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import netcdf_file

from pre_core.search.crank_nicolson import CHAINS
from schemas.results import load_results
from services.cli import main as cli
from services.common.errors import InputError
from services.history.draws import Draws, write_draws

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
    assert f"common to all elements: {100.0 * crossing.scale_error:.1f} %" in printed
    # Neighbours along a chain are alike, across the chains they are not: the axes are not mixed up.
    rigidity = arrays["EI_4"] - arrays["EI_4"].mean()
    along = np.mean(rigidity[:, 1:] * rigidity[:, :-1]) / np.mean(rigidity**2)
    across = np.mean(rigidity[1:] * rigidity[:-1]) / np.mean(rigidity**2)
    assert along > across + 0.1


def test_netcdf_has_the_dimensions_chain_and_draw(draws: Draws, tmp_path: Path) -> None:
    path = tmp_path / "draws.nc"
    path.write_text("of yesterday")
    write_draws(path, {"crossing": draws})
    with netcdf_file(path, mmap=False) as file:
        assert file.dimensions == {"chain": CHAINS, "draw": 30}
        assert list(file.variables) == NAMES
        for name, values in draws.items():
            assert file.variables[name].dimensions == ("chain", "draw")
            np.testing.assert_array_equal(file.variables[name][:], values)
    assert list(tmp_path.iterdir()) == [path]


def test_several_crossings_are_told_apart_by_name(draws: Draws, tmp_path: Path) -> None:
    path = tmp_path / "draws.npz"
    longer = {name: np.hstack([values, values]) for name, values in draws.items()}
    write_draws(path, {"one": draws, "two": longer})
    with np.load(path) as file:
        assert set(file) == {f"{crossing}/{name}" for crossing in ("one", "two") for name in NAMES}
        np.testing.assert_array_equal(file["one/EI_1"], draws["EI_1"])
        np.testing.assert_array_equal(file["two/EI_1"], longer["EI_1"])


def test_netcdf_holds_one_crossing(draws: Draws, tmp_path: Path) -> None:
    path = tmp_path / "draws.nc"
    with pytest.raises(InputError, match=r"holds one crossing, these are 2; use \.npz"):
        write_draws(path, {"one": draws, "two": draws})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--draws", "draws.csv"], "draws.csv: draws are written as .npz or .nc"),
        (
            ["--method", "least-squares", "--draws", "draws.npz"],
            "--draws: method least_squares has no draws, pre has",
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
