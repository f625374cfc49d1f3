"""What trucks measured, as the viewer shows it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from schemas.signals import AccelBatch, GnssFix, decode_accel, decode_gnss
from services.recordings.recording import Message


class VehicleSignals(NamedTuple):
    """What one truck recorded, in the order of its sequence numbers."""

    accel: Sequence[AccelBatch]
    gnss: Sequence[GnssFix]


def signals_of_messages(messages: Iterable[Message]) -> dict[str, VehicleSignals]:
    """Decode the sensor messages of a recording, by vehicle, in the order of time.

    Repeated messages are taken once, those that cannot be decoded are left out.
    """
    accel: dict[str, dict[tuple[int, int], AccelBatch]] = {}
    gnss: dict[str, dict[tuple[int, int], GnssFix]] = {}
    for message in messages:
        vehicle, identity = message.key.identifier, (message.boot_id, message.sequence)
        try:
            if message.key.stream == "accel":
                accel.setdefault(vehicle, {})[identity] = decode_accel(message.payload)
            elif message.key.stream == "gnss":
                gnss.setdefault(vehicle, {})[identity] = decode_gnss(message.payload)
        except ValueError:
            continue  # a picture shows what can be read; the logger has counted what cannot
    return {
        vehicle: VehicleSignals(
            sorted(accel.get(vehicle, {}).values(), key=lambda batch: batch.wall_time_ns),
            sorted(gnss.get(vehicle, {}).values(), key=lambda fix: fix.wall_time_ns),
        )
        for vehicle in sorted(accel.keys() | gnss.keys())
    }
