"""Checks before a survey: of the site file, and of a truck's recordings."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.diagnostics.noise_floor import NoiseSegment
from pre_core.physics.simulate import Motion
from schemas.site import Site, Vehicle
from schemas.site_file import parse_site, read_site_text
from schemas.site_frequency import given_frequencies
from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.progress import Offset, no_progress
from services.finding.placed import densities_ug_per_rthz, middle_of
from services.finding.streams import Samples
from services.inspection.channels import (
    agreement,
    check_assignment,
    check_presence,
    check_signals,
    gaps,
    masses,
    rates,
    tandem_in_place,
    wheelbase,
)
from services.inspection.finding import CheckFinding, CheckStatus
from services.inspection.noise import noise_of
from services.inspection.place import bridge_findings
from services.inspection.receiver import clocks, longest_standstill, receiver_of
from services.inspection.recorded import InspectedRun, recorded_runs
from services.inspection.site import finding_of_implied, findings_of_site
from services.recordings.recording import read_info

_SHORTEST_STANDSTILL_S: Final = 10.0
_SHORTEST_DRIVE_S: Final = 6.0
_DRIVE_S: Final = 12.0
"""Duration in s over which signals are judged, that of a crossing, as for the thresholds."""
_DRIVING_M_PER_S: Final = 3.0
_SLOW: Final = 0.9
_DECAY_S: Final = 1.0
"""Time in s for which a body swings on its springs after a stop."""


class SiteText(NamedTuple):
    """The text of a site file, and its name for messages."""

    toml: str
    name: str


class CheckReport(NamedTuple):
    """Findings on one source: a site file, or a run of a recording."""

    source: str
    findings: tuple[CheckFinding, ...]
    is_run: bool = True

    @property
    def is_wrong(self) -> bool:
        """Whether any finding is wrong."""
        return any(_is_wrong(finding) for finding in self.findings)


def inspect(
    paths: Sequence[Path], next_file: Callable[[], Offset] = lambda: no_progress
) -> Iterator[CheckReport]:
    """Check a site file and recordings; InputError for an unreadable one, or without a site.

    A finding that the site files of several recordings share is in the first report alone.
    `next_file` is called before each recording and returns its callback for progress.
    """
    sites = [path for path in paths if path.suffix == ".toml"]
    recordings = [path for path in paths if path.suffix != ".toml"]
    if len(sites) > 1:
        raise InputError(f"{sites[1]}: is a second site file; give one site file, then recordings")
    given = _text_of(sites[0]) if sites else None
    if given is not None:
        yield _of_site(given)
    reported: set[CheckFinding] = set()
    for path in recordings:
        beside = site_text_beside(path) if given is None else given
        if given is None:
            of_site = _of_site(beside)
            new = tuple(one for one in of_site.findings if one not in reported)
            reported.update(new)
            if new:
                yield of_site._replace(findings=new)
        site, name = parse_site(*beside), beside.name
        for number, run in enumerate(recorded_runs(path, site, name, next_file())):
            yield CheckReport(
                f"{path}, run {number + 1} of {run.vehicle}", tuple(findings_of_run(run, site))
            )


def site_text_beside(path: Path) -> SiteText:
    """Return the site file of a recording or folder as text; InputError without one."""
    if path.is_dir():
        site_path = path / "site.toml"
        if not site_path.is_file():
            raise InputError(f"{path}: holds no site.toml; give a site file before the folder")
        return _text_of(site_path)
    text = read_info(path, lambda message: None).site_toml
    if text is None:
        raise InputError(f"{path}: holds no site file; give one before the recording")
    return SiteText(text, f"{path}: site.toml")


def _text_of(path: Path) -> SiteText:
    return SiteText(read_site_text(path), str(path))


def _of_site(text: SiteText) -> CheckReport:
    site = parse_site(*text)
    found = [finding for vehicle in site.vehicles for finding in findings_of_site(site, vehicle)]
    found += map(finding_of_implied, given_frequencies(text.toml))
    return CheckReport(text.name, tuple(dict.fromkeys(found)), is_run=False)


def findings_of_run(run: InspectedRun, site: Site) -> Iterator[CheckFinding]:
    """Yield all findings on one run."""
    known = {vehicle.id: vehicle for vehicle in site.vehicles}
    if run.vehicle not in known:
        yield CheckFinding(
            "vehicle",
            CheckStatus.WRONG,
            f"{run.vehicle} is not in the site file",
            f"the site file has {', '.join(known)}; use one name for the truck",
        )
        return
    vehicle = known[run.vehicle]
    yield from check_presence(run, vehicle)
    run = run.of_channels(vehicle.channels)
    if run.samples is not None and run.samples.channels:
        yield from rates(run, site.sensor, vehicle)
        yield gaps(run)
        yield from _of_signals(run, site, vehicle, run.samples)
    yield from receiver_of(run, site.receiver)
    yield from clocks(run)
    if run.fixes.time_s.size > 1:
        for bridge in site.bridges:
            yield from bridge_findings(run, bridge, vehicle, site.receiver)
    if run.is_cut:
        yield CheckFinding(
            "length", CheckStatus.OPEN, "only accelerations of the first half hour were checked", ""
        )


def _of_signals(
    run: InspectedRun, site: Site, vehicle: Vehicle, samples: Samples
) -> Iterator[CheckFinding]:
    stood, drove = _standstill(run, samples), _drive(run, samples)
    names = tuple(name for name in vehicle.channels if name in samples.channels)
    part = np.stack([samples.channels[name][drove or stood or slice(0, None)] for name in names])
    part = part[:, np.isfinite(part).all(axis=0)]
    broken: set[str] = set()
    if part.shape[1] > 2:
        for finding in check_signals(names, part, 1.0 / samples.rate_hz):
            if finding.name == "channels_alike":
                broken |= set(names)
            elif _is_wrong(finding):
                broken |= {name for name in names if finding.text.startswith(f"{name}:")}
            yield finding
    declared = densities_ug_per_rthz(site.sensor, vehicle)
    for name in names:
        if name in broken:
            continue
        quiet = samples.channels[name][stood or drove or slice(0, None)]
        # Interpolation removes the band in which the noise is measured.
        is_slow = run.rates_hz.get(name, samples.rate_hz) < _SLOW * samples.rate_hz
        still = NoiseSegment(quiet, samples.rate_hz, stood is not None)
        yield noise_of(name, None if is_slow else still, declared[name])
    if len(names) < len(vehicle.channels) or broken:
        return
    if vehicle.sensors and drove is not None:
        agreed = agreement(vehicle, site.sensor, part, 1.0 / samples.rate_hz)
        yield agreed
        if _is_wrong(agreed):
            return
    if drove is None:
        yield CheckFinding(
            "channels_in_place",
            CheckStatus.OPEN,
            "order and signs of the channels were not checked, as no "
            f"{_SHORTEST_DRIVE_S:g} s of driving are without gaps",
            f"check again with {_SHORTEST_DRIVE_S:g} s of driving",
        )
    else:
        yield from _of_motion(run, vehicle, samples, drove, middle_of(vehicle, part))


def _is_wrong(finding: CheckFinding) -> bool:
    return finding.state is CheckStatus.WRONG


def _of_motion(
    run: InspectedRun, vehicle: Vehicle, samples: Samples, drove: slice, part: Floats
) -> Iterator[CheckFinding]:
    """Yield findings of a drive without gaps on order, signs, wheelbase and masses."""
    step_s = 1.0 / samples.rate_hz
    time_s = samples.start_s + step_s * np.arange(drove.start, drove.stop)
    speed = np.interp(time_s, run.fixes.time_s, run.fixes.speed_m_per_s)
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * step_s * (speed[1:] + speed[:-1]))])
    motion = Motion(travelled, speed, np.gradient(speed, step_s))
    if vehicle.tandem is not None:
        yield tandem_in_place(vehicle, part, step_s, motion)
        return
    place = check_assignment(vehicle, part, step_s, motion)
    yield place
    if place.state is CheckStatus.OK:
        yield wheelbase(vehicle, part, step_s, travelled)
        yield from masses(vehicle, part, step_s)


def _standstill(run: InspectedRun, samples: Samples) -> slice | None:
    """Return the samples of the longest standstill."""
    if run.fixes.time_s.size < 2:
        return None
    stood = longest_standstill(run)
    if stood is None or stood[1] - stood[0] < _SHORTEST_STANDSTILL_S:
        return None
    return _between(samples, stood[0] + _DECAY_S, stood[1] - _DECAY_S)


def _drive(run: InspectedRun, samples: Samples) -> slice | None:
    """Return the samples of the steadiest segment that is as long as a crossing."""
    time_s, speed = run.fixes.time_s, run.fixes.speed_m_per_s
    holes = _holes(samples)
    best: tuple[float, slice] | None = None
    for begin_s in time_s.tolist():
        inside = (time_s >= begin_s) & (time_s <= begin_s + _DRIVE_S)
        if inside.sum() < 3 or speed[inside].min() < _DRIVING_M_PER_S:
            continue
        end_s = float(time_s[inside][-1])
        part = _between(samples, begin_s, end_s)
        if part.stop - part.start < _SHORTEST_DRIVE_S * samples.rate_hz:
            continue
        if np.any((holes >= part.start) & (holes < part.stop)):
            continue
        change = float(np.ptp(speed[inside]) / speed[inside].mean()) - (end_s - begin_s) / _DRIVE_S
        if best is None or change < best[0]:
            best = (change, part)
    return None if best is None else best[1]


def _holes(samples: Samples) -> NDArray[np.int64]:
    values = np.stack(list(samples.channels.values()))
    return np.flatnonzero(~np.isfinite(values).all(axis=0))


def _between(samples: Samples, begin_s: float, end_s: float) -> slice:
    count = max(values.size for values in samples.channels.values())
    first = round((begin_s - samples.start_s) * samples.rate_hz)
    last = round((end_s - samples.start_s) * samples.rate_hz)
    first = min(max(first, 0), count)
    return slice(first, min(max(last, first), count))
