"""A drive of which everything is known."""

from collections.abc import Iterator

import numpy as np

from schemas.signals import AccelBatch, AccelChannel, GnssFix, encode_accel, encode_gnss
from schemas.topics import Key, Message

S = 1_000_000_000
START_NS = 1_700_000_000 * S


def drive(
    vehicle: str = "truck-1", *, leave_out: range = range(0), boot_id: int = 7, begin_s: float = 0.0
) -> Iterator[Message]:
    """10 s at 20 batches and 10 fixes a second; some of the batches are not there."""
    for number in range(200):
        time_ns = START_NS + round(begin_s * S) + number * 50_000_000
        where = Key("live", "vehicle", vehicle, "accel")
        if number not in leave_out:
            channel = AccelChannel(1000.0, np.zeros(50))
            batch = AccelBatch(
                boot_id, number, number * 50_000_000, time_ns, {"sprung_front": channel}
            )
            yield Message(where, encode_accel(batch), boot_id, number, time_ns, time_ns)
        if number % 2 == 0:
            fix = GnssFix(boot_id, number // 2, number * 50_000_000, time_ns, 50.0, 8.0, 0.0, 10.0)
            where = where._replace(stream="gnss")
            yield Message(where, encode_gnss(fix), boot_id, number // 2, time_ns, time_ns)
