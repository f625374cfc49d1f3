"""What trucks measured, as the viewer shows it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from schemas.signals import AccelBatch, GnssFix, decode_accel, decode_gnss
from services.recordings.recording import Message

_Identity = tuple[int, int]


class VehicleSignals(NamedTuple):
    """What one truck recorded, in the order of its sequence numbers."""

    accel: Sequence[AccelBatch]
    gnss: Sequence[GnssFix]


class Heard:
    """What has come of trucks so far: a message that comes again is taken once."""

    def __init__(self) -> None:
        self._accel: dict[str, dict[_Identity, AccelBatch]] = {}
        self._gnss: dict[str, dict[_Identity, GnssFix]] = {}

    def add(self, message: Message) -> bool:
        """Take a message; what is of no sensor, or cannot be decoded, is left out: False."""
        vehicle, identity = message.key.identifier, (message.boot_id, message.sequence)
        try:
            if message.key.stream == "accel":
                self._accel.setdefault(vehicle, {})[identity] = decode_accel(message.payload)
            elif message.key.stream == "gnss":
                self._gnss.setdefault(vehicle, {})[identity] = decode_gnss(message.payload)
            else:
                return False
        except ValueError:
            return False  # a picture shows what can be read; the logger has counted what cannot
        return True

    def signals(self) -> dict[str, VehicleSignals]:
        """By vehicle, in the order of time."""
        return {
            vehicle: VehicleSignals(
                sorted(self._accel.get(vehicle, {}).values(), key=lambda one: one.wall_time_ns),
                sorted(self._gnss.get(vehicle, {}).values(), key=lambda one: one.wall_time_ns),
            )
            for vehicle in sorted(self._accel.keys() | self._gnss.keys())
        }


def signals_of_messages(messages: Iterable[Message]) -> dict[str, VehicleSignals]:
    """Decode the sensor messages of a recording, by vehicle, in the order of time."""
    heard = Heard()
    for message in messages:
        heard.add(message)
    return heard.signals()
