"""`driveby report`: what it says is what was found, it is one file, and nothing in it is alive."""

import json
import re
import subprocess
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.reasons import REASON_TEXTS, BridgeReason, Reason
from schemas.results import CrossingResult, Prior, Results, results_json
from schemas.site import Site
from schemas.site_file import site_toml
from services.cli.identify import _fit_lines
from services.common.errors import FailureError
from services.common.language import ENGLISH, language_of
from services.execution.fuse_results import fuse_bridge
from services.history.validation_files import save
from services.report import pdf
from services.report.advice import next_steps
from services.report.bridge import _finding, bridge_reports
from services.report.evidence import measures_of
from services.report.html import Html, inlined_svg, joined, tag
from services.report.page import page
from services.report.place import ends_of, start_of
from tests.builders.certificates import certificate
from tests.builders.commands import run
from tests.fleet import losses_of
from tests.unit.viewer.found import RATIOS, results_of, some_crossing


class Seen(HTMLParser):
    """What is in a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.words: list[str] = []
        self.is_inline = False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        self.is_inline = tag == "span"

    def handle_endtag(self, tag: str) -> None:
        self.is_inline = tag == "span"

    def handle_data(self, data: str) -> None:
        if self.is_inline:
            self.words[-1] += data
        elif self.tags[-1:] != ["style"]:
            self.words.append(data)
        self.is_inline = False

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def reported(
    site: Site, *results: Results, baseline: Path | None = None, language: str = "en"
) -> Seen:
    files = [(Path(f"{n}.json"), one, site) for n, one in enumerate(results)]
    words = language_of(language)
    return Seen(page(bridge_reports(files, baseline, language=words), language=words))


def test_the_first_page_names_the_weak_element_its_loss_and_its_interval(site: Site) -> None:
    crossings = [some_crossing("a"), some_crossing("b", entry=86400.0)]
    text = reported(site, results_of(site, *crossings, used="b")).text
    assert "One element is clearly less stiff." in text
    assert (
        "Element 4 (12.9 to 17.1 m) is 60 % less stiff than the other elements "
        "(95 % interval 58 to 62 %)." in text
    )
    assert (
        f"{ENGLISH.text('rest.others', within=3)} {ENGLISH.text('rest.detectable', loss=20)}"
        in text
    )
    assert "“Clearly less stiff” means that the whole 95 % interval lies more than 10 %" in text
    assert "Look there for cracks" in text
    assert "The engineer decides how soon" in text
    assert (
        "Bridge 30 m, 7 elements, counted from the south-west end (36.11060° N, 140.10100° E)"
        in text
    )
    assert "2026-09-21 to 2026-09-22, with truck-1" in text
    assert "2 crossings: 2 good. The numbers below are from the newest usable crossing." in text
    assert "The other good crossing agrees with them: at most 0.0 standard deviations apart" in text
    assert "class A of ISO 8608, IRI 2.4 m/km" in text
    assert "not a condition rating" in text
    assert "Have element 4 (12.9 to 17.1 m from the south-west end) inspected." in text
    assert (
        "If it was built differently from the other elements, the difference is not damage." in text
    )
    assert "Drive again on another day, in the other direction and with another truck:" in text
    assert "Keep these results as a baseline" in text
    # Where there is no baseline that is said, and what it means.
    assert "the other elements (no baseline is stored)" in text
    assert "A loss that affects all elements equally cannot be detected without a baseline." in text
    # The evidence.
    assert "reduced chi-square (χ²/dof) 1.02 1.02 residuals relative to the declared noise" in text
    assert "weight of the truck's body equations (%) 100 100 100 %" in text
    assert "rotational restraint (%) 3 and 4 3 and 4 probability" in text
    assert "R-hat 1.004 1.004 agreement" in text
    assert "truck-1 south-west to north-east 10.0 pre good yes" in text
    # What measured, and when.
    assert "truck-1: 9.5 t, wheelbase 4.4 m, axle loads" in text
    assert "front and rear on body and axles" in text
    assert "Computation started at 2026-09-21 " in text
    assert "UTC" in text


def test_measures_name_the_criterion_of_weighted_draws(site: Site) -> None:
    (known,) = results_of(site, some_crossing("a"), used="a").crossings
    one = known.model_copy(update={"diagnostics": {**known.diagnostics, "pareto_k": 0.719}})
    (added,) = set(measures_of(one, ENGLISH)) - set(measures_of(known, ENGLISH))
    assert (added.name, added.value) == ("pareto_k", "0.719")
    assert ENGLISH.text("meaning.pareto_k").endswith("must be at most 0.7")


def test_measures_of_many_crossings_keep_their_meanings_readable(site: Site) -> None:
    """A column of its own would be some letters wide beside six crossings."""
    many = [some_crossing(name, entry=60.0 * n) for n, name in enumerate("abcdef")]
    text = reported(site, results_of(site, *many, used="f")).text
    assert "R-hat agreement between chains of draws; must be below 1.05 1.004 1.004" in text
    assert "Meaning" not in text
    assert "Meaning" in reported(site, results_of(site, *many[:3], used="c")).text


def test_a_nominal_value_that_is_too_high_is_no_damage_everywhere(site: Site) -> None:
    sound = results_of(site, some_crossing("a"), used="a", ratios=np.full(7, 0.86))
    text = reported(site, sound).text
    assert "No element is clearly less stiff." in text
    assert ENGLISH.text("all.others", within=1) in text
    assert "(not the overall stiffness, which is a mean) is 0.86 times the nominal value" in text


def test_a_baseline_shows_what_all_elements_share(site: Site, tmp_path: Path) -> None:
    then = tmp_path / "then.json"
    then.write_text(results_json(results_of(site, some_crossing("a"), used="a")))
    now = results_of(site, some_crossing("b"), used="b", ratios=0.7 * RATIOS)
    text = reported(site, now, baseline=then).text
    assert "7 elements are clearly less stiff." in text
    assert "Element 1 (0.0 to 4.3 m) is 30 % less stiff than the baseline (95 % interval" in text
    assert "Compared with the baseline then.json" in text
    assert "element 1 (0.0 to 4.3 m from the south-west end)" in text
    last = (
        "element 7 (25.7 to 30.0 m from the south-west end, 0.0 to 4.3 m from the north-east end)"
    )
    assert last in text
    assert " and the bearing there inspected." in text
    assert "Keep these results" not in text
    assert "built differently" not in text
    assert "No baseline is stored" not in text
    assert "compare surveys of" not in reported(site, now).text
    unchanged = reported(site, results_of(site, some_crossing("b"), used="b"), baseline=then).text
    assert (
        f"{ENGLISH.text('all.baseline', within=1)} {ENGLISH.text('rest.detectable', loss=23)}"
        in unchanged
    )
    for report in (text, unchanged):
        assert "compare surveys of the same truck in the same wheel path." in report


def test_before_and_after_stand_beside_each_other_with_the_change(
    site: Site, tmp_path: Path
) -> None:
    then = tmp_path / "then.json"
    earlier = fused(site, KNOWN)
    then.write_text(results_json(earlier))
    ratios = np.ones(7)
    ratios[3] = 0.7 * 0.4
    now = results_of(site, some_crossing("z", entry=9e6), used="z", ratios=ratios)
    found = reported(site, now, baseline=then)
    assert (
        "Compared with the baseline then.json: 3 crossings on 2026-09-21, with truck-1; that "
        "measurement is good" in found.text
    )
    assert "Element From–to (m) Before (GN·m²) After (GN·m²) Change (95 % interval)" in found.text
    old = earlier.bridges[site.bridges[0].id].elements["EI_4"]
    new = now.bridges[site.bridges[0].id].elements["EI_4"]
    before, after = (
        f"{one.mean / 1e9:.2f} ({one.q025 / 1e9:.2f}–{one.q975 / 1e9:.2f})" for one in (old, new)
    )
    left_out = some_crossing("s", verdict="suspect", reasons=("position_outage",))
    more = (*earlier.crossings, *results_of(site, left_out).crossings)
    then.write_text(results_json(earlier.model_copy(update={"crossings": more})))
    words = "that measurement is good (1 other crossing is excluded)"
    assert words in reported(site, now, baseline=then).text
    change = round(100.0 * (new.mean / old.mean - 1.0))
    assert f"4 12.9–17.1 {before} {after} −{abs(change)} % (" in found.text
    assert "Repeat the survey in the same season" not in found.text.partition("What to do")[0]
    assert "Repeat the survey in the same season" in found.text


@pytest.mark.usefixtures("drawn")
def test_wide_tables_and_figures_scroll_on_a_phone(site: Site) -> None:
    found = reported(site, results_of(site, some_crossing("a"), used="a"))
    facts = found.attributes.count(("class", "facts"))
    wide = found.attributes.count(("class", "wide"))
    figures = found.tags.count("figure") - found.attributes.count(("class", "sketch"))
    assert wide == found.tags.count("table") - facts + figures


def test_every_finding_has_a_next_step(site: Site) -> None:
    suspect = some_crossing("a", verdict="suspect", reasons=("position_outage",))
    kinds = {
        "weak": fused(site, KNOWN),
        "sound": results_of(site, some_crossing("a"), used="a", ratios=np.ones(7)),
        "open": fused(site, [0.6] * 7),
        "doubtful": results_of(site, suspect, used="a"),
        "nothing": results_of(
            site, some_crossing("a", verdict="rejected", reasons=("speed_too_low",))
        ),
    }
    for kind, found in kinds.items():
        (report,) = bridge_reports([(Path("x.json"), found, site)], None)
        assert report.finding.kind == kind
        assert list(next_steps(report, ENGLISH)), kind
    twins = reported(site, kinds["open"]).text
    assert "Use a truck with equal single tyres on all axles or with an equalised tandem" in twins
    truck = site.vehicles[0].model_copy(update={"twin_tyre_distance_m": (0.0, 0.0)})
    single = reported(site.model_copy(update={"vehicles": (truck,)}), kinds["open"]).text
    assert "use a truck with equal single tyres" not in single
    assert "tandem" not in single
    assert "Another truck would hardly help" in single


def test_a_suspect_result_is_doubtful_and_says_why(site: Site) -> None:
    suspect = some_crossing("a", verdict="suspect", reasons=("position_outage",))
    found = reported(site, results_of(site, suspect, used="a"))
    assert ("class", "finding doubtful") in found.attributes
    assert "Doubtful. Do not rely on these values." in found.text
    assert f"The reasons: {REASON_TEXTS[Reason.POSITION_OUTAGE]}" in found.text
    assert "Check the GNSS receiver and its antenna." in found.text
    assert "less stiff?" in found.text
    assert ("class", "weak") not in found.attributes


def test_all_rejected_crossings_give_the_reasons(site: Site) -> None:
    why = (("speed_too_low",), ("speed_too_low", "model_misfit"))
    rejected = [
        some_crossing(name, verdict="rejected", reasons=reasons)
        for name, reasons in zip("ab", why, strict=True)
    ]
    found = reported(site, results_of(site, *rejected))
    assert "No statement on this bridge is possible." in found.text
    assert (
        "2 of 2 crossings: The truck was so slow that the bridge's stiffness hardly affects its"
        in found.text
    )
    assert "Drive again, at 5 m/s or more." in found.text
    assert "neither that the bridge is undamaged nor that it is damaged" in found.text
    assert found.tags.count("svg") == 1  # the sketch, and no picture without a number
    assert "GN·m²" not in found.text


def test_inconsistent_crossings_are_reported(site: Site) -> None:
    one = results_of(site, some_crossing("a"), used="a")
    other = results_of(site, some_crossing("b", entry=60.0), used="b", ratios=1.5 * RATIOS)
    merged = other.model_copy(update={"crossings": one.crossings + other.crossings})
    assert "does NOT agree with them: up to 9.6 standard" in reported(site, merged).text


def test_what_single_crossings_say_of_a_weak_element_shows_how_far_they_scatter(
    site: Site,
) -> None:
    one = results_of(site, some_crossing("a"), used="a")
    ratios = RATIOS.copy()
    ratios[3] = 0.5
    other = results_of(site, some_crossing("b", entry=60.0), used="b", ratios=ratios)
    third = results_of(site, some_crossing("c", verdict="suspect", reasons=("position_outage",)))
    everything = one.crossings + other.crossings + third.crossings
    merged = other.model_copy(update={"crossings": everything})
    output = "According to each of the 2 good crossings alone, element 4 is 50 to 60 % less stiff."
    assert output in reported(site, merged).text
    assert "crossings alone" not in reported(site, one).text
    ratios[3] = 1.2
    stiff = results_of(site, some_crossing("b", entry=60.0), used="a", ratios=ratios)
    mixed = stiff.model_copy(update={"crossings": one.crossings + stiff.crossings[:1]})
    mixed = mixed.model_copy(update={"bridges": one.bridges})
    output = "alone, element 4 is between 20 % stiffer and 60 % less stiff."
    assert output in reported(site, mixed).text
    german = reported(site, mixed, language="de").text
    assert "ist Element 4 zwischen 20 % steifer und 60 % weniger steif." in german


@pytest.mark.parametrize(
    ("spread", "words"),
    [
        (0.005, "; the estimate from all crossings together is more"),
        (0.05, "; the interval from all crossings together"),
    ],
)
def test_only_a_narrower_interval_is_called_more_precise(
    site: Site, spread: float, words: str
) -> None:
    """The state includes the variability between crossings, so it may be wider than the best."""
    text = reported(site, fused(site, [0.03] * 3 + [spread] + [0.03] * 3)).text
    assert f"3 good crossings alone, element 4 is 60 % less stiff{words}" in text
    assert ("more precise" in text) == (spread < 0.01)


def test_estimate_outside_the_range_of_single_ones_is_explained(site: Site) -> None:
    """What crossings have in common is estimated once: the product is no mean of its factors."""
    both = results_of(site, some_crossing("a"), some_crossing("b", entry=60.0), used="a")
    for ratio, number in ((0.4, 0), (0.5, 1)):
        ratios = RATIOS.copy()
        ratios[3] = ratio
        state = results_of(site, some_crossing("a"), used="a", ratios=ratios).bridges["bridge-1"]
        state = state.model_copy(update={"crossings_used": ("a", "b")})
        merged = both.model_copy(update={"bridges": {"bridge-1": state}})
        text = reported(site, merged).text
        assert "2 good crossings alone, element 4 is 60 % less stiff" in text
        assert text.count("lies outside the range of the single estimates") == number
        german = reported(site, merged, language="de").text
        assert german.count("liegt außerhalb des Bereichs der einzelnen") == number


def test_an_element_that_seems_stiffer_is_a_warning_of_its_neighbours(
    site: Site, tmp_path: Path
) -> None:
    then = tmp_path / "then.json"
    then.write_text(results_json(results_of(site, some_crossing("a"), used="a")))
    ratios = RATIOS.copy()
    ratios[3:5] *= 0.6, 1.24
    now = results_of(site, some_crossing("b"), used="b", ratios=ratios)
    assert "Element 5 appears stiffer than before, which" in reported(site, now, baseline=then).text
    assert "If element 5 was not built stiffer than the others" in reported(site, now).text
    assert "plausible" not in reported(site, now, baseline=then).text
    usual = results_of(site, some_crossing("b"), used="b")
    assert "stiffer" not in reported(site, usual).text


def test_several_weak_elements_share_a_sentence_on_single_crossings(site: Site) -> None:
    ratios = RATIOS.copy()
    ratios[1] = 0.5
    files = [results_of(site, some_crossing("a"), used="a", ratios=ratios)]
    files.append(results_of(site, some_crossing("b", entry=60.0), used="b", ratios=ratios))
    text = reported(site, *files).text
    assert (
        "According to each of the 2 good crossings alone, element 4 is 60 % less stiff and element "
        in text
    )
    assert text.count("crossings alone") == 1
    assert "element 2 (4.3 to 8.6 m from the south-west end) and element 4 (" in text


def test_several_files_are_one_report_and_the_newest_result_of_a_crossing_counts(
    site: Site,
) -> None:
    first = results_of(site, some_crossing("a"), some_crossing("b", entry=60.0), used="b")
    again = some_crossing("a", verdict="rejected", reasons=("gap_on_bridge",))
    second = results_of(site, again).model_copy(update={"created": first.created + 1.0})
    for order in ((first, second), (second, first)):
        text = reported(site, *order).text
        assert "2 crossings: 1 good, 1 rejected." in text
        assert "Element 4" in text  # the state of the older file


def test_several_surveys_are_fused_and_other_campaigns_are_named(site: Site) -> None:
    drives = losses_of({"bridge-1": None}, 1.79e9, 3)
    surveys = [drives.crossings[:3], drives.crossings[3:]]
    files = []
    for number, survey in enumerate(surveys):
        state = fuse_bridge("bridge-1", survey)
        assert state is not None
        assert len(state.crossings_used) == 3
        header = {"created": drives.created + number, "bridges": {"bridge-1": state}}
        files.append(drives.model_copy(update={"crossings": survey, **header}))
    together = fuse_bridge("bridge-1", drives.crossings)
    assert together is not None
    text = reported(site, *files).text
    assert (
        "6 crossings: 6 good. All were simulated. The numbers below combine all 6 crossings;"
        in text
    )
    assert f" {together.elements['EI_1'].mean / 1e9:.2f} " in text
    other = _in_realm(surveys[0], "sim-other")
    text = reported(site, files[0].model_copy(update={"crossings": other}), files[1]).text
    assert (
        "3 of them belong to another campaign (realm sim-other) and are not included in the numbers"
        in text
    )
    assert "The numbers below combine 3 of them;" in text
    # A results file whose state is that of the earlier campaign: the later one is another.
    both = files[0].model_copy(update={"crossings": (*surveys[0], *_in_realm(surveys[1], "late"))})
    text = reported(site, both).text
    assert (
        "3 of them belong to another campaign (realm late) and are not included in the numbers"
        in text
    )
    assert "The numbers below combine 3 of them;" in text


@pytest.mark.parametrize("is_later", [False, True])
def test_crossing_of_two_realms_counts_once(site: Site, is_later: bool) -> None:
    """It was exported and imported: its results carry one identifier."""
    drives = losses_of({"bridge-1": None}, 1.79e9, 3)
    state = fuse_bridge("bridge-1", drives.crossings)
    assert state is not None
    first = drives.model_copy(update={"bridges": {"bridge-1": state}})
    twice = {
        "crossings": _in_realm(drives.crossings[1:3], "import-drives"),
        "created": drives.created + (1.0 if is_later else -1.0),
        "bridges": {},
    }
    files = (first, drives.model_copy(update=twice))
    text = reported(site, *files).text
    assert "6 crossings: 6 good. All were simulated. The numbers below combine all 6" in text
    assert "another campaign" not in text
    names = ", ".join(one.crossing_id for one in drives.crossings[1:3])
    own = drives.crossings[0].realm
    assert (
        "2 crossings are also in realm import-drives and are counted once, with their results "
        f"of realm {own}: {names}." in text
    )
    assert "zählen einmal" in reported(site, *files, language="de").text


def _in_realm(crossings: Sequence[CrossingResult], realm: str) -> tuple[CrossingResult, ...]:
    return tuple(one.model_copy(update={"realm": realm}) for one in crossings)


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    "bad", ["<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "a & b < c", "$\\frac$"]
)
def test_nothing_from_a_file_becomes_part_of_the_page(site: Site, bad: str) -> None:
    bridges = (site.bridges[0].model_copy(update={"owner_id": bad}),)
    hostile = site.model_copy(update={"bridges": bridges})
    crossing = some_crossing(bad, verdict="suspect", reasons=("position_outage",))
    crossing |= {"vehicle": bad, "realm": bad, "reason_texts": [bad]}
    results = results_of(site, crossing, used=bad).model_copy(update={"version": bad})
    text = page(bridge_reports([(Path(f"{bad.replace('/', '')}.json"), results, hostile)], None))
    seen = Seen(text)
    assert not {"script", "img", "iframe", "object", "link", "a"} & set(seen.tags)
    assert not [name for name, _ in seen.attributes if name.startswith("on")]
    assert bad in seen.text  # as words


@pytest.mark.usefixtures("drawn")
def test_it_needs_nothing_but_itself(site: Site) -> None:
    text = page(
        bridge_reports(
            [(Path("x.json"), results_of(site, some_crossing("a"), used="a"), site)], None
        )
    )
    seen = Seen(text)
    assert (
        "content",
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:",
    ) in seen.attributes
    links = [value for name, value in seen.attributes if name in ("src", "href", "xlink:href")]
    assert links
    assert all(value.startswith("#") for value in links)
    urls = set(re.findall(r"https?://[^\s\"'<>]+", text))
    assert urls <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert not re.search(r"url\((?!#)|@import", text)
    # Names within the pictures are unique and lead somewhere, though there are several of them.
    names = [value for name, value in seen.attributes if name == "id"]
    assert len(names) == len(set(names))
    wanted = {value[1:] for value in links} | set(re.findall(r"url\(#([^)]+)\)", text))
    assert wanted <= set(names)


def test_text_is_escaped_unless_it_is_html() -> None:
    assert (
        tag("p", "a < b", tag("b", "&"), class_='"') == '<p class="&quot;">a &lt; b<b>&amp;</b></p>'
    )
    assert joined("<", Html("<br>")) == "&lt;<br>"
    svg = b'<?xml?><svg><path id="m1"/><use xlink:href="#m1" clip-path="url(#c)"/></svg>'
    inlined = inlined_svg(svg, "p-", '"x"')
    assert 'id="p-m1"' in inlined
    assert 'xlink:href="#p-m1"' in inlined
    assert "url(#p-c)" in inlined
    assert 'aria-label="&quot;x&quot;"' in inlined


@pytest.fixture
def written(tmp_path: Path, site: Site) -> tuple[Path, Path]:
    """A results file and its site file."""
    (tmp_path / "site.toml").write_text(site_toml(site))
    found = results_of(site, some_crossing("a"), used="a")
    (tmp_path / "found.json").write_text(results_json(found))
    return tmp_path / "found.json", tmp_path / "site.toml"


@pytest.mark.usefixtures("drawn")
def test_the_command_writes_the_page_and_says_the_finding(
    capsys: pytest.CaptureFixture[str], written: tuple[Path, Path], tmp_path: Path
) -> None:
    found, site = written
    out = tmp_path / "r.html"
    code, output, err = run(capsys, "report", found, "--site", site, "-o", out)
    assert (code, err) == (0, "")
    assert output.startswith(
        "bridge-1: One element is clearly less stiff. Element 4 (12.9 to 17.1 m)"
    )
    assert "Element 4" in Seen(out.read_text()).text
    first = out.read_bytes()
    assert run(capsys, "report", found, "--site", site, "-o", out)[0] == 0
    assert out.read_bytes() == first  # the same results give the same report


def test_the_baseline_of_the_site_file_lies_beside_it(
    capsys: pytest.CaptureFixture[str], written: tuple[Path, Path], tmp_path: Path
) -> None:
    found, site = written
    (tmp_path / "sites").mkdir()
    toml = site.read_text().replace("[bridge]\n", '[bridge]\nbaseline = "then.json"\n')
    (tmp_path / "sites" / "site.toml").write_text(toml)
    options = (found, "--site", tmp_path / "sites" / "site.toml", "-o", tmp_path / "r.html")
    code, out, err = run(capsys, "report", *options)
    assert (code, out) == (2, "")
    assert "then.json: no such file" in err
    (tmp_path / "sites" / "then.json").write_bytes(found.read_bytes())
    assert run(capsys, "report", *options)[0] == 0
    assert (
        "No element has clearly changed (estimates changed by up to 1 %)"
        in (tmp_path / "r.html").read_text()
    )


def test_the_baseline_of_a_recording_lies_beside_its_results(
    site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The site file that a recording carries has no folder of its own."""
    bridge = site.bridges[0].model_copy(update={"baseline": "then.json"})
    named = site.model_copy(update={"bridges": (bridge,)})
    now = results_of(site, some_crossing("b"), used="b")
    files = [(tmp_path / "now.json", now, named)]
    assert "No baseline is stored" in Seen(page(bridge_reports(files, None))).text
    assert "the baseline" in caplog.text
    then = results_of(site, some_crossing("a"), used="a")
    (tmp_path / "then.json").write_text(results_json(then))
    assert "Compared with the baseline then.json" in Seen(page(bridge_reports(files, None))).text


def test_what_cannot_be_reported_is_one_line_and_leaves_nothing(
    capsys: pytest.CaptureFixture[str], written: tuple[Path, Path], tmp_path: Path
) -> None:
    found, site = written
    content = json.loads(found.read_text())

    def changed(name: str, change: dict[str, Any]) -> Path:
        other = json.loads(json.dumps(content))
        other["crossings"][0] |= change
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(other))
        return path

    parameters = {k: v for k, v in content["crossings"][0]["parameters"].items() if k != "EI_7"}
    with_site = ("--site", site)
    for arguments, words in (
        ((found,), "results lack the bridge's position"),
        ((tmp_path / "none.json", *with_site), "no such file"),
        ((site, *with_site), "not a results file"),
        ((found, *with_site, "-o", tmp_path / "r.txt"), "an HTML file (.html) is expected"),
        ((found, *with_site, "-o", tmp_path / "r.pdf"), "; --pdf prints it to"),
        ((found, *with_site, "-o", tmp_path / "no" / "r.html"), "does not exist"),
        ((found, *with_site, "--baseline", changed("b", {}).with_name("x.json")), "no such file"),
        (
            (changed("c", {"parameters": parameters}), *with_site),
            "does not have the 7 elements that",
        ),
        ((changed("d", {"entry_time": 1e300}), *with_site), "is not a time in s since 1970"),
        ((changed("e", {"bridge": "b-9"}), *with_site), "has results of b-9, which"),
    ):
        out = () if "-o" in arguments else ("-o", tmp_path / "r.html")
        code, output, err = run(capsys, "report", *arguments, *out)
        assert (code, output) == (2, ""), words
        assert words in err.splitlines()[-1]
        assert not (tmp_path / "r.html").exists()


def test_pdf_without_a_browser_writes_the_page_and_advises(
    capsys: pytest.CaptureFixture[str],
    written: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    found, site = written
    code, out, err = run(
        capsys, "report", found, "--site", site, "-o", tmp_path / "r.html", "--pdf"
    )
    assert (code, out.splitlines()[-1]) == (1, str(tmp_path / "r.html"))
    assert len(err.splitlines()) == 1
    assert "--pdf needs Chromium, Chrome or Edge, none is installed" in err
    assert (tmp_path / "r.html").exists()
    assert not (tmp_path / "r.pdf").exists()


def test_a_browser_that_prints_nothing_is_a_failure_with_the_page_left(
    capsys: pytest.CaptureFixture[str],
    written: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pdf, "find_browser", lambda: "true")
    found, site = written
    code, _, err = run(capsys, "report", found, "--site", site, "-o", tmp_path / "r.html", "--pdf")
    assert code == 1
    assert "true ended with 0 and printed nothing; the report is in" in err
    assert (tmp_path / "r.html").exists()
    assert not (tmp_path / "r.pdf").exists()


@pytest.fixture
def browser(drawn: None) -> str:
    """The browser that prints; without one the test is left out."""
    try:
        return pdf.find_browser()
    except FailureError as error:
        pytest.skip(str(error))


def number_of_sheets(printed: Path) -> int:
    return len(re.findall(rb"/Type\s*/Page\b", printed.read_bytes()))


@pytest.mark.process
@pytest.mark.usefixtures("browser")
def test_on_paper_a_bridge_of_one_crossing_has_two_pages(
    capsys: pytest.CaptureFixture[str], written: tuple[Path, Path], tmp_path: Path
) -> None:
    """The first page holds all that an owner needs."""
    found, site = written
    code, out, _ = run(capsys, "report", found, "--site", site, "-o", tmp_path / "r.html", "--pdf")
    assert code == 0
    assert out.splitlines()[-1] == str(tmp_path / "r.pdf")
    assert (tmp_path / "r.pdf").read_bytes().startswith(b"%PDF")
    assert number_of_sheets(tmp_path / "r.pdf") == 2


def fused(
    site: Site, spreads: list[float], *, left_out: tuple[str, ...] = (), **state: Any
) -> Results:
    """Three good crossings and their state, each element with a relative standard deviation."""
    names = "abc"
    found = results_of(site, *(some_crossing(n, entry=60.0 * k) for k, n in enumerate(names)))
    elements = {}
    for n, (ratio, spread) in enumerate(zip(RATIOS, spreads, strict=True), start=1):
        mean = ratio * site.bridges[0].nominal_flexural_rigidity_nm2[n - 1]
        low, high = mean * np.exp(-1.96 * spread), mean * np.exp(1.96 * spread)
        elements[f"EI_{n}"] = {"mean": mean, "std": spread * mean, "q025": low, "q975": high}
    given = {
        **elements, "verdict": "good", "crossings_used": list(names),
        "level": {"mean": 0.97, "std": 0.097, "q025": 0.8, "q975": 1.2},
        "between_crossing_std": 0.012, "between_crossing_std_q025": 0.0,
        "between_crossing_std_q975": 0.04,
        "crossings_left_out": [{"crossing_id": w, "reason": w} for w in left_out],
    }  # fmt: skip
    content = found.model_dump(mode="json")
    content["bridges"] = {site.bridges[0].id: given | state}
    return Results.model_validate(content)


KNOWN = [0.02] * 7


def without_weak(site: Site, spreads: list[float]) -> Results:
    """Such a state in which the fourth element is as its neighbours, and no error is common."""
    like_others = fused(site, [*spreads[:2], spreads[3], *spreads[3:]]).bridges["bridge-1"]
    level = {"mean": 0.97, "std": 0.0, "q025": 0.97, "q975": 0.97}
    return fused(site, spreads, EI_4=like_others.elements["EI_3"].model_dump(), level=level)


def test_on_paper_all_measures_and_the_signature_are_on_the_sheet_of_the_crossings(
    site: Site, tmp_path: Path, browser: str
) -> None:
    """The line for the signature was alone on the last sheet."""
    content = fused(site, KNOWN).model_dump(mode="json")
    for one in content["crossings"]:
        one["derived"]["probability_torsion"] = 0.03
        one["diagnostics"]["position_shift_m"] = 1.89
    html = tmp_path / "r.html"
    found = Results.model_validate(content)
    html.write_text(page(bridge_reports([(Path("drive.json"), found, site)], None)))
    pdf.write_pdf(html, tmp_path / "r.pdf", browser)
    assert number_of_sheets(tmp_path / "r.pdf") == 2


def test_on_paper_the_first_page_of_an_end_that_is_weak_is_one_sheet(
    site: Site, tmp_path: Path, browser: str
) -> None:
    """The longest: fused, and a bearing to be looked at. Then a sheet for all crossings."""
    nominal = site.bridges[0].nominal_flexural_rigidity_nm2
    state = {}
    for name, value in (("EI_4", 0.98 * nominal[3]), ("EI_7", 0.5 * nominal[6])):
        near = {"q025": 0.96 * value, "q975": 1.04 * value}
        state[name] = {"mean": value, "std": 0.02 * value, **near}
    html = tmp_path / "r.html"
    found = fused(site, KNOWN, **state)
    reports = bridge_reports([(Path("drive.json"), found, site)], None)
    html.write_text(page(reports))
    assert "the bearing there" in html.read_text()
    pdf.write_pdf(html, tmp_path / "r.pdf", browser)
    assert number_of_sheets(tmp_path / "r.pdf") == 2


@pytest.mark.process
@pytest.mark.parametrize("code", ["en", "de"])
def test_on_paper_the_first_page_of_a_comparison_is_one_sheet(
    site: Site, tmp_path: Path, browser: str, code: str
) -> None:
    """German needs more room; a line is left free, because paths and fonts differ."""
    then, html, words = tmp_path / "then.json", tmp_path / "r.html", language_of(code)
    then.write_text(results_json(fused(site, KNOWN)))
    ratios = RATIOS.copy()
    ratios[3:6] *= 0.6, 2.0, 0.7
    survey = (some_crossing(name, entry=9e6 + 60.0 * n) for n, name in enumerate("xyz"))
    now = results_of(site, *survey, used="z", ratios=ratios)
    reports = bridge_reports([(Path("drive.json"), now, site)], then, language=words)
    first, evidence, _ = page(reports, language=words).partition('<section class="evidence"')
    assert evidence
    assert words.choice("finding.implausible", 1, elements="5") in first
    assert words.text("page.signature") in first
    html.write_text(f"{first}<p>one more line</p></body></html>")
    pdf.write_pdf(html, tmp_path / "r.pdf", browser)
    assert number_of_sheets(tmp_path / "r.pdf") == 1


_OVERFLOW = """<script>document.title = "overflow: " + [...document.querySelectorAll(
"section.first .wide")].map(one => one.scrollWidth > one.clientWidth)</script>"""


@pytest.mark.process
@pytest.mark.parametrize("code", ["en", "de"])
def test_table_of_a_comparison_fits_a_window_of_900_pixels(
    site: Site, tmp_path: Path, browser: str, code: str
) -> None:
    then, html, words = tmp_path / "then.json", tmp_path / "r.html", language_of(code)
    then.write_text(results_json(fused(site, KNOWN)))
    ratios = RATIOS.copy()
    ratios[3:6] *= 0.6, 2.0, 0.7
    now = results_of(site, some_crossing("z", entry=9e6), used="z", ratios=ratios)
    text = page(bridge_reports([(Path("z.json"), now, site)], then, language=words), language=words)
    html.write_text(re.sub(r"<meta http-equiv[^>]*>", "", text) + _OVERFLOW)
    command = [browser, "--headless", "--no-sandbox", f"--user-data-dir={tmp_path / 'profile'}"]
    command += ["--window-size=900,1400", "--dump-dom", html.as_uri()]
    seen = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    found = re.search(r"<title>overflow: (.*?)</title>", seen)
    assert found is not None
    assert set(found[1].split(",")) == {"false"}


def test_fused_crossings_are_listed_with_their_agreement(site: Site) -> None:
    text = reported(site, fused(site, KNOWN, left_out=("suspect", "disagrees"))).text
    assert "One element is clearly less stiff." in text
    assert "The numbers below combine all 3 crossings; this measurement is good." in text
    assert "Excluded: 1 suspect; 1 disagrees with the others beyond its uncertainty." in text
    assert "Between-crossing variability of EI: 1.2 % (95 % interval 0.0 to 4.0 %)" in text
    assert "confirms them" not in text


def test_a_state_that_is_suspect_is_doubtful_though_its_crossings_are_good(site: Site) -> None:
    reasons = {"verdict": "suspect", "reasons": ["crossings_disagree"]}
    found = reported(site, fused(site, KNOWN, **reasons))
    assert ("class", "finding doubtful") in found.attributes
    assert "The reasons: Crossings scatter by more than their uncertainty explains" in found.text
    assert "this measurement is suspect" in found.text


def test_a_loss_beside_unresolved_elements_may_be_theirs(site: Site) -> None:
    text = reported(site, fused(site, [0.6, 0.4, 0.3, 0.05, 0.1, 0.1, 0.5])).text
    assert "Less stiff near element 4; the exact element is uncertain." in text
    assert "The loss may also be in the adjacent element 3." in text
    assert "Have element 3 (" in text.partition("What to do next")[2]
    assert (
        "Elements 1, 2, 3 and 7 are not resolved (standard deviation above 25 %). "
        f"{ENGLISH.text('rest.resolved', loss=57)} "
        "The overall stiffness is 0.97 times the nominal value, ± 10 %." in text
    )
    assert "differs clearly" not in text  # of what is known to a factor nothing is stated
    assert text.count("not resolved") == 1 + 4  # in words, and in the table


def test_where_no_element_is_resolved_none_is_called_sound(site: Site) -> None:
    found = reported(site, fused(site, [0.6] * 7))
    assert ("class", "finding open") in found.attributes
    assert (
        "Only the stiffness of the whole bridge could be determined, not that of single elements."
        in found.text
    )
    assert "No single element is resolved" in found.text
    assert "clearly" not in found.text.lower().partition("evidence")[0]
    assert "No element" not in found.text
    few = reported(site, fused(site, [0.6, 0.05, 0.05, 0.5, 0.05, 0.05, 0.05])).text
    assert "Elements 1 and 4 could not be determined (standard deviation above 25 %); no" in few
    assert few.count("standard deviation above 25 %") == 1
    assert "not resolved" not in few.partition("What to do next")[0].partition("Element")[0]


@pytest.mark.parametrize(
    ("spreads", "headline", "seen"),
    [
        (
            [0.02] * 6 + [0.3],
            "Element 7 could not be determined (standard deviation above",
            ("rest.resolved", 17),
        ),
        (
            [0.02] * 6 + [0.12],
            "No element is clearly less stiff, but a loss of 25 % may",
            ("rest.range", 42),
        ),
        (
            [0.24] * 7,
            "No element is clearly less stiff, but a loss of 25 % may",
            ("rest.detectable", 66),
        ),
        ([0.3] * 7, "Only the stiffness of the whole bridge could be determined", None),
    ],
)
def test_a_measurement_that_could_have_missed_a_loss_does_not_reassure(
    site: Site, spreads: list[float], headline: str, seen: tuple[str, int] | None
) -> None:
    sound = without_weak(site, spreads)
    found = reported(site, sound)
    assert ("class", "finding open") in found.attributes
    assert ("class", "finding sound") not in found.attributes
    assert headline in found.text
    german = reported(site, sound, language="de").text
    if seen is None:
        assert "with 95 % probability" not in found.text
    else:
        key, loss = seen
        values = {"loss": loss, "low": 17, "best": 1, "high": loss, "worst": 7}
        assert found.text.count("with 95 % probability") == 1  # once is enough
        assert ENGLISH.text(key, **values) in found.text
        assert language_of("de").text(key, **values) in german
    assert "Do not omit or postpone an inspection because of this measurement" in found.text
    assert "Plan the drives with driveby survey: it computes" in found.text
    assert "equalised tandem" in found.text
    assert "no additional inspection" not in found.text
    assert "Lassen Sie wegen dieser Messung keine Prüfung aus" in german


def test_a_finding_is_sound_only_where_a_large_loss_would_hardly_be_missed(site: Site) -> None:
    for spread, kind in ((0.04, "sound"), (0.05, "open")):
        results = without_weak(site, [spread] * 7)
        (report,) = bridge_reports([(Path("x.json"), results, site)], None)
        assert report.finding.kind == kind
        steps = " ".join(next_steps(report, ENGLISH))
        assert ("no additional inspection" in steps) == (kind == "sound")


def test_elements_that_cannot_be_compared_are_not_called_sound(site: Site) -> None:
    view = bridge_reports([(Path("x.json"), fused(site, KNOWN), site)], None)[0]
    found = _finding(view.view._replace(comparison=None), (), None, ENGLISH)
    assert found.kind == "open"
    alone = view._replace(finding=found, view=view.view._replace(comparison=None))
    steps = " ".join(next_steps(alone, ENGLISH))
    assert "Do not omit or postpone an inspection" in steps
    assert "Cross the bridge more often" not in steps


def test_suspect_crossings_that_were_not_used_are_not_called_nothing(site: Site) -> None:
    suspect = some_crossing("a", verdict="suspect", reasons=("noise_below_declared",))
    rejected = some_crossing("b", verdict="rejected", reasons=("sensor_saturated",), entry=60.0)
    alone = reported(site, results_of(site, suspect))
    assert ("class", "finding doubtful") in alone.attributes
    assert "The only crossing was suspect. A figure under “Evidence” shows its values" in alone.text
    assert ("aria-label", "EI and road profile of 1 crossings") in alone.attributes
    assert "EI (GN·m²)" not in alone.text  # the sentence promises no table, and there is none
    assert "nothing was measured" not in alone.text
    both = reported(site, results_of(site, suspect, rejected)).text
    assert "None of the 2 crossings is good; 1 is suspect." in both
    nothing = reported(site, results_of(site, rejected)).text
    assert "The only crossing was rejected; there are no usable values." in nothing
    assert nothing.index("An accelerometer reached") < nothing.index("Quality")


def test_something_is_to_be_done_about_every_reason() -> None:
    for code in ("en", "de"):
        language = language_of(code)
        assert set(language.advice) == set(Reason)
        assert set(language.bridge_advice) == set(BridgeReason)
        assert all(text.strip() for text in language.advice.values())
        assert all(text.strip() for text in language.bridge_advice.values())


def test_state_of_one_crossing_reports_its_wider_intervals(site: Site) -> None:
    one = fused(site, KNOWN, crossings_used=["c"])
    assert "include an assumed between-crossing variability" in reported(site, one).text
    alone = results_of(site, some_crossing("a"), used="a")
    assert "between-crossing variability" not in reported(site, alone).text


@pytest.mark.parametrize(
    ("end", "start_side", "end_side"),
    [
        ((36.2, 140.1), "south", "north"),
        ((36.1, 140.2), "west", "east"),
        ((36.0, 140.1), "north", "south"),
        ((36.05, 140.04), "north-east", "south-west"),
    ],
)
def test_ends_are_called_by_the_points_of_the_compass(
    site: Site, end: tuple[float, float], start_side: str, end_side: str
) -> None:
    changes = {
        "start_latitude_deg": 36.1, "start_longitude_deg": 140.1,
        "end_latitude_deg": end[0], "end_longitude_deg": end[1],
    }  # fmt: skip
    assert ends_of(site.bridges[0].model_copy(update=changes)) == (start_side, end_side)


def test_coordinates_of_the_other_hemispheres_are_written_as_people_do(site: Site) -> None:
    south = {"start_latitude_deg": -36.1, "end_latitude_deg": -36.1002}
    west = {"start_longitude_deg": -3.5, "end_longitude_deg": -3.5003}
    moved = site.bridges[0].model_copy(update=south | west)
    assert (
        start_of(moved)
        == "the north-east end (36.10000°\N{NO-BREAK SPACE}S, 3.50000°\N{NO-BREAK SPACE}W)"
    )


def test_no_change_has_no_sign(site: Site) -> None:
    ratios = np.array([1.0, 0.998, 1.002, 1.0, 1.0, 0.4, 1.0])
    text = reported(site, results_of(site, some_crossing("a"), used="a", ratios=ratios)).text
    assert " 0 % (" in text
    assert "−0 %" not in text
    assert "+0 %" not in text


def test_the_words_that_are_used_are_explained_and_no_others(site: Site) -> None:
    good = reported(site, results_of(site, some_crossing("a"), some_crossing("b"), used="b")).text
    words = good.rpartition(" Words ")[2]
    for word in (
        "Verdict:",
        "EI:",
        "95 % interval:",
        "Reduced chi-square, χ²:",
        "Draws:",
        "IRI, class",
    ):
        assert word in words
    assert "Channel:" not in words
    assert "Scatter: Noise, speed and temperature differ from crossing" in words
    rejected = some_crossing("a", verdict="rejected", reasons=("channel_swapped",))
    words = reported(site, results_of(site, rejected)).text.rpartition(" Words ")[2]
    assert "sprung_front and sprung_rear are on the body above an axle" in words
    assert "IRI" not in words
    assert "Draws" not in words


def test_of_a_rejected_crossing_stands_what_to_do_next(site: Site) -> None:
    rejected = some_crossing("a", verdict="rejected", reasons=("channel_swapped",))
    content = results_of(site, rejected).model_dump(mode="json")
    output = "Two channels seem to be swapped: sprung_front and sprung_rear."
    content["crossings"][0]["reason_texts"] = [output]
    text = reported(site, Results.model_validate(content)).text
    assert f"there are no usable values. {output}" in text
    what = text.partition("What to do next")[2].partition("What this does not mean")[0]
    assert "Check the wiring of these sensors." in what
    assert "drive the truck for a minute on any road and run driveby check REC" in what
    assert "Carry out the inspections that are due as if nothing had been measured" in what


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        ("log_normal", "torsion declared the lane is off the axis, so the deck twists"),
        (
            "half_normal",
            "torsion 100 % probability that loads in this lane twist the deck",
        ),
    ],
)
def test_declared_torsion_is_no_probability(site: Site, prior: str, words: str) -> None:
    plain = results_of(site, some_crossing("a"), used="a")
    known = plain.crossings[0]
    assert known.parameters is not None
    assert known.derived is not None
    torsion = known.parameters["EI_1"].model_copy(
        update={"prior": Prior(distribution=prior, location=1e-9, scale=0.5)}  # type: ignore[arg-type]
    )
    crossing = known.model_copy(
        update={
            "parameters": {**known.parameters, "torsion": torsion},
            "derived": known.derived.model_copy(update={"probability_torsion": 1.0}),
        }
    )
    assert words in reported(site, plain.model_copy(update={"crossings": (crossing,)})).text
    printed = " ".join(_fit_lines(crossing))
    assert ("declared" in printed) is (prior == "log_normal")
    assert ("probability that the deck twists" in printed) is (prior == "half_normal")


def test_quality_states_simulation_and_passed_site_validation(site: Site, tmp_path: Path) -> None:
    found = results_of(site, some_crossing("a"), used="a")
    (report,) = bridge_reports([(Path("x.json"), found, site)], None, validations=tmp_path)
    assert "simulated" not in report.quality
    crossings = tuple(one.model_copy(update={"realm": "sim-drive"}) for one in found.crossings)
    found = found.model_copy(update={"crossings": crossings})
    save(tmp_path, certificate(site))
    (report,) = bridge_reports([(Path("x.json"), found, site)], None, validations=tmp_path)
    assert "1 crossing: 1 good. It was simulated. " in report.quality
    assert re.search(r" Site validation of truck-1: passed; \d+ of \d+ intervals", report.quality)
    save(tmp_path, certificate(site, passed=False))
    (report,) = bridge_reports([(Path("x.json"), found, site)], None, validations=tmp_path)
    assert "passed" not in report.quality


def test_a_failed_site_validation_is_in_the_headline(site: Site, tmp_path: Path) -> None:
    """Who reads one line only must not take the finding for certain."""
    save(tmp_path, certificate(site, passed=False))
    failed = ENGLISH.text("finding.validation_failed")
    for results, kind in ((without_weak(site, KNOWN), "open"), (fused(site, KNOWN), "weak")):
        (plain,) = bridge_reports([(Path("x.json"), results, site)], None)
        assert failed not in plain.finding.headline
        (report,) = bridge_reports([(Path("x.json"), results, site)], None, validations=tmp_path)
        assert report.finding.headline.endswith(failed)
        assert report.finding.kind == kind
    assert "appears less stiff" in report.finding.headline


@pytest.mark.parametrize("code", ["en", "de"])
def test_headline_names_a_simulated_side_of_a_comparison(
    site: Site, tmp_path: Path, code: str
) -> None:
    language, then = language_of(code), tmp_path / "then.json"
    for realms, key in (
        (("sim-a", "live"), "simulated_baseline"),
        (("live", "sim-a"), "simulated_crossings"),
    ):
        ratios = np.ones(7), RATIOS
        before, now = (
            results_of(site, some_crossing(name) | {"realm": realm}, used=name, ratios=some)
            for name, realm, some in zip("ab", realms, ratios, strict=True)
        )
        then.write_text(results_json(before))
        (report,) = bridge_reports([(Path("x.json"), now, site)], then, language=language)
        appears = language.choice("finding.appears", 1)
        assert report.finding.headline == f"{appears} {language.text(f'finding.{key}')}"


@pytest.mark.parametrize("is_weak", [False, True])
def test_validation_is_a_next_step_where_the_finding_relies_on_intervals(
    site: Site, is_weak: bool
) -> None:
    results = fused(site, KNOWN) if is_weak else without_weak(site, KNOWN)
    (report,) = bridge_reports([(Path("x.json"), results, site)], None)
    step = ENGLISH.text("advice.validate")
    assert (step in next_steps(report, ENGLISH)) != is_weak
    assert step not in next_steps(report._replace(is_validated=True), ENGLISH)
