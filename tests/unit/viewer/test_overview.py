"""The Rerun file shows a bridge first, and what is doubtful is seen to be."""

from collections.abc import Iterator
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import rerun.blueprint as rrb
from rerun.chunk import Chunk, RrdReader

from schemas.results import results_json
from schemas.site import Site
from schemas.site_file import load_site, site_toml
from services.recordings.writer import write_recording
from services.viewer import crossing_tab, rerun_file
from services.viewer.bridge_figure import draw_bridge
from services.viewer.bridge_view import origin_of, view_of_bridge, views_of_bridges
from services.viewer.crossing_scene import Panel, crossing_root, scenes_of
from services.viewer.crossing_tab import tab_name
from services.viewer.crossing_view import CrossingView, view_of_crossing
from services.viewer.drawing import STYLE
from services.viewer.layout import blueprint
from services.viewer.panels.verdict import verdict_markdown
from services.viewer.rerun_file import RerunContent, write_rrd
from services.viewer.rerun_parts import log_markdown
from services.viewer.rerun_places import bridges_of_site
from services.viewer.strip import rigidity_strip
from services.viewer.vehicle_signals import signals_of_messages
from services.viewer.view import convert
from tests.unit.drives.recorded import drive
from tests.unit.viewer.found import results_of, some_crossing
from tests.viewer_screen import complaints, opened, picture, pixels, view_named


def converted(folder: Path, site: Site, verdict: str) -> dict[str, Chunk]:
    """What `driveby view` draws of results, with a recording beside them."""
    reasons = () if verdict == "good" else ("position_outage",)
    found = results_of(site, some_crossing("a", verdict=verdict, reasons=reasons), used="a")
    (folder / "found.json").write_text(results_json(found))
    write_recording(folder / "r.mcap", drive(), site_toml=site_toml(site), reason="test")
    convert(folder / "found.json", folder / "found.rrd")
    chunks = RrdReader(folder / "found.rrd").stream().to_chunks()
    return {chunk.entity_path: chunk for chunk in chunks}


def value(chunk: Chunk, component: str) -> object:
    batch = chunk.to_record_batch()
    column = next(name for name in batch.schema.names if name.endswith(f":{component}"))
    return batch.column(column).to_pylist()[0]


def view_of(site: Site, verdict: str, **changes: object) -> CrossingView:
    reasons = () if verdict == "good" else ("position_outage",)
    found = results_of(site, some_crossing("a", verdict=verdict, reasons=reasons))
    return view_of_crossing(found.crossings[0], site.bridges[0])._replace(**changes)


def test_reasons_of_a_bridge_name_their_crossing(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts: dict[str, str] = {}

    class Recording:
        """A stand-in that keeps nothing."""

        def log(self, *_: object, **__: object) -> None:
            """Ignore an entity."""

    def kept(_: object, entity: str, text: str) -> None:
        texts[entity] = text

    monkeypatch.setattr(rerun_file, "log_markdown", kept)
    bad = some_crossing("b", verdict="rejected", reasons=("speed_too_low",), entry=60.0)
    found = results_of(site, some_crossing("a"), bad, used="a")
    view = view_of_bridge(site.bridges[0], found, None)
    rerun_file._log_overview(Recording(), view)  # type: ignore[arg-type]
    (text,) = texts.values()
    assert "- 2026-09-21 14:14 → bridge-1, rejected, not used: The truck was so slow" in text


def test_the_overview_has_the_picture_of_the_bridge_and_the_finding(
    tmp_path: Path, site: Site
) -> None:
    found = converted(tmp_path, site, "good")
    (form,) = value(found["/bridge/bridge-1/picture"], "format")  # type: ignore[misc]
    assert form["width"] == 990  # not larger than it is shown: Rerun does not smooth what shrinks
    (text,) = value(found["/bridge/bridge-1/finding"], "text")  # type: ignore[misc]
    assert "Element 4 (12.9 to 17.1 m) is 60 % less stiff than the other elements" in text
    assert "Doubtful" not in text


@pytest.mark.parametrize(
    ("used", "between", "origin"),
    [
        (
            ("a",),
            0.02,
            "Values from one crossing; its own figure excludes between-crossing variability.",
        ),
        (("a",), None, "Values from one crossing."),
        (("a", "b"), 0.02, "Values from 2 fused crossings."),
    ],
)
def test_numbers_name_the_crossings_that_they_are_of(
    site: Site, used: tuple[str, ...], between: float | None, origin: str
) -> None:
    """A single crossing has narrower intervals than the state, and other means."""
    found = results_of(site, *(some_crossing(name) for name in used), used="a")
    state = found.bridges["bridge-1"].model_copy(
        update={"crossings_used": used, "between_crossing_std": between}
    )
    view = view_of_bridge(
        site.bridges[0], found.model_copy(update={"bridges": {"bridge-1": state}}), None
    )
    assert origin_of(view) == origin
    written = " ".join(" ".join(text.get_text() for text in draw_bridge(view).texts).split())
    assert origin in written


def test_a_doubtful_state_and_its_bars_have_no_colour(tmp_path: Path, site: Site) -> None:
    colours = {}
    for verdict in ("good", "suspect"):
        (tmp_path / verdict).mkdir()
        found = converted(tmp_path / verdict, site, verdict)
        root = crossing_root(view_of(site, verdict))
        (colours[verdict],) = value(found[f"/{root}/rigidity"], "color")  # type: ignore[misc]
        (text,) = value(found["/bridge/bridge-1/finding"], "text")  # type: ignore[misc]
        assert ("Doubtful" in text) == (verdict == "suspect")

    def spread(packed: int) -> int:
        channels = [packed >> shift & 255 for shift in (24, 16, 8)]
        return max(channels) - min(channels)

    assert spread(colours["good"]) > 100
    assert spread(colours["suspect"]) < 30


def test_the_strip_of_a_doubtful_crossing_is_grey(site: Site) -> None:
    for doubtful, most in ((False, 255), (True, 12)):
        strip = rigidity_strip(view_of(site, "suspect"), doubtful=doubtful).astype(int)
        assert (np.ptp(strip, axis=2).max() > 100) != doubtful
        assert np.ptp(strip, axis=2).max() <= most


def test_tabs_distinguish_crossings(site: Site) -> None:
    good = view_of(site, "good")
    assert tab_name(good) == "2026-09-21 14:13 → bridge-1, good"
    back = view_of(site, "suspect", forward=False, entry_time_s=good.entry_time_s + 60.0)
    assert tab_name(back) == "2026-09-21 14:14 ← bridge-1, suspect"


def test_the_verdict_says_doubt_first_and_the_misfit_once(site: Site) -> None:
    text = verdict_markdown(view_of(site, "suspect"))
    assert text.splitlines()[2] == "**Doubtful. Do not rely on these values.**"
    assert text.count("reduced chi-square") == 1
    assert "Doubtful" not in verdict_markdown(view_of(site, "good"))


@pytest.mark.process
def test_the_overview_is_seen_also_before_the_bridge(tmp_path: Path, site: Site) -> None:
    """Rerun 0.41 draws no picture in a file format while the chainage is negative, as at first."""
    converted(tmp_path, site, "good")
    with opened(tmp_path / "found.rrd", tmp_path, size="1400x850") as viewer:
        viewer.set_time("chainage_mm", sequence=-1500, play_state="paused")
        drawn = pixels(picture(viewer, view_named(viewer, "Stiffness")))
        orange = np.abs(drawn - np.array([230, 159, 0]) / 255.0).max(axis=2) < 0.05
        assert orange.sum() > 2_000  # the bar of element 4
        assert complaints(viewer) == []


@pytest.mark.parametrize("verdict", ["good", "suspect", "rejected"])
def test_every_view_has_something_to_show(tmp_path: Path, site: Site, verdict: str) -> None:
    """Without a viewer: what the layout names is in the file."""
    reasons = () if verdict == "good" else ("position_outage",)
    used = None if verdict == "rejected" else "a"
    found = results_of(site, some_crossing("a", verdict=verdict, reasons=reasons), used=used)
    signals = signals_of_messages(drive())
    overviews = views_of_bridges(found, site)
    write_rrd(tmp_path / "found.rrd", RerunContent(signals, found.crossings, site, overviews))
    entities = {
        chunk.entity_path for chunk in RrdReader(tmp_path / "found.rrd").stream().to_chunks()
    }
    views = [view_of_crossing(crossing, site.bridges[0]) for crossing in found.crossings]
    on_map = bridges_of_site(site)
    scenes = scenes_of(views, signals, on_map, on_map, overviews)
    named = list(origins(blueprint(signals, scenes, overviews, bridges=on_map).root_container))
    assert len(named) >= (5 if verdict == "rejected" else 8)
    for origin in named:
        assert any(path.startswith(f"/{origin}") for path in entities), origin


@pytest.mark.parametrize("verdict", ["good", "rejected"])
def test_panel_is_laid_out_and_drawn_where_it_has_data(
    tmp_path: Path, site: Site, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A panel more takes its module, and its line in the columns."""
    panel = Panel(
        lambda scene: scene.crossing.rigidity_nm2,
        lambda scene, _: rrb.TextDocumentView(origin=f"{scene.root}/lowest"),
        lambda to, scene, ei: log_markdown(to, f"{scene.root}/lowest", f"{ei.min():.3g} N·m²"),
    )
    first, *others = crossing_tab._COLUMNS
    monkeypatch.setattr(
        crossing_tab, "_COLUMNS", (first, *others, others[-1]._replace(panels=(panel,)))
    )
    reasons = () if verdict == "good" else ("position_outage",)
    found = results_of(site, some_crossing("a", verdict=verdict, reasons=reasons))
    views = [view_of_crossing(crossing, site.bridges[0]) for crossing in found.crossings]
    write_rrd(tmp_path / "a.rrd", RerunContent({}, found.crossings, site))
    drawn = {chunk.entity_path for chunk in RrdReader(tmp_path / "a.rrd").stream().to_chunks()}
    scenes = scenes_of(views, {}, [], [], [])
    named = set(origins(blueprint({}, scenes).root_container))
    entity = f"{crossing_root(views[0])}/lowest"
    assert (entity in named) == (f"/{entity}" in drawn) == (verdict == "good")


def origins(part: rrb.Container | rrb.View) -> Iterator[str]:
    if isinstance(part, rrb.View):
        if part.origin != "/" and "acceleration" not in str(part.origin):
            yield str(part.origin)
        return
    for child in part.contents:
        yield from origins(child)


def test_a_baseline_that_the_site_file_names_is_drawn_and_compared_with(
    tmp_path: Path, project: Path
) -> None:
    toml = (project / "docs/site.example.toml").read_text()
    (tmp_path / "site.toml").write_text(
        toml.replace("[bridge]\n", '[bridge]\nbaseline = "then.json"\n')
    )
    site = load_site(tmp_path / "site.toml")
    before = results_of(site, some_crossing("b"), used="b", ratios=np.full(7, 0.8))
    now = results_of(site, some_crossing("a"), used="a")
    (tmp_path / "now.json").write_text(results_json(now))
    drawn = {}
    for named in (False, True):
        if named:
            (tmp_path / "then.json").write_text(results_json(before))
        convert(tmp_path / "now.json", tmp_path / "now.rrd", site=tmp_path / "site.toml")
        chunks = RrdReader(tmp_path / "now.rrd").stream().to_chunks()
        drawn[named] = {chunk.entity_path: chunk for chunk in chunks}
    line = "/crossing/a/pre/strip/baseline"
    assert line in drawn[True]
    assert line not in drawn[False]  # a warning, no error: the file need not be there
    for path in ("/bridge/bridge-1/finding", "/crossing/a/pre/verdict"):
        (text,) = value(drawn[True][path], "text")  # type: ignore[misc]
        assert "50 % less stiff than the baseline" in text
    (view,) = views_of_bridges(now, site, tmp_path)
    with matplotlib.rc_context(STYLE):
        legend = draw_bridge(view).axes[0].get_legend()
    assert "baseline" in {text.get_text() for text in legend.get_texts()}
