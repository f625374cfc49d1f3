"""What limits a finding stands on the first page, by the rule that it names, and only where it
holds.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib import rc_context

from schemas.alarms import Acknowledgement
from schemas.reasons import REASON_TEXTS, Reason
from schemas.results import ElementState, Results, results_json
from schemas.site import Site
from services.common.language import LANGUAGES, language_of
from services.history.bridge_history import BridgeHistory, ElementChange, PeriodComparison
from services.history.validation_files import save
from services.history.watch_files import MonitoringState
from services.identification.bridge_remarks import bridge_remarks
from services.report.advice import next_steps
from services.report.bridge import BridgeReport, bridge_reports
from services.report.earlier import season_of
from services.report.histories import with_history
from services.report.page import page
from services.simulation.drive import paper_site
from services.viewer.bridge_figure import draw_bridge
from services.viewer.drawing import STYLE
from tests.builders.certificates import certificate
from tests.unit.history.test_bridge_history import alarm
from tests.unit.history.test_history_store import BEGIN_S
from tests.unit.report.test_report import KNOWN, Seen, fused, reported, without_weak
from tests.unit.viewer.found import RATIOS, results_of, some_crossing, with_contradictions

GAP, OUTAGE = Reason.GAP_ON_BRIDGE, Reason.POSITION_OUTAGE
HALF_YEAR_S = 182.0 * 86400.0


def report_on(site: Site, *results: Results, baseline: Path | None = None) -> BridgeReport:
    files = [(Path(f"{n}.json"), one, site) for n, one in enumerate(results)]
    (report,) = bridge_reports(files, baseline)
    return report


def first_page(found: Seen) -> str:
    return found.text.partition("Evidence: all crossings")[0]


@pytest.fixture
def then(tmp_path: Path, site: Site) -> Path:
    """A baseline of 21 September 2026 whose element 4 is weak already."""
    path = tmp_path / "then.json"
    path.write_text(results_json(fused(site, KNOWN)))
    return path


def changed(site: Site, factor: float, *, entry: float = 0.0) -> Results:
    """A survey like the baseline but for element 2."""
    ratios = RATIOS.copy()
    ratios[1] *= factor
    return results_of(site, some_crossing("z", entry=entry), used="z", ratios=ratios)


def test_implausible_stiffness_takes_certainty_from_headline(site: Site) -> None:
    ratios = RATIOS.copy()
    ratios[4] = 2.21
    stiff = results_of(site, some_crossing("a"), used="a", ratios=ratios)
    found = report_on(site, stiff)
    assert found.finding.headline == (
        "One element appears less stiff. But element 5 appears stiffer than is physically "
        "plausible."
    )
    text = first_page(reported(site, stiff))
    assert (
        "Not plausible: the 95 % interval of element 5 lies entirely more than 20 % above" in text
    )
    assert "treat no value as certain, least of all those of elements 4 and 6" in text
    assert "All checks passed; they do not explain the implausible stiffness" in text
    assert "If the drawings show nothing stiffer at element 5, check mass" in text
    assert re.search(r"17\.1–21\.4 .{,60} not plausible", text)
    usual = first_page(reported(site, results_of(site, some_crossing("a"), used="a")))
    assert "One element is clearly less stiff." in usual
    assert "plausible" not in usual


def test_implausible_stiffness_alone_is_never_reassuring(site: Site) -> None:
    ratios = np.ones(7)
    ratios[6] = 1.5
    stiff = results_of(site, some_crossing("a"), used="a", ratios=ratios)
    found = report_on(site, stiff)
    assert found.finding.kind == "open"
    text = first_page(reported(site, stiff))
    assert "No element is clearly less stiff. But element 7 appears stiffer" in text
    assert "least of all those of element 6." in text
    assert "no additional inspection" not in text
    assert "If the drawings show nothing stiffer at element 7" in text
    assert "Keep these results as a baseline" not in text


def test_gain_against_a_baseline_is_implausible_without_repair(site: Site, then: Path) -> None:
    text = first_page(reported(site, changed(site, 1.5), baseline=then))
    assert "But element 2 appears stiffer than is physically plausible." in text
    assert "Without a repair no bridge becomes that much stiffer, not even by frost." in text
    assert "plausible" not in first_page(reported(site, changed(site, 1.1), baseline=then))


def test_rise_against_a_baseline_has_a_remark_and_likely_causes(site: Site, then: Path) -> None:
    text = first_page(reported(site, changed(site, 1.12), baseline=then))
    assert re.search(r"4\.3–8\.6 .{,80} possibly stiffer", text)
    assert "Stiffer than the baseline: element 2 (+12 %, 95 % interval +" in text
    assert "Unless it was repaired, the usual cause is a bearing that now restrains" in text
    clear = first_page(reported(site, changed(site, 1.22), baseline=then))
    assert "Stiffer than the baseline: element 2" in clear
    assert re.search(r"4\.3–8\.6 .{,80} stiffer", clear)
    # Without a baseline an element may simply be built so.
    alone = first_page(reported(site, changed(site, 1.12)))
    assert "Stiffer than the baseline" not in alone
    assert "possibly stiffer" not in alone


def test_finding_states_once_which_losses_would_show(site: Site, then: Path) -> None:
    text = first_page(reported(site, fused(site, [0.2, *KNOWN[1:]]), baseline=then))
    assert "No clear change; element 4 is still less stiff than the others." in text
    assert len(re.findall(r"ranges from \d+ % \(element \d\) to \d+ % \(element 1\)", text)) == 1


def test_implausible_baseline_takes_certainty_from_changes(site: Site, tmp_path: Path) -> None:
    """A survey that found element 5 twice as stiff as the others is no measure of its loss."""
    ratios = RATIOS.copy()
    ratios[4] = 2.21
    stiff = results_of(site, some_crossing("b"), used="b", ratios=ratios)
    path = tmp_path / "stiff.json"
    path.write_text(results_json(stiff))
    words = (
        "The baseline is not plausible: its 95 % interval of element 5 lies entirely more than 20"
    )
    now = results_of(site, some_crossing("z"), used="z")
    assert words in first_page(reported(site, now, baseline=path))
    assert "The baseline is not plausible" not in first_page(reported(site, now))


def test_element_unresolved_in_the_baseline_is_named(site: Site, tmp_path: Path) -> None:
    """A mean far above the present value is no loss where the baseline does not resolve it."""
    sound = without_weak(site, [0.02] * 7)
    state = sound.bridges["bridge-1"]
    mean = 5.0 * state.elements["EI_2"].mean
    vague = ElementState(mean=mean, std=0.5 * mean, q025=0.9 * mean, q975=2.5 * mean)
    state = state.model_copy(update={"EI_2": vague, "verdict": "suspect"})
    path = tmp_path / "vague.json"
    path.write_text(results_json(sound.model_copy(update={"bridges": {"bridge-1": state}})))
    text = first_page(reported(site, sound, baseline=path))
    assert "The change of element 2 could not be determined (standard deviation above" in text
    assert "Element 2 is not resolved in the baseline" in text
    assert "The baseline is a suspect measurement: do not rely on a change from it." in text
    assert "Element 2, " not in text
    assert ") not resolved in the baseline" in text  # the remark in the table


def test_interval_without_zero_is_possibly_less_stiff(site: Site, then: Path) -> None:
    """The words follow the rule: clearly is beyond 10 %, possibly beyond 0."""
    for factor, words in ((0.7, "clearly"), (0.88, "possibly"), (0.97, "neither")):
        now = changed(site, factor)
        (element,) = [
            one
            for one in report_on(site, now, baseline=then).view.comparison.elements  # type: ignore[union-attr]
            if one.number == 2
        ]
        assert (element.high < 0.9) == (words == "clearly")
        assert (element.high < 1.0) == (words != "neither")
        text = first_page(reported(site, now, baseline=then))
        assert "means that the whole 95 % interval lies more than 10 % below the baseline." in text
        assert ("One element is clearly less stiff." in text) == (words == "clearly")
        assert ("Possibly less stiff: element 2 (−12 %, 95 % in" in text) == (words == "possibly")
        assert ("At the next inspection begin with element 2" in text) == (words == "possibly")
        assert ("6 possibly less stiff" in text) is False
        assert len(re.findall("possibly less stiff", text)) == (2 if words == "possibly" else 0)


def test_element_weak_in_the_baseline_is_named(site: Site, then: Path) -> None:
    text = first_page(reported(site, changed(site, 0.7), baseline=then))
    assert re.search(
        r"Element 4 \(60 %, 95 % interval \d\d to \d\d %\) was already clearly less stiff", text
    )
    assert "If element 4 has not been inspected since the baseline, have it inspected, too." in text
    assert re.search(r"12\.9–17\.1 .{,60} less stiff before", text)
    alone = first_page(reported(site, changed(site, 0.7)))
    assert "baseline already" not in alone
    assert "less stiff before" not in alone


@pytest.mark.parametrize(
    ("language", "words", "step"),
    [
        (
            "en",
            "No clear change; element 4 is still less stiff than the others.",
            "Element 4 was weak before and shows no clear change. Carry out the inspections that",
        ),
        (
            "de",
            "Keine deutliche Änderung; Element 4 ist weiterhin weniger steif als die anderen.",
            "Element 4 war schon vorher schwach und zeigt keine deutliche Änderung. Führen Sie",
        ),
    ],
)
def test_weak_element_that_has_not_changed_leads_headline_and_advice(
    site: Site, then: Path, language: str, words: str, step: str
) -> None:
    files = [(Path("now.json"), changed(site, 1.0), site)]
    (report,) = bridge_reports(files, then, language=language_of(language))
    assert report.finding.kind == "known"
    assert report.finding.headline.startswith(words)
    first, *others = next_steps(report, language_of(language))
    assert first.startswith(step)
    assert not any("4" in other for other in others)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (0.0, None),
        (20.0 * 86400.0, None),
        (HALF_YEAR_S, "The surveys are 182 days apart, in autumn and in spring. Temp"),
        (2.0 * HALF_YEAR_S, "The surveys are 364 days apart, both in autumn. Temperatures are not"),
    ],
)
def test_seasons_of_compared_surveys_are_named(
    site: Site, then: Path, entry: float, words: str | None
) -> None:
    text = first_page(reported(site, changed(site, 0.7, entry=entry), baseline=then))
    if words is None:
        assert "days apart" not in text
    else:
        assert words in text
        assert (
            "a difference of 20 K alone changes the stiffness of concrete and asphalt by some 8 %"
            in text
        )


def test_seasons_are_those_of_the_hemisphere() -> None:
    january, july = 1.7678e9, 1.7834e9
    assert [season_of(one, 48.0) for one in (january, july)] == ["winter", "summer"]
    assert [season_of(one, -34.0) for one in (january, july)] == ["summer", "winter"]


def surveys(site: Site, pause_s: float) -> list[Results]:
    """Two good surveys by files, of a method whose crossings are fused."""
    first = fused(site, KNOWN)
    names = {"a": "x", "b": "y", "c": "z"}
    crossings = tuple(
        one.model_copy(
            update={
                "crossing_id": names[one.crossing_id],
                "entry_time": one.entry_time + pause_s,
                "exit_time": one.exit_time + pause_s,
            }
        )
        for one in first.crossings
    )
    state = first.bridges["bridge-1"].model_copy(update={"crossings_used": tuple("abcxyz")})
    second = first.model_copy(
        update={
            "crossings": crossings,
            "created": first.created + pause_s,
            "bridges": {"bridge-1": state},
        }
    )
    return [first, second]


def test_combined_surveys_are_announced_with_the_command(site: Site, then: Path) -> None:
    first, second = surveys(site, HALF_YEAR_S)
    text = first_page(reported(site, first, second))
    assert "Surveys that are 182 days apart (2026-09-21 and 2027-03-22) are combined" in text
    assert "To see the change: driveby report 1.json --baseline 0.json" in text
    together = second.model_copy(update={"crossings": first.crossings + second.crossings})
    text = first_page(reported(site, together))
    assert (
        "identify each survey into a results file of its own, then run driveby report LATER" in text
    )
    given = Path("there/site.toml")
    words = "driveby report 1.json --baseline 0.json --site site.toml"
    files = [(Path(f"{n}.json"), one, site) for n, one in enumerate((first, second))]
    assert words in " ".join(bridge_reports(files, None, given)[0].cautions)
    words = "driveby report LATER.json --baseline EARLIER.json --site site.toml."
    assert words in " ".join(bridge_reports([(Path("a"), together, site)], None, given)[0].cautions)
    assert "combined" not in first_page(reported(site, *surveys(site, 3.0 * 86400.0)))
    assert "are combined" not in first_page(reported(site, first, second, baseline=then))


@pytest.mark.parametrize(
    ("realms", "words"),
    [
        (
            ("sim-a", "import-drives"),
            "The baseline was simulated and these crossings were measured",
        ),
        (("live", "sim-a"), "These crossings were simulated and the baseline was measured"),
        (("sim-a", "sim-b"), ""),
        (("import-2025", "live"), ""),
    ],
)
def test_baseline_of_another_origin_is_the_first_caution(
    site: Site, tmp_path: Path, realms: tuple[str, str], words: str
) -> None:
    then, now = (
        results_of(site, some_crossing(name) | {"realm": realm}, used=name)
        for name, realm in zip("ab", realms, strict=True)
    )
    path = tmp_path / "then.json"
    path.write_text(results_json(then))
    cautions = report_on(site, now, baseline=path).cautions
    assert [one for one in cautions if "simulated" in one] == ([cautions[0]] if words else [])
    assert not words or cautions[0].startswith(words)


def test_comparison_of_the_same_crossings_is_announced(site: Site, tmp_path: Path) -> None:
    path = tmp_path / "same.json"
    results = results_of(site, some_crossing("a"), used="a")
    path.write_text(results_json(results))
    text = first_page(reported(site, results, baseline=path))
    assert (
        "The baseline consists of the same crossings: the measurement is compared with itself"
        in text
    )
    more = results_of(site, some_crossing("a"), some_crossing("b", entry=60.0), used="b")
    state = more.bridges["bridge-1"].model_copy(update={"crossings_used": ("a", "b")})
    more = more.model_copy(update={"bridges": {"bridge-1": state}})
    text = first_page(reported(site, more, baseline=path))
    assert "One of these crossings is in the baseline, too: a change is understated" in text
    other = results_of(site, some_crossing("b"), used="b")
    assert "crossings is" not in first_page(reported(site, other, baseline=path))


def history_of() -> BridgeHistory:
    """A history of two months, of which the second has a weaker element 4."""
    changes = (ElementChange(4, 0.72, 0.65, 0.8), ElementChange(5, 1.0, 0.9, 1.1))
    compared = PeriodComparison(BEGIN_S, BEGIN_S + 40 * 86_400.0, changes)
    watch = MonitoringState("never_checked", None)
    return BridgeHistory("bridge-1", "sim", "month", (), (), watch, compared)


@pytest.mark.parametrize("code", LANGUAGES)
def test_finding_names_the_change_over_time(site: Site, tmp_path: Path, code: str) -> None:
    language, past = language_of(code), history_of()
    found = report_on(site, results_of(site, some_crossing("a"), used="a", ratios=np.ones(7)))
    first, *_ = with_history(found, past, language).cautions
    assert language.text("caution.others", over_time="") in f"{first} "
    assert language.number(-28.0, "+.0f") in first
    assert "--baseline" in first
    path = tmp_path / "then.json"
    path.write_text(results_json(results_of(site, some_crossing("b"), used="b")))
    before = report_on(site, results_of(site, some_crossing("a"), used="a"), baseline=path)
    first, *_ = with_history(before, past, language).cautions
    assert first.startswith(language.text("caution.baseline", over_time=""))
    assert {"en": "Quote the change stated above", "de": "Geben Sie die Änderung oben an"}[
        code
    ] in first
    assert "--baseline" not in first


def test_active_alarm_takes_reassurance_from_a_report(site: Site, tmp_path: Path) -> None:
    past = history_of()._replace(alarms=(alarm(),))
    found = report_on(site, results_of(site, some_crossing("a"), used="a", ratios=np.ones(7)))
    assert found.finding.kind == "sound"
    shown = with_history(found, past, language_of("en"))
    assert shown.finding.kind == "open"
    assert "But an alarm is active: element 4 is 20 % less stiff" in shown.finding.headline
    assert shown.cautions[0].startswith("The alarm compares periods of the history.")
    first, *others = next_steps(shown, language_of("en"))
    assert first.startswith("Have element 4 inspected because of the active alarm")
    assert not any("calls for no additional inspection" in step for step in others)
    noted = alarm().model_copy(
        update={"acknowledged": Acknowledgement(by="A", time=BEGIN_S, note="")}
    )
    quiet = with_history(found, past._replace(alarms=(noted,)), language_of("en"))
    assert quiet.finding == found.finding


def with_ends(results: Results, sprung: float, giving: float) -> Results:
    content = results.model_dump(mode="json")
    for one in content["crossings"]:
        one["derived"]["probability_sprung"] = {"start": sprung, "end": 0.1}
        one["derived"]["probability_giving"] = {"start": 0.1, "end": giving}
    return Results.model_validate(content)


@pytest.mark.parametrize("code", ["en", "de"])
def test_missing_or_failed_site_validation_is_named_once(
    site: Site, tmp_path: Path, code: str
) -> None:
    words = language_of(code)
    two = [some_crossing("a"), some_crossing("b", entry=60.0)]
    found = results_of(site, *two, used="b")

    def cautions_with(results: Results) -> str:
        files = [(Path("x.json"), results, site)]
        (report,) = bridge_reports(files, None, language=words, validations=tmp_path)
        first = first_page(Seen(page([report], language=words)))
        assert all(caution in first for caution in report.cautions)
        return " ".join(report.cautions)

    untried = words.text("caution.unvalidated", trucks="truck-1", folder=tmp_path)
    assert cautions_with(found).count(untried) == 1
    failed = certificate(site, passed=False)
    save(tmp_path, failed)
    text = cautions_with(found)
    assert untried not in text
    figures = {"good": 1, "crossings": 1, "covered": 2, "intervals": 2, "least": 85.0}
    values = {"truck": "truck-1", "remedy": words.text("caution.try.tandem")} | figures
    assert text.startswith(words.text("caution.validation_failed", **values))
    named = [one | {"certificate": failed.hash} for one in two]
    assert "driveby validate" not in cautions_with(results_of(site, *named, used="b"))
    save(tmp_path, certificate(site))
    assert words.text("caution.validation_failed", **values) not in cautions_with(found)


def test_likely_restraint_is_on_the_first_page_unless_declared(site: Site) -> None:
    plain = fused(site, KNOWN)
    text = first_page(reported(site, with_ends(plain, 0.998, 0.95)))
    assert "abutment, is likely at the south-west end (probability 99 %). The" in text
    assert "loose bearing) is likely at the north-east end (probability 95 %). The" in text
    unlikely = first_page(reported(site, with_ends(plain, 0.8, 0.8)))
    assert "Rotational restraint" not in unlikely
    assert "Bearing compliance" not in unlikely
    bridge = site.bridges[0].model_copy(update={"bearings": ("sprung", "unknown")})
    declared = site.model_copy(update={"bridges": (bridge,)})
    text = first_page(reported(declared, with_ends(plain, 0.998, 0.95)))
    assert "Rotational restraint" not in text
    assert "Bearing compliance (vertical movement under the load" in text


def test_excluded_crossings_have_number_and_reason(site: Site) -> None:
    content = fused(site, KNOWN).model_dump(mode="json")
    bad = [
        some_crossing("r", verdict="rejected", reasons=("gap_on_bridge",), entry=300.0),
        some_crossing("s", verdict="suspect", reasons=("position_outage",), entry=400.0),
        some_crossing("t", verdict="suspect", reasons=("position_outage",), entry=500.0),
    ]
    content["crossings"] += results_of(site, *bad).model_dump(mode="json")["crossings"]
    content["bridges"]["bridge-1"]["crossings_left_out"] = [
        {"crossing_id": name, "reason": "suspect"} for name in "st"
    ]
    text = first_page(reported(site, Results.model_validate(content)))
    assert "6 crossings: 3 good, 2 suspect, 1 rejected. The numbers below combine 3" in text
    why = [REASON_TEXTS[code].removesuffix(".") for code in (GAP, OUTAGE)]
    assert f"Excluded: 1 rejected ({why[0]}); 2 suspect ({why[1]})." in text
    assert "Excluded" not in first_page(reported(site, fused(site, KNOWN)))


@pytest.mark.parametrize(("code", "unused"), [("en", "no"), ("de", "nein")])
def test_evidence_states_why_a_good_crossing_is_not_used(
    site: Site, code: str, unused: str
) -> None:
    left_out = [{"crossing_id": "c", "reason": "disagrees"}]
    results = fused(site, KNOWN, crossings_used=["a", "b"], crossings_left_out=left_out)
    text = reported(site, results, language=code).text
    assert f"{unused} {language_of(code).left_out['disagrees']}" in text
    assert (
        language_of(code).left_out["disagrees"]
        not in reported(site, fused(site, KNOWN), language=code).text
    )


def test_glossary_ignores_names_within_the_markup(site: Site) -> None:
    """An attribute of the sketch is `dominant-baseline`."""
    rejected = some_crossing("a", verdict="rejected", reasons=("speed_too_low",))
    words = reported(site, results_of(site, rejected)).text.rpartition(" Words ")[2]
    assert "Verdict:" in words
    assert "Baseline:" not in words


@pytest.mark.parametrize("code", LANGUAGES)
def test_figure_has_numbers_of_one_meaning(site: Site, then: Path, code: str) -> None:
    language = language_of(code)
    loss = language.text("figure.less", loss=30.0).partition(" % ")[2]
    for baseline, meaning in ((None, "ratio"), (then, "change")):
        files = [(Path("now.json"), changed(site, 0.7), site)]
        (report,) = bridge_reports(files, baseline, language=language)
        with rc_context(STYLE):
            figure = draw_bridge(report.view, with_heading=False, language=language)
        panel = figure.axes[0]
        bold = [one.get_text() for one in panel.texts if one.get_fontweight() == "bold"]
        numbers = [text for text in bold if not text.endswith(loss)]
        assert len(numbers) == 7
        assert {"%" in text for text in numbers} == {meaning == "change"}
        assert language.text(f"figure.numbers_{meaning}") in panel.get_title(loc="left")
        labels = [one.get_ylabel() for one in figure.axes]
        assert (language.text("figure.ratio") in labels) == (meaning == "ratio")


def test_bridge_parameter_far_from_the_site_file_is_named(site: Site) -> None:
    usual = results_of(site, some_crossing("a"), used="a")
    assert "The estimate of" not in first_page(reported(site, usual))
    far = with_contradictions(usual, prior_z_rhoA=25.54, f1_over_declared=1.25)
    text = first_page(reported(site, far))
    assert (
        "The estimate of the mass per length (rhoA) is 7,335 kg/m, declared 4,400 kg/m: a "
        "difference of 25.5 of the site file's standard deviations."
    ) in text
    assert "The estimate of the first frequency is 3.6 Hz, declared 2.88 Hz." in text
    assert report_on(site, far).finding == report_on(site, usual).finding
    (german,) = bridge_reports([(Path("a.json"), far, site)], None, language=language_of("de"))
    assert any(
        "die Masse pro Länge (rhoA) mit 7.335 kg/m, angegeben mit 4.400 kg/m: ein Unterschied von "
        "25,5 Standardabweichungen" in caution
        for caution in german.cautions
    )


def test_contradictions_of_several_crossings_are_one_caution() -> None:
    site = paper_site()
    far = with_contradictions(results_of(site, some_crossing("a"), some_crossing("b")))
    one, other = far.crossings
    worst = one.model_copy(update={"diagnostics": {"prior_z_rhoA": -5.0}})
    (text,) = bridge_remarks([other, worst])
    assert "is 7,335 kg/m in a crossing, declared 4,400 kg/m: a difference of 5.0 of" in text
    assert "of more than 4 in 1 of 2 crossings" in text
