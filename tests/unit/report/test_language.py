"""Languages of the report: complete, with the same values, and nothing left in English."""

import re
import string
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from pre_core.search.loop import Termination
from schemas.reasons import LEFT_OUT_TEXTS, REASON_TEXTS, BridgeReason, Reason, texts
from schemas.results import results_json
from schemas.site import Site
from services.common.language import ENGLISH, LANGUAGES, Language, language_of
from services.history.bridge_history import bridge_history
from services.history.history_store import add_results
from services.identification.fit_reasons import (
    FAR_FROM_MEASUREMENT,
    _place_of_misfit,
    contradicted_frequency,
    words_of_ending,
)
from services.identification.paper_method import FAR_FROM_SITE
from services.report.alarm_words import alarm_sentence
from services.report.bridge import bridge_reports
from services.report.history_section import history_section
from services.report.page import page
from services.viewer.bridge_figure import draw_bridge
from services.viewer.bridge_view import view_of_bridge
from services.viewer.crossings_figure import draw_crossings
from services.viewer.drawing import STYLE, figure_bytes
from services.viewer.history_figure import draw_history, history_view
from tests.unit.history.test_bridge_history import alarm
from tests.unit.history.test_history_store import crossings
from tests.unit.report.test_report import KNOWN, Seen, fused, reported
from tests.unit.viewer.found import RATIOS, results_of, some_crossing

GERMAN = language_of("de")
OTHERS = [language_of(code) for code in LANGUAGES if code != "en"]


def fields(sentence: str) -> set[str]:
    """Return the names of the values in a sentence."""
    return {name for _, name, _, _ in string.Formatter().parse(sentence) if name}


@pytest.mark.parametrize("language", OTHERS, ids=lambda language: language.code)
def test_each_language_has_every_sentence_with_its_values(language: Language) -> None:
    assert set(language.sentences) == set(ENGLISH.sentences)
    for key, sentence in language.sentences.items():
        assert sentence.strip(), key
        assert fields(sentence) == fields(ENGLISH.sentences[key]), key
    assert set(language.reasons) == set(Reason)
    assert set(language.bridge_reasons) == set(BridgeReason)
    assert set(language.left_out) == set(LEFT_OUT_TEXTS)
    assert len(language.glossary) == len(ENGLISH.glossary)
    for sentences in (language.reasons, language.bridge_reasons, language.left_out):
        assert all(text.strip() for text in sentences.values())


NAMED = {
    "axle": ("Achs", "achs"),
    "clock": ("Uhr",),
    "receiver": ("Empfänger",),
    "span": ("Stützweite",),
    "traffic": ("Verkehr",),
    "wheelbase": ("Radstand",),
}
"""Things to check that the remedy of a reason names in each language."""


@pytest.mark.parametrize("code", Reason)
def test_german_remedy_names_what_the_english_one_names(code: Reason) -> None:
    for english, words in NAMED.items():
        is_named = english in ENGLISH.advice[code]
        german = GERMAN.advice[code]
        assert any(word in german for word in words) == is_named, f"{english}: {german}"


@pytest.mark.parametrize(("language", "cause"), [(ENGLISH, "receiver"), (GERMAN, "Empfänger")])
def test_remedy_of_a_failed_search_names_receiver_errors(language: Language, cause: str) -> None:
    """Least squares have no model of them; pre has one."""
    for method in ("least_squares", "random_walk"):
        remedy = language.remedy(Reason.NOT_CONVERGED, method)
        assert -1 < remedy.lower().find(cause.lower()) < remedy.find(" pre")
    of_pre = language.remedy(Reason.NOT_CONVERGED, "pre")
    assert of_pre == language.advice[Reason.NOT_CONVERGED]
    assert cause.lower() not in of_pre.lower()
    assert " pre" not in of_pre


def test_other_remedies_do_not_depend_on_the_method() -> None:
    assert ENGLISH.remedy("tandem", "least_squares") == ENGLISH.advice["tandem"]


def test_numbers_are_written_as_in_the_language() -> None:
    assert GERMAN.number(-1234.5, ",.1f") == "−1.234,5"
    assert ENGLISH.number(-1234.5, ",.1f") == "−1,234.5"
    assert GERMAN.text("level", mean=0.97, std=10.0).startswith(
        "Die Steifigkeit der ganzen Brücke beträgt das 0,97"
    )


def test_details_of_a_reason_are_kept_in_another_language() -> None:
    plain = REASON_TEXTS[Reason.CHANNEL_SWAPPED].removesuffix(".")
    stored = f"{plain}: sprung_front and sprung_rear."
    assert ENGLISH.reason("channel_swapped", stored) == stored
    expected = "Zwei Kanäle scheinen vertauscht zu sein: sprung_front und sprung_rear."
    assert GERMAN.reason("channel_swapped", stored) == expected
    older = "Two channels seem to be exchanged: sprung_front and sprung_rear."
    assert GERMAN.reason("channel_swapped", older) == expected
    assert GERMAN.reason("channel_swapped", "<b>") == "Zwei Kanäle scheinen vertauscht zu sein."


def test_german_names_the_ending_of_a_search_in_german() -> None:
    endings = [words_of_ending(one) for one in (Termination.STEPS_EXHAUSTED, Termination.STUCK)]
    for ending in (*endings, FAR_FROM_MEASUREMENT, FAR_FROM_SITE):
        (stored,) = texts([Reason.NOT_CONVERGED], {Reason.NOT_CONVERGED: ending})
        assert stored == f"The search did not converge: {ending}."
        german = GERMAN.reason("not_converged", stored)
        assert german.startswith("Die Suche ist nicht konvergiert: ")
        assert not re.search(r"\b(it|the|fit|values|no)\b", german), german


def test_german_misfit_names_place_and_frequency_in_german() -> None:
    for off_bridge_chi2 in (1.0, 12.0):
        details = "; ".join(
            (_place_of_misfit(off_bridge_chi2), contradicted_frequency(5.1, declared_hz=3.3))
        )
        (stored,) = texts([Reason.MODEL_MISFIT], {Reason.MODEL_MISFIT: details})
        german = GERMAN.reason("model_misfit", stored)
        assert (
            "Hz, angegeben sind 3.3 Hz, daher kann die Suche bei falschen Werten der Brücke"
            in german
        )
        assert not re.search(r"\b(the|and|bridge|likely|search|declared)\b", german), german


def test_english_alarms_in_a_report_are_those_of_the_alarm() -> None:
    for direction in ("weaker", "stiffer"):
        one = alarm().model_copy(update={"direction": direction})
        assert alarm_sentence(one, ENGLISH) == one.sentence()


@pytest.mark.usefixtures("drawn")
def test_a_german_report_has_no_english_sentence(site: Site, tmp_path: Path) -> None:
    then = tmp_path / "then.json"
    then.write_text(results_json(results_of(site, some_crossing("a"), used="a")))
    weak = results_of(site, some_crossing("a"), some_crossing("b", entry=60.0), used="b")
    suspect = some_crossing("a", verdict="suspect", reasons=("position_outage",))
    rejected = some_crossing("a", verdict="rejected", reasons=("speed_too_low",))
    sound = results_of(site, some_crossing("a"), used="a", ratios=np.ones(7))
    open_one = fused(site, [0.6] * 7, left_out=("disagrees",))
    either = fused(site, [0.6, 0.4, 0.3, 0.05, 0.1, 0.1, 0.5])
    disagreeing = fused(site, KNOWN, verdict="suspect", reasons=["crossings_disagree"])
    changed = results_of(site, some_crossing("b"), used="b", ratios=0.7 * RATIOS)
    texts = [
        reported(site, results_of(site, suspect, used="a"), language="de").text,
        *(reported(site, one, language="de").text for one in (weak, sound, open_one, either)),
        reported(site, results_of(site, rejected), language="de").text,
        reported(site, disagreeing, language="de").text,
        reported(site, changed, baseline=then, language="de").text,
    ]
    english = [
        *ENGLISH.sentences.values(),
        *ENGLISH.advice.values(),
        *REASON_TEXTS.values(),
    ]
    german = set(GERMAN.sentences.values())
    parts = [
        part.strip()
        for sentence in english
        if sentence not in german
        for part, *_ in string.Formatter().parse(sentence)
        if len(part.strip()) > 9
    ]
    for text in texts:
        assert [part for part in parts if part in text] == []
    assert "Ein Element ist deutlich weniger steif." in texts[1]
    assert "Element 4 (12,9 bis 17,1 m) ist 60 % weniger steif als die anderen" in texts[1]
    assert "Noch kein verlässliches Ergebnis." not in texts[1]


def test_history_of_a_german_report_is_german(tmp_path: Path) -> None:
    add_results(tmp_path, crossings(34))
    past = bridge_history(tmp_path, "sim-fleet", "bridge-1", "month", print)
    text = Seen(history_section(past, "h-", GERMAN)).text
    assert "Nicht überwacht: driveby alarm check wurde" in text
    assert " 2026-03 bis 2026-04 " in text
    for english in ("monitored", "crossings", " to ", "over time"):
        assert english not in text
    noted = history_view(past._replace(alarms=(alarm(),)))
    axes = draw_history(noted, language=GERMAN).axes
    axes[-1].figure.canvas.draw()
    assert "März" in " ".join(label.get_text() for label in axes[-1].get_xticklabels())
    assert next(text.get_text() for text in axes[3].texts) == "weniger steif"


@pytest.mark.usefixtures("drawn")
def test_axes_of_german_figures_have_a_decimal_comma(site: Site, tmp_path: Path) -> None:
    found = results_of(site, some_crossing("a"), some_crossing("b", entry=60.0), used="b")
    view = view_of_bridge(site.bridges[0], found, None)
    add_results(tmp_path, crossings(34))
    past = history_view(bridge_history(tmp_path, "sim-fleet", "bridge-1", "month", print))
    warm = [p._replace(temperature_deg_c=7.0 + 0.7 * n) for n, p in enumerate(past.points)]
    with matplotlib.rc_context(STYLE):
        figures = [
            draw_bridge(view, with_heading=False, language=GERMAN),
            draw_crossings(list(enumerate(view.crossings, start=1)), GERMAN),
            draw_history(past._replace(points=tuple(warm)), with_heading=False, language=GERMAN),
        ]
    for figure in figures:
        # Text is drawn as paths, with the words in comments.
        svg = figure_bytes(figure, "svg").decode()
        texts = re.findall("<!-- (.*?) -->", svg)
        assert [text for text in texts if re.search(r"\d\.\d", text)] == []
        assert any(re.search(r"\d,\d", text) for text in texts)


def test_the_page_names_its_language(site: Site) -> None:
    found = results_of(site, some_crossing("a"), used="a")
    reports = bridge_reports([(Path("x.json"), found, site)], None, language=GERMAN)
    text = page(reports, language=GERMAN)
    assert '<html lang="de">' in text
    assert 'content: "Seite " counter(page) " von " counter(pages) ""' in text
