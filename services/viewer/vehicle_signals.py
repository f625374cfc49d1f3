"""Measurements of trucks, as the viewer shows them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from schemas.signals import AccelBatch, GnssFix
from schemas.topics import Message
from services.finding.drive import DriveMessages, drives_of

_Identity = tuple[int, int]


class VehicleSignals(NamedTuple):
    """Messages of one truck, in the order of their sequence numbers."""

    accel: Sequence[AccelBatch]
    gnss: Sequence[GnssFix]


def signals_of(drives: Iterable[DriveMessages]) -> dict[str, VehicleSignals]:
    """Return the signals of each vehicle in order of time; a message counts once."""
    accel: dict[str, dict[_Identity, AccelBatch]] = {}
    gnss: dict[str, dict[_Identity, GnssFix]] = {}
    for drive in drives:
        boot, vehicle = drive.boot_id, drive.vehicle
        batches = {(boot, sequence): one for sequence, one in drive.accelerations.items()}
        fixes = {(boot, sequence): one for sequence, one in drive.fixes.items()}
        accel.setdefault(vehicle, {}).update(batches)
        gnss.setdefault(vehicle, {}).update(fixes)
    return {
        vehicle: VehicleSignals(
            sorted(accel[vehicle].values(), key=lambda one: one.wall_time_ns),
            sorted(gnss[vehicle].values(), key=lambda one: one.wall_time_ns),
        )
        for vehicle in sorted(accel)
        if accel[vehicle] or gnss[vehicle]
    }


def signals_of_messages(messages: Iterable[Message]) -> dict[str, VehicleSignals]:
    """Decode the sensor messages of a recording, by vehicle, in order of time."""
    return signals_of(drives_of(messages))
