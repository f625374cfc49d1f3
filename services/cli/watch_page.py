"""The page of `driveby watch`: the state of a realm in tables of given width and height."""

from collections.abc import Iterable, Sequence, Set
from datetime import UTC, datetime
from typing import Final, Protocol

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from schemas.alarms import Alarm
from schemas.topics import HEALTH_PERIOD_S, is_from_recording
from services.bus.realm_listener import other_realms_hint
from services.cli.realm_model import (
    SILENT_S,
    BridgeRow,
    CrossingRow,
    RealmModel,
    TruckRow,
    alarm_state,
    route_text,
    service_figures,
)
from services.common.crossing_states import ON_BRIDGE
from services.common.naming import count_of

_BLOCKS: Final = "▁▂▃▄▅▆▇█"
_STEP: Final = 0.2
"""Step of a bar in EI over nominal: all values within a tenth of 1 have equal height."""
_WIDE: Final = 110
"""Columns from which intervals and reasons fit next to each other."""
_AHEAD_S: Final = 0.5
"""Time in s by which samples lie in the future when a clock is wrong."""
_BEHIND_S: Final = 2.0
"""Steady age in s at arrival from which a clock is wrong: no network takes so long."""
_OLD_S: Final = 60.0
"""Age in s at arrival from which samples are old."""
_LATE_S: Final = 1.5 * HEALTH_PERIOD_S
"""Silence in s after which a service may have been killed: its progress is no longer shown."""
_GONE_S: Final = 3.0
"""Absence in s after which a service is silent; one whose router restarts connects again sooner."""
_ANSWER_S: Final = 2.0
"""Time in s in which a worker answers a new listener."""
NO_WORKER: Final = "no worker answers"
_MAX_ALARMS: Final = 4
"""Maximum number of alarm lines at the head of a page, fewer on a low one."""
_MAX_BRIDGES: Final = 4
_LINES_OF_BRIDGE: Final = 4
"""Usual lines of a bridge: its finding is two or three sentences."""
NO_ALARM: Final = (
    "No alarm was received; it is not known here whether driveby alarm serve monitors any bridge."
)
_WAITS: Final = "waits for samples"
"""State of a crossing whose truck sends nothing before the crossing is decided."""
_VERDICTS: Final = {"good": "green", "suspect": "yellow", "rejected": "red"}


class ListenerView(Protocol):
    """The shown part of a `RealmListener`."""

    realm: str

    @property
    def alive(self) -> set[str]: ...  # noqa: D102
    @property
    def elsewhere(self) -> dict[str, set[str]]: ...  # noqa: D102
    @property
    def lost_s(self) -> float | None: ...  # noqa: D102
    @property
    def gone_s(self) -> dict[str, float]: ...  # noqa: D102


def page(
    model: RealmModel,
    where: str,
    listening: ListenerView,
    *,
    now_s: float,
    now_ns: int,
    width: int,
    height: int,
) -> RenderableType:
    """Return the page; without room it has the newest crossings and first trucks."""
    is_wide = width >= _WIDE
    trucks, rows = _sorted_trucks(model, now_s), model.rows()
    alarms = _alarms(model.alarms.values(), max(1, min(_MAX_ALARMS, height // 10)))
    taken = (
        11
        + len(model.services)
        + _LINES_OF_BRIDGE * min(len(model.bridges), _MAX_BRIDGES)
        + len(alarms)
    )
    taken += (bool(model.bridges) and not alarms) + (listening.lost_s is not None)
    room = max(7 - len(alarms), height - taken)
    most_trucks = max(2, min(len(trucks), room // 3))
    silent = silent_services(model, listening, now_s, now_ns)
    is_worked = listening.lost_s is not None or has_worker(model, silent, now_s)
    parts: list[RenderableType] = [_headline(model, where, now_ns, is_worked=is_worked)]
    if listening.lost_s is not None:
        lost = f"connection to the router lost {_length(now_s - listening.lost_s)} ago"
        parts.append(Text(lost, style="bold red", no_wrap=True, overflow="ellipsis"))
    parts += alarms
    hint = other_realms_hint(listening.realm, listening.elsewhere)
    if not trucks and not rows:
        parts.append(Text(hint or "No trucks yet.", style="yellow" if hint else "dim"))
    if trucks:
        parts.append(_trucks(trucks[:most_trucks], listening, now_s))
        parts += _wrong_time_notes(trucks, listening.realm)
        if len(trucks) > most_trucks:
            more = count_of(len(trucks) - most_trucks, "more truck")
            parts.append(Text(f"  and {more}", style="dim"))
    if rows:
        shown = rows[: max(3, room - most_trucks)]
        parts.append(_crossings(shown, _held(model, now_s), is_wide=is_wide))
        if len(rows) > len(shown):
            more = count_of(len(rows) - len(shown), "earlier crossing")
            parts.append(Text(f"  and {more}", style="dim"))
    if model.bridges and not alarms:
        parts.append(Text(NO_ALARM, style="dim", no_wrap=True, overflow="ellipsis"))
    if model.bridges:
        active = {name for name, one in model.alarms.items() if one.acknowledged is None}
        parts.append(_bridges(model.bridges, active))
    if model.services:
        parts.append(_services(model, silent, now_ns, is_connected=listening.lost_s is None))
    spaced = [
        one for part in parts for one in ([Text()] if isinstance(part, Table) else []) + [part]
    ]
    return Group(*spaced)


def bars(ratios: Sequence[float], weak: frozenset[int], *, doubtful: bool = False) -> Text:
    """Return a bar for each element, as high as its relative EI; weak ones stand out."""
    text = Text()
    for number, ratio in enumerate(ratios, start=1):
        level = min(max(round(ratio / _STEP), 0), len(_BLOCKS) - 1)
        colour = "bright_black" if doubtful else "bold yellow" if number in weak else "cyan"
        text.append(_BLOCKS[level], style=colour)
    return text


def silent_trucks(model: RealmModel, now_s: float) -> frozenset[str]:
    """Return the trucks that have been silent for a while."""
    return frozenset(n for n, truck in model.trucks.items() if now_s - truck.received_s > SILENT_S)


def silent_services(
    model: RealmModel, listening: ListenerView, now_s: float, now_ns: int
) -> frozenset[str]:
    """Return the services that have left without an end in order, or whose health is overdue.

    Without a connection nothing is known of them: none is silent.
    """
    if listening.lost_s is not None:
        return frozenset()
    gone = {name for name, since_s in listening.gone_s.items() if now_s - since_s > _GONE_S}
    return frozenset(
        name
        for name, one in model.services.items()
        if not one.ended and (name in gone or (now_ns - one.time_ns) * 1e-9 > _LATE_S)
    )


def has_worker(model: RealmModel, silent: Set[str], now_s: float) -> bool:
    """Return whether a worker answers, or may not have had the time to."""
    return now_s - model.began_s < _ANSWER_S or any(
        one.is_worker and not one.ended and name not in silent
        for name, one in model.services.items()
    )


def _sorted_trucks(model: RealmModel, now_s: float) -> list[tuple[str, TruckRow]]:
    """Return the trucks, driving ones first."""
    silent = silent_trucks(model, now_s)
    return sorted(model.trucks.items(), key=lambda item: (item[0] in silent, item[0]))


def _headline(model: RealmModel, where: str, now_ns: int, *, is_worked: bool) -> Text:
    over = [row for row in model.crossings.values() if row.is_over]
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append("driveby watch", style="bold")
    text.append(f"  {where}  {_clock(now_ns)} UTC  ")
    counts = f"{len(over)} done, {model.waiting} waiting"
    if is_worked:
        return text.append(counts, style="dim")
    text.append(NO_WORKER, style="yellow")
    return text.append(f"; {counts}" if model.crossings else "", style="dim")


def _trucks(trucks: Sequence[tuple[str, TruckRow]], listening: ListenerView, now_s: float) -> Table:
    table = _table("truck", "", "accelerometers", "batches/s", "fixes/s", "m/s", "lag")
    for name, truck in trucks:
        silent_s = now_s - truck.received_s
        batches, fixes = truck.rates(now_s)
        state = Text("drives", style="green")
        if silent_s > SILENT_S:
            is_known_there = name in listening.alive or listening.lost_s is not None
            there = "" if is_known_there else ", left"
            state = Text(f"silent {_length(silent_s)}{there}", style="dim")
        hertz = "/".join(f"{rate:g}" for rate in sorted(set(truck.channels.values())))
        speed = "" if truck.speed_m_per_s is None else f"{truck.speed_m_per_s:.1f}"
        lag = (
            Text("replay", style="dim") if is_from_recording(listening.realm) else _lag(truck.lag_s)
        )
        table.add_row(
            name,
            state,
            f"{len(truck.channels)} × {hertz} Hz" if truck.channels else "none",
            f"{batches:.0f}",
            f"{fixes:.0f}",
            speed,
            lag,
        )
    return table


def _lag(seconds: float) -> Text:
    if seconds < -_AHEAD_S:
        return Text(f"{_length(-seconds)} ahead", style="yellow")
    return Text(_length(max(seconds, 0.0)), style="yellow" if seconds > _OLD_S else "")


def _wrong_time_notes(trucks: Sequence[tuple[str, TruckRow]], realm: str) -> list[Text]:
    """Return lines on why samples are old or in the future at their arrival, if they are."""
    if is_from_recording(realm):
        return []
    old = [name for name, truck in trucks if truck.lag_s > _OLD_S]
    behind = [
        f"{name} by {_length(lag_s)}"
        for name, truck in trucks
        if name not in old and (lag_s := truck.steady_lag_s or 0.0) > _BEHIND_S
    ]
    ahead = [name for name, truck in trucks if truck.lag_s < -_AHEAD_S]
    why = "samples are old on arrival: replayed faster than real time, sent late, or a clock is "
    notes = [
        (old, f"{why}wrong"),
        (
            behind,
            "all samples are equally old: the truck's clock is behind, or this machine's is ahead",
        ),
        (ahead, "samples are dated ahead: the clock of the truck or of this machine is wrong"),
    ]
    return [
        Text(
            f"  {', '.join(names[:3])}: {text}",
            style="yellow",
            no_wrap=True,
            overflow="ellipsis",
        )
        for names, text in notes
        if names
    ]


def _held(model: RealmModel, now_s: float) -> frozenset[str]:
    """Return the crossings whose truck sends no samples; none where its samples are not seen."""
    if not model.sees_trucks:
        return frozenset()
    driving = model.trucks.keys() - silent_trucks(model, now_s)
    return frozenset(
        name
        for name, row in model.crossings.items()
        if row.state == ON_BRIDGE and row.vehicle not in driving
    )


def _crossings(rows: Sequence[CrossingRow], held: Set[str], *, is_wide: bool) -> Table:
    names = ("entry", "crossing", "", "EI", "lowest EI/nominal (95 %)")
    table = _table(*names, *(["why"] if is_wide else []))
    for row in rows:
        words = _WAITS if row.crossing_id in held else row.state
        state = Text(words, style=_VERDICTS.get(row.state, ""))
        if row.fraction is not None and not row.is_over:
            state.append(f" {100.0 * row.fraction:.0f} %")
        why = Text(row.reason, style="dim")
        lowest = Text("")
        if row.lowest is not None:
            lowest.append(f"{row.lowest.name} {row.lowest.ratio:.2f}")
            if row.lowest.low is not None:
                lowest.append(f" ({row.lowest.low:.2f}–{row.lowest.high:.2f})")
            if row.state != "good":
                lowest.stylize("bright_black")
        elif not is_wide:
            lowest = why
        heights = bars(row.ratios, row.weak, doubtful=row.state != "good")
        cells: list[RenderableType] = [
            _clock(row.entry_ns),
            route_text(row),
            state,
            heights,
            lowest,
        ]
        table.add_row(*cells, *([why] if is_wide else []))
    return table


def _bridges(bridges: dict[str, BridgeRow], active: Set[str]) -> Table:
    """Return the bridges: with an active alarm first, then by the latest message."""
    table = _table("bridge", "crossings", "EI", "all crossings fused")
    alarmed = [name for name in bridges if name in active][-_MAX_BRIDGES:]
    quiet = [name for name in bridges if name not in active]
    for name in (*alarmed, *quiet[max(0, len(quiet) + len(alarmed) - _MAX_BRIDGES) :]):
        row = bridges[name]
        wording = row.finding or row.lowest
        is_good = row.verdict in ("", "good")
        found = Text(wording if is_good else f"{row.verdict}: {wording}", overflow="fold")
        found.no_wrap = False
        heights = bars(row.ratios, row.weak, doubtful=not is_good)
        head = Text(name, style="bold red" if name in active else "")
        table.add_row(head, f"{row.used}", heights, found)
    return table


def _alarms(alarms: Iterable[Alarm], most: int) -> list[Text]:
    """Return a line for each alarm, active ones first, for readers of the first lines."""
    known = sorted(alarms, key=lambda one: (one.acknowledged is not None, -one.raised, one.bridge))
    lines = [
        Text(
            f"alarm of {one.bridge}, {alarm_state(one)}: {one.sentence()}",
            style="bold red" if one.acknowledged is None else "dim",
            no_wrap=True,
            overflow="ellipsis",
        )
        for one in known[:most]
    ]
    if len(known) > most:
        active = sum(one.acknowledged is None for one in known[most:])
        more = f"  and {count_of(len(known) - most, 'more alarm')}, {active} active"
        lines.append(Text(more, style="red" if active else "dim"))
    return lines


def _services(model: RealmModel, silent: Set[str], now_ns: int, *, is_connected: bool) -> Table:
    table = _table("service", "", "")
    for name, service in sorted(model.services.items()):
        age_s = (now_ns - service.time_ns) * 1e-9
        state = Text("well", style="green")
        if service.ended:
            how = "dim" if service.ok else "red"
            state = Text(f"ended {_length(age_s)} ago", style=how)
        elif name in silent:
            state = Text(f"silent {_length(age_s)}", style="red")
        elif not is_connected:
            state = Text(f"unknown for {_length(age_s)}", style="dim")
        elif not service.ok:
            state = Text("not well", style="red")
        work = "" if name in silent or not is_connected else model.work.get(name, "")
        is_plain = service.ended and service.ok
        is_counting = name not in silent and is_connected and not service.ended
        figures = service_figures(service, age_s if is_counting else None)
        notes = ["" if is_plain else figures, work]
        table.add_row(name, state, "; ".join(one for one in notes if one))
    return table


def _table(*names: str) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim", expand=True, pad_edge=False)
    for number, name in enumerate(names):
        is_last = number == len(names) - 1
        table.add_column(
            name, no_wrap=True, overflow="ellipsis", ratio=1 if is_last else None,
        )  # fmt: skip
    return table


def _clock(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns * 1e-9, UTC):%H:%M:%S}"


def _length(seconds: float) -> str:
    if abs(seconds) < 10.0:
        return f"{seconds:.1f} s"
    if abs(seconds) < 600.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if abs(seconds) < 36_000.0 else f"{seconds / 3600.0:.0f} h"
