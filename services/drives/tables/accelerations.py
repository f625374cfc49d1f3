"""Accelerations of tables in m/s², with axes and gravity as the site file declares them."""

from collections.abc import Mapping

import numpy as np

from schemas.signals import CHANNELS, MAX_ACCELERATION_M_PER_S2
from services.common.arrays import Floats
from services.common.errors import InputError
from services.drives.tables import evidence
from services.drives.tables.evidence import Gravity
from services.drives.tables.findings import Findings, Target
from services.drives.tables.mapping import ColumnMap
from services.drives.tables.parts import TablePart
from services.drives.tables.units import ACCELERATION, G, unit_of


def scaled(
    channels: Mapping[str, Floats],
    rate_hz: float,
    owner: Mapping[str, TablePart],
    target: Target,
    found: Findings,
) -> dict[str, Floats] | None:
    """Return accelerations in m/s²; None for a draft whose unit is undetermined."""
    units: dict[str, str] = {}
    heads: dict[str, str] = {}
    for name in channels:
        part = owner[name]
        declared_as = part.given.columns.get(name, ColumnMap()).unit
        head = unit_of(part.placed[name].unit or "")
        if declared_as is not None:
            units[name] = declared_as
        elif head in ACCELERATION:
            units[name] = head
            if head != "m/s2":
                heads[name] = head
    for head in dict.fromkeys(heads.values()):
        names = [name for name, one in heads.items() if one == head]
        found.guess(owner[names[0]], f"in {head} by the header: {', '.join(names)}")
    rest = {name: values for name, values in channels.items() if name not in units}
    if rest:
        unit = _undeclared_unit(rest, rate_hz, owner, target, found)
        if unit is None:
            return None
        units |= dict.fromkeys(rest, unit)
    for name, unit_name in units.items():
        if unit_name not in ACCELERATION:
            raise InputError(
                f"{owner[name].sheet.path}: {name} of the map is in {unit_name}, it must be "
                f"one of {', '.join(ACCELERATION)}"
            )
        found.column(owner[name], name, unit=unit_name)
    scaled_to = {name: values * ACCELERATION[units[name]] for name, values in channels.items()}
    for name, values in scaled_to.items():
        if np.abs(values).max() > MAX_ACCELERATION_M_PER_S2:
            raise InputError(
                f"{owner[name].sheet.path}: {name} reaches {np.abs(values).max():.3g} m/s², at "
                f"most {MAX_ACCELERATION_M_PER_S2:g} is expected; give its unit in a map (--map)"
            )
    return scaled_to


def _undeclared_unit(
    channels: Mapping[str, Floats],
    rate_hz: float,
    owner: Mapping[str, TablePart],
    target: Target,
    found: Findings,
) -> str | None:
    """Return the unit of channels that neither map nor header declares.

    If it is undetermined, None for a draft, with what to fill in; otherwise raise InputError.
    """
    ratio = evidence.noise_ratio(channels, rate_hz, target.site, target.vehicle)
    unit = evidence.unit_by_numbers(channels, ratio)
    first = owner[next(iter(channels))]
    if unit is None:
        is_counted = evidence.is_counted(channels)
        is_open = (
            is_counted
            or evidence.is_beyond(channels, ratio)
            or all(owner[name].placed[name].why != "exact" for name in channels)
        )
        if not is_open:
            return "m/s2"
        if not target.is_draft:
            where = str(first.sheet.path)
            raise (
                evidence.refuse_counts(where) if is_counted else evidence.refuse_unit(where, ratio)
            )
        why = evidence.COUNTED if is_counted else evidence.no_unit(ratio)
        what = "factor and unit" if is_counted else "unit"
        found.guess(first, f"{why}: shown as in the file, give {what} of each in a map", "open")
        return None
    if unit.unit != "m/s2":
        found.guess(first, f"accelerations are in {unit.unit}; {unit.why}")
    return unit.unit


def as_declared(
    channels: Mapping[str, Floats], owner: Mapping[str, TablePart], target: Target, found: Findings
) -> dict[str, Floats]:
    """Return accelerations with gravity and axes as the site file declares them."""
    sensor = target.site.sensor
    is_placed = bool(target.vehicle.sensors)
    signs = {} if is_placed else dict(zip(CHANNELS, sensor.up, strict=True))
    site = {n: Gravity(sensor.gravity_included, signs.get(n, 1)) for n in channels}
    declared_as = {}
    for name in channels:
        one = owner[name].given.columns.get(name, ColumnMap())
        declared_as[name] = Gravity(
            site[name].is_included if one.gravity_included is None else one.gravity_included,
            site[name].up if one.up is None else one.up,
        )
    where = str(next(iter(owner.values())).sheet.path)
    seen = evidence.gravity_of(channels, declared_as, where)
    for name, gravity in seen.items():
        part = owner[name]
        one = part.given.columns.get(name, ColumnMap())
        if gravity != declared_as[name] and (
            one.gravity_included is not None or one.up is not None
        ):
            raise InputError(
                f"{part.sheet.path}: {name} of the map is declared to "
                f"{'have' if declared_as[name].is_included else 'be without'} gravity, but its "
                f"mean is {float(np.mean(channels[name])):.3g} m/s²; correct gravity_included or up"
            )
        found.column(part, name, gravity_included=gravity.is_included, up=gravity.up)
    for gravity in dict.fromkeys(seen.values()):
        names = [name for name in channels if seen[name] == gravity != declared_as[name]]
        if names:
            text = f"{_described(gravity)} {', '.join(names)}, contrary to [sensor]"
            found.guess(owner[names[0]], text)
    declared = {}
    for name, values in channels.items():
        own, wanted = seen[name], site[name]
        if own == wanted:
            declared[name] = values
            continue
        upward = own.up * values - (G if own.is_included else 0.0)
        declared[name] = wanted.up * (upward + (G if wanted.is_included else 0.0))
    return declared


def _described(gravity: Gravity) -> str:
    if not gravity.is_included:
        return "without gravity:"
    return "with gravity:" if gravity.up > 0 else "with gravity, and pointing down:"
