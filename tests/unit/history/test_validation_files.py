"""Sentences on results that no passed site validation covers."""

from pathlib import Path
from typing import Any

import pytest

from schemas.site import Site
from schemas.validation_records import VehicleBridgePair
from services.common.language import ENGLISH, Language, language_of
from services.history.validation_files import (
    ValidatedPairs,
    pairs_without_validation,
    records_of,
    save,
    validation_notes,
    validations_passed,
)
from tests.builders.certificates import certificate, tried
from tests.unit.viewer.found import results_of, some_crossing

PAIR = VehicleBridgePair("truck-1", "bridge-1")


def notes_of(
    folder: Path, site: Site, pairs: list[VehicleBridgePair], language: Language = ENGLISH
) -> list[str]:
    return list(validation_notes(folder, site, records_of(folder, site, pairs), language))


def passed_of(
    folder: Path, site: Site, pairs: list[VehicleBridgePair], language: Language = ENGLISH
) -> list[str]:
    return list(validations_passed(records_of(folder, site, pairs), language))


def untried(folder: Path) -> str:
    return (
        f"The folder {folder} has no site validation of truck-1 on this bridge: whether the "
        "intervals contain the truth has not been tested. Run driveby validate --site SITE.toml, "
        "or name the right folder (--validations)."
    )


def test_pairs_are_those_of_intervals_without_a_record(site: Site) -> None:
    some = [some_crossing(name) for name in "ab"]
    assert pairs_without_validation(results_of(site, *some).crossings) == [PAIR]
    named = some_crossing("c") | {"certificate": "0" * 16}
    rejected = some_crossing("d", verdict="rejected", reasons=("speed_too_low",))
    other = some_crossing("e") | {"method": "least_squares"}
    assert pairs_without_validation(results_of(site, named, rejected, other).crossings) == []


def test_untried_pairs_share_a_sentence(site: Site, tmp_path: Path) -> None:
    none = tmp_path / "none"
    assert list(notes_of(none, site, [PAIR])) == [untried(none)]
    assert list(notes_of(tmp_path, site, [])) == []
    both = [PAIR, VehicleBridgePair("truck-2", "bridge-1")]  # the second is not of the site
    (line,) = notes_of(tmp_path, site, both)
    assert "of truck-1 and truck-2 on this bridge" in line


def test_relative_folder_is_named_as_a_whole(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It depends on the working folder; a report, which is passed on, names it as given."""
    monkeypatch.chdir(tmp_path)
    folder = Path("recordings/certificates")
    pairs = ValidatedPairs(results_of(site, some_crossing("a")).crossings)
    assert list(pairs.notes(folder, site, "bridge-1")) == [untried(tmp_path / folder)]
    assert list(notes_of(folder, site, [PAIR])) == [untried(folder)]


def test_record_of_the_pair_decides(site: Site, tmp_path: Path) -> None:
    figures = certificate(site).figures
    failed = figures.model_copy(
        update={"crossings": 12, "good": 12, "intervals": 60, "covered": 49}
    )
    save(tmp_path, certificate(site, passed=False, figures=failed.model_dump()))
    (line,) = notes_of(tmp_path, site, [PAIR])
    assert line == (
        "Site validation of truck-1 on this bridge FAILED: 12 of 12 simulated crossings were good, "
        "and 49 of 60 intervals contained the truth (at least 85 % must). Do not rely on the "
        "intervals: check the site file, try fewer elements or a truck with equal single tyres or "
        "an equalised tandem, and validate again."
    )
    (german,) = notes_of(tmp_path, site, [PAIR], language_of("de"))
    assert "NICHT bestanden: 12 von 12 simulierten Überfahrten" in german
    save(tmp_path, certificate(site))
    assert list(notes_of(tmp_path, site, [PAIR])) == []


def test_failed_record_names_the_usual_reasons_in_words(site: Site, tmp_path: Path) -> None:
    """The third reason is the rarest; reasons of good crossings do not exist."""
    none: dict[str, Any] = dict.fromkeys(("ei_ratio_q025", "ei_ratio_q50", "ei_ratio_q975"), ())
    codes = (("model_misfit",), ("not_converged",), ("not_converged", "model_misfit"), ("failed",))
    crossings = [tried(4), tried(5, verdict="suspect", reasons=("not_converged",))]
    crossings += [tried(n, verdict="rejected", reasons=why, **none) for n, why in enumerate(codes)]
    save(tmp_path, certificate(site, passed=False, crossings=crossings))
    (line,) = notes_of(tmp_path, site, [PAIR])
    assert line.endswith(
        "and validate again. Most frequent reasons of crossings that were not good: The search did "
        "not converge (3); The model does not explain the measured accelerations (2)."
    )
    (german,) = notes_of(tmp_path, site, [PAIR], language_of("de"))
    assert german.endswith(
        "die nicht gut waren: Die Suche ist nicht konvergiert (3); Das Modell erklärt die "
        "gemessenen Beschleunigungen nicht (2)."
    )


def test_passed_record_states_the_fewest_intervals_that_pass(site: Site, tmp_path: Path) -> None:
    figures = certificate(site).figures.model_copy(update={"intervals": 55, "covered": 48})
    save(tmp_path, certificate(site, figures=figures.model_dump()))
    (line,) = passed_of(tmp_path, site, [PAIR])
    assert line == (
        "Site validation of truck-1: passed; 48 of 55 intervals of simulated crossings contained "
        "the truth (at least 47 must)."
    )
    (german,) = passed_of(tmp_path, site, [PAIR], language_of("de"))
    assert "48 von 55 Intervallen" in german
    assert "(mindestens 47 müssen es)" in german
    other = VehicleBridgePair("truck-2", "bridge-1")
    assert list(passed_of(tmp_path, site, [other])) == []


def test_record_of_another_truck_counts_for_nothing(site: Site, tmp_path: Path) -> None:
    save(tmp_path, certificate(site))
    heavier = site.vehicles[0].model_copy(update={"total_mass_kg": 9999.0})
    changed = site.model_copy(update={"vehicles": (heavier,)})
    (line,) = notes_of(tmp_path, changed, [PAIR])
    assert line == (
        f"{untried(tmp_path)} It has a record of truck-1 on this bridge for other values of truck, "
        "bridge, sensors or receiver, or another method version."
    )


def test_unreadable_record_is_a_warning(
    site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    save(tmp_path, certificate(site)).write_text("{")
    assert list(notes_of(tmp_path, site, [PAIR])) == [untried(tmp_path)]
    assert len(caplog.records) == 1
