"""Short text and HTML tables of results, as a notebook shows the last value of a cell."""

from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from typing import Final

from schemas.reasons import Reason
from schemas.results import CrossingResult, ElementState, Parameter
from schemas.site import Bridge
from services.identification.bridge_remarks import bridge_remarks

MAX_SHOWN: Final = 20
"""Largest number of crossings that a notebook shows."""
RIGIDITY_HEAD: Final = ("EI (GN·m²)", "95 % interval", "EI/nominal")
_GIGA: Final = 1e9


def one_line(crossing: CrossingResult, bridge: Bridge) -> str:
    """Return crossing, verdict, reasons and EI over nominal of a result."""
    parts = [f"{crossing.crossing_id}: {crossing.verdict}"]
    if crossing.reasons:
        parts.append(f"({', '.join(crossing.reasons)})")
    elements = [ratio for _, _, ratio in _elements(crossing, bridge)]
    if elements:
        parts.append(f"EI / nominal {' '.join(f'{ratio:.3f}' for ratio in elements)}")
    return " ".join(parts)


def counted(crossings: Sequence[CrossingResult]) -> str:
    """Return the numbers of crossings, verdicts and bridges."""
    verdicts = Counter(crossing.verdict for crossing in crossings)
    bridges = sorted({crossing.bridge for crossing in crossings})
    of = f" of {', '.join(bridges[:3])}{', …' if len(bridges) > 3 else ''}" if bridges else ""
    judged = ", ".join(f"{number} {verdict}" for verdict, number in sorted(verdicts.items()))
    noun = "crossing" if len(crossings) == 1 else "crossings"
    return f"{len(crossings)} {noun}{of}" + (f": {judged}" if judged else "")


def as_html(crossing: CrossingResult, bridge: Bridge) -> str:
    """Return the verdict with its reasons, remarks on the bridge, and a table of the elements."""
    heading = (
        f"<p><b>{escape(crossing.crossing_id)}</b>: {crossing.verdict}, "
        f"{escape(crossing.vehicle)} over {escape(crossing.bridge)}, "
        f"{crossing.speed_m_per_s:.1f} m/s, method {crossing.method}</p>"
    )
    parts = [heading]
    if crossing.reasons:
        pairs = zip(crossing.reasons, crossing.reason_texts, strict=True)
        parts.append(_list(f"{escape(code)}: {escape(text)}" for code, text in pairs))
    remarks = tuple(bridge_remarks([crossing]))
    if remarks:
        parts.append(_list(map(escape, remarks)))
    rows = []
    start_m = 0.0
    has_interval = Reason.NO_NOISE_MODEL not in crossing.reasons
    for length_m, (name, found, ratio) in zip(
        bridge.lengths_m, _elements(crossing, bridge), strict=False
    ):
        place = f"{start_m:.1f} to {start_m + length_m:.1f}"
        rows.append((name, place, *rigidity_cells(found, found.mean / ratio, has_interval)))
        start_m += length_m
    if rows:
        parts.append(html_table(("element", "m", *RIGIDITY_HEAD), rows))
    return "".join(parts)


def all_as_html(crossings: Sequence[tuple[CrossingResult, Bridge]]) -> str:
    """Return the first crossings, and how many there are."""
    shown = "".join(as_html(*one) for one in crossings[:MAX_SHOWN])
    rest = len(crossings) - MAX_SHOWN
    more = f"<p>{rest} more crossings: .elements() has all</p>" if rest > 0 else ""
    return f"<p>{escape(counted([crossing for crossing, _ in crossings]))}</p>{shown}{more}"


def _elements(crossing: CrossingResult, bridge: Bridge) -> list[tuple[str, Parameter, float]]:
    known = crossing.parameters or {}
    nominal = bridge.nominal_flexural_rigidity_nm2
    return [
        (name, known[name], known[name].mean / nominal_ei)
        for number, nominal_ei in enumerate(nominal, start=1)
        if (name := f"EI_{number}") in known
    ]


def rigidity_cells(
    found: Parameter | ElementState, nominal: float, has_interval: bool = True
) -> tuple[str, str, str]:
    """Return EI, its interval and its ratio to nominal, with the digits of the terminal."""
    interval = f"{found.q025 / _GIGA:.2f} to {found.q975 / _GIGA:.2f}" if has_interval else "–"
    return f"{found.mean / _GIGA:.2f}", interval, f"{found.mean / nominal:.3f}"


def html_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table of texts, escaped."""
    heading = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f"<table><thead><tr>{heading}</tr></thead><tbody>{body}</tbody></table>"


def _list(items: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{item}</li>' for item in items)}</ul>"
