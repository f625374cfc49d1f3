"""The verdict of a crossing: reasons, result and a table of all parameters."""

from __future__ import annotations

from typing import Final

import rerun.blueprint as rrb

from services.common.language import ENGLISH
from services.identification.comparison import Comparison
from services.viewer.crossing_scene import CrossingScene, Panel
from services.viewer.crossing_view import CrossingView, describe_crossing, summary_line
from services.viewer.rerun_parts import RerunStream, log_markdown


def _layout(scene: CrossingScene, _: CrossingView) -> rrb.View:
    return rrb.TextDocumentView(origin=f"{scene.root}/verdict", name="Verdict")


def _log(recording: RerunStream, scene: CrossingScene, crossing: CrossingView) -> None:
    text = verdict_markdown(crossing, scene.compared)
    log_markdown(recording, f"{scene.root}/verdict", text)


PANEL: Final = Panel(lambda scene: scene.crossing, _layout, _log)


def _advice(crossing: CrossingView) -> list[str]:
    """Return what to do about each reason, as Markdown."""
    advice = dict.fromkeys(ENGLISH.remedy(code, crossing.method) for code in crossing.reasons)
    return ["", "**What to do next**", "", *(f"- {one}" for one in advice)] if advice else []


def verdict_markdown(crossing: CrossingView, compared: Comparison | None = None) -> str:
    """Return verdict, reasons, result, advice and a table of all parameters, as Markdown."""
    lines = [f"# {crossing.verdict.capitalize()}", ""]
    if crossing.verdict == "suspect":
        lines += ["**Doubtful. Do not rely on these values.**", ""]
    lines += [summary_line(crossing), ""]
    lines += [f"- {text}" for text in crossing.reason_texts]
    if crossing.rigidity_nm2 is None:
        nothing = "No estimate is given for a rejected crossing."
        return "\n".join([*lines, "", nothing, *_advice(crossing)])
    wording = describe_crossing(crossing, compared)
    if wording:
        lines += ["", " ".join(wording)]
    lines += _advice(crossing)
    lines += ["", "| | estimate | 95 % interval | ratio |", "|---|---|---|---|"]
    for index, value in enumerate(crossing.rigidity_nm2):
        interval = "–"
        if crossing.interval_nm2 is not None and crossing.interval_has_meaning:
            low, high = crossing.interval_nm2[index] / 1e9
            interval = f"{low:.3g} … {high:.3g}"
        ratio = value / crossing.nominal_nm2[index]
        lines.append(f"| EI_{index + 1} | {value / 1e9:.4g} GN·m² | {interval} | {ratio:.3f} |")
    others = [row for row in crossing.parameters if not row.name.startswith("EI_")]
    for row in others:
        interval = f"{row.low:.4g} … {row.high:.4g}" if crossing.interval_has_meaning else "–"
        lines.append(f"| {row.name} | {row.mean:.4g} {row.unit} | {interval} | |")
    return "\n".join(lines)
