"""A site file that is edited while a worker runs: taken up once, or refused once."""

from pathlib import Path

import pytest

from schemas.site_file import site_hash, site_toml
from services.cli.main import main
from services.simulation.drive import paper_site
from services.worker.site_file_watcher import CHECK_EVERY_S, SiteFileWatcher
from tests.unit.identification.test_fusing import crossing, write

SITE = paper_site()
OTHER = SITE.model_copy(
    update={"bridges": (SITE.bridges[0].model_copy(update={"rayleigh_alpha_per_s": 0.9}),)}
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(site_toml(SITE))
    return path


def test_another_content_is_taken_up_once(path: Path) -> None:
    watch = SiteFileWatcher(path, SITE, "survey")
    assert watch.edited(0.0) is None
    path.write_text(site_toml(OTHER) + "# edited\n")
    assert watch.edited(0.5 * CHECK_EVERY_S) is None
    found = watch.edited(CHECK_EVERY_S)
    assert found is not None
    assert (found.site, found.hash) == (OTHER, site_hash(OTHER))
    assert found.text.endswith("# edited\n")
    assert watch.edited(2.0 * CHECK_EVERY_S) is None
    path.write_text(site_toml(SITE))
    back = watch.edited(3.0 * CHECK_EVERY_S)
    assert back is not None
    assert back.site == SITE


@pytest.mark.parametrize(("realm", "is_named"), [("survey", True), ("sim-y", False)])
def test_simulated_baseline_that_an_edit_names_is_a_warning(
    path: Path, realm: str, is_named: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    first = write(path.with_name("first.json"), [crossing(0)])
    assert main(["fuse", str(first), "--json", str(path.with_name("before.json"))]) == 0
    watch = SiteFileWatcher(path, SITE, realm)
    bridge = SITE.bridges[0].model_copy(update={"baseline": "before.json", "elements": 5})
    path.write_text(site_toml(SITE.model_copy(update={"bridges": (bridge,)})))
    found = watch.edited(0.0)
    assert found is not None
    assert found.baselines.realms == {bridge.id: {"sim-x"}}
    assert ("The baseline was simulated" in capsys.readouterr().err) is is_named


def test_a_comment_is_no_other_site(path: Path) -> None:
    watch = SiteFileWatcher(path, SITE, "survey")
    path.write_text("# a comment\n" + site_toml(SITE))
    assert watch.edited(0.0) is None


def test_error_is_logged_once_until_it_is_mended(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    watch = SiteFileWatcher(path, SITE, "survey")
    wrong = site_toml(OTHER).replace("span_m = 30.0", "span_m = -1.0")
    for number, text in enumerate((wrong, wrong + "\n", "")):
        path.write_text(text)
        assert watch.edited(number * CHECK_EVERY_S) is None
    path.unlink()
    assert watch.edited(3.0 * CHECK_EVERY_S) is None
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 3
    assert lines[0].startswith(f"{path}: bridge.span_m is -1")
    assert all(line.endswith("; keeping the previous site file") for line in lines)
    path.write_text(site_toml(OTHER))
    assert watch.edited(4.0 * CHECK_EVERY_S) is not None


def test_query_is_answered_at_once(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    watch = SiteFileWatcher(path, SITE, "survey")
    assert watch.edited(0.0, is_asked=True) is None
    path.write_text("")
    for _ in range(2):
        assert watch.edited(0.1, is_asked=True) is None
    assert len(caplog.records) == 2
    path.write_text(site_toml(OTHER))
    assert watch.edited(0.2, is_asked=True) is not None
