"""Histories of the bridges in a report, which its findings must not contradict."""

from collections.abc import Callable, Iterable
from pathlib import Path

from services.common.language import ENGLISH, Language
from services.execution.blas import one_blas_thread
from services.history.bridge_history import (
    BridgeHistory,
    StoredBaseline,
    bridge_history,
    change_over_time,
)
from services.history.history_store import bridges_of
from services.history.periods import Unit
from services.report.alarm_words import alarm_sentence
from services.report.bridge import BridgeReport


def with_histories(
    reports: Iterable[BridgeReport],
    history: Path,
    unit: Unit,
    warn: Callable[[str], None],
    language: Language = ENGLISH,
) -> list[BridgeReport]:
    """Return the reports with the histories of their bridges, in the realm of the results.

    A finding names active alarms, and a caution the change over time. `warn` is called with bridges
    that are not in the history. InputError: there is no such folder.
    """
    known = bridges_of(history)
    found = []
    for report in reports:
        bridge, realm = report.bridge.id, report.crossings[-1].realm
        if (realm, bridge) in known:
            with one_blas_thread():
                past = bridge_history(history, realm, bridge, unit, warn)
            report = with_history(report, past, language)
        else:
            warn(f"{history}: has no bridge {bridge} in realm {realm}; the report is without it")
        found.append(report)
    return found


def with_history(report: BridgeReport, past: BridgeHistory, language: Language) -> BridgeReport:
    """Return a report with a history, whose alarms and changes its finding must not contradict."""
    before = report.before
    if before is not None:
        means = tuple(before.estimate.mean.tolist())
        past = past._replace(baseline=StoredBaseline(before.name, means))
    report = report._replace(past=past)
    finding, cautions = report.finding, list(report.cautions)
    change = change_over_time(past, language)
    if past.active_alarms:
        alarms = "; ".join(alarm_sentence(alarm, language) for alarm in past.active_alarms)
        headline = f"{finding.headline} {language.text('finding.alarm', alarms=alarms)}"
        kind = "open" if finding.kind in ("sound", "known") else finding.kind
        finding = finding._replace(kind=kind, headline=headline)
        cautions.insert(0, language.text("caution.alarm"))
    elif change is not None and report.view.comparison is not None:
        key = f"caution.{report.view.comparison.reference}"
        cautions.insert(0, language.text(key, over_time=change))
    return report._replace(finding=finding, cautions=tuple(cautions))
