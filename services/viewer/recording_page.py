"""The contents of a recording before any identification: a page, and its crossings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from schemas.results import CrossingResult
from schemas.site import Site
from services.catalogue.contents import RecordingSummary, TruckSummary
from services.common.language import utc_second
from services.common.naming import count_of
from services.finding.bridges import DetectedCrossing
from services.finding.placed import sensors_in_words
from services.finding.stays import MERGE_S, Passage
from services.viewer.crossing_view import DetectedCrossingView

MAX_SHOWN = 12
"""Maximum number of crossings with a tab of their own, the newest ones."""
_MAX_GAPS = 8
_S = 1e-9


def detected_views(
    found: RecordingSummary, identified: Iterable[CrossingResult] = ()
) -> list[DetectedCrossingView]:
    """Return the newest crossings that were detected and not identified, in order of time."""
    if found.site is None:
        return []
    done = [(c.vehicle, c.bridge, c.entry_time) for c in identified]
    wheelbase = {vehicle.id: vehicle.length_m for vehicle in found.site.vehicles}
    views = []
    for one in found.passings:
        entry, leave = one.entry_ns * _S, one.exit_ns * _S
        known = any(
            vehicle == one.vehicle and bridge == one.bridge and abs(entry - time) < MERGE_S
            for vehicle, bridge, time in done
        )
        if known or one.passage is not Passage.THROUGH or leave <= entry:
            continue
        span = found.site.bridge(one.bridge).span_m
        speed = (span + wheelbase[one.vehicle]) / (leave - entry)
        views.append(
            DetectedCrossingView(one.vehicle, one.bridge, one.forward, entry, leave, speed, span)
        )
    return views[-MAX_SHOWN:]


def recording_page(found: RecordingSummary) -> str:
    """Return trucks, bridges, crossings and gaps of a recording, as Markdown."""
    seconds = (found.last_ns - found.first_ns) * _S
    lines = [f"# {found.path.name}", ""]
    lines += [f"{_moment(found.first_ns)} UTC, {_length(seconds)}{_state(found)}.", ""]
    for truck in found.trucks:
        lines.append(f"- {_truck(truck)}")
        lines += [f"  - {line}" for line in _sensors(truck, found.site)]
        if truck.sample_gaps.number:
            lines.append(
                f"  - gaps in the samples: {truck.sample_gaps.number}, the longest "
                f"{truck.sample_gaps.longest_s:.3g} s"
            )
    if found.site is None:
        lines.append(f"- {found.site_error or 'No site file in it: its bridges are not known.'}")
    else:
        lines += [
            f"- Bridge **{bridge.owner_id or bridge.id}**: {bridge.span_m:g} m, "
            f"{bridge.elements} elements"
            for bridge in found.site.bridges
        ]
        lines += ["", *_crossings(found.passings)]
    if found.gaps:
        lines += ["", f"**Gaps: {len(found.gaps)}**", ""]
        lines += [
            f"- {_moment(gap.begin_ns)} {gap.vehicle} {gap.stream}: nothing for "
            f"{(gap.end_ns - gap.begin_ns) * _S:.1f} s"
            for gap in found.gaps[:_MAX_GAPS]
        ]
        if len(found.gaps) > _MAX_GAPS:
            lines.append(f"- and {count_of(len(found.gaps) - _MAX_GAPS, 'more gap')}")
    lines += ["", f"Measurements only; to interpret them: `driveby identify {found.path.name}`."]
    return "\n".join(lines)


def _crossings(passings: Sequence[DetectedCrossing]) -> Iterator[str]:
    yield (
        f"**Crossings detected: {len(passings)}**" if passings else "No crossing of a known bridge."
    )
    yield ""
    for one in passings[-MAX_SHOWN:]:
        way = "→" if one.forward else "←"
        through = one.passage is Passage.THROUGH
        how = f"{(one.exit_ns - one.entry_ns) * _S:.1f} s on it" if through else one.passage.value
        yield f"- {_moment(one.entry_ns)} {one.vehicle} {way} {one.bridge}, {how}"
    if len(passings) > MAX_SHOWN:
        yield f"- and {count_of(len(passings) - MAX_SHOWN, 'earlier crossing')}"


def _truck(truck: TruckSummary) -> str:
    rates = truck.channel_rates_hz
    hertz = ", ".join(f"{rate:g} Hz" for rate in sorted(set(rates.values())))
    channels = f"{len(rates)} accelerometers at {hertz}" if rates else "no accelerometers"
    missing = sum(stream.missing for stream in truck.streams.values())
    lost = f", **{missing} messages missing**" if missing else ""
    return f"Truck **{truck.vehicle}** ({truck.realm}): {channels}{lost}"


def _sensors(truck: TruckSummary, site: Site | None) -> list[str]:
    """Return the positions of the sensors of a truck that names its own."""
    if site is None:
        return []
    known = (vehicle for vehicle in site.vehicles if vehicle.id == truck.vehicle)
    return [line for vehicle in known for line in sensors_in_words(site.sensor, vehicle)]


def _state(found: RecordingSummary) -> str:
    cut = ", **being written or cut off**" if found.info.truncated else ""
    damaged = found.info.damaged_chunks
    return f"{cut}, **{count_of(damaged, 'damaged place')}**" if damaged else cut


def _moment(time_ns: int) -> str:
    return utc_second(time_ns * _S)


def _length(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60.0)
    return f"{minutes:.0f} min {rest:.0f} s" if minutes else f"{rest:.1f} s"
