"""Batches joined into series: every sample at its own time, whatever the sizes of batches are."""

import numpy as np

from schemas.signals import AccelBatch, AccelChannel
from services.drives.signals import series_of_batches

START_NS = 1_790_000_000_000_000_000


def batch(sequence: int, start_ns: int, **channels: tuple[float, int]) -> AccelBatch:
    made = {
        name: AccelChannel(rate_hz, sequence + np.arange(size, dtype=np.float64) / 1000.0)
        for name, (rate_hz, size) in channels.items()
    }
    return AccelBatch(1, sequence, start_ns - START_NS, start_ns, made)


def test_each_sample_has_its_batch_s_time_and_its_place_in_it() -> None:
    batches = [
        batch(1, START_NS, sprung_front=(1000.0, 50), sprung_rear=(300.0, 15)),
        batch(2, START_NS + 50_000_000, sprung_front=(1000.0, 50)),
        batch(3, START_NS + 100_000_007, sprung_front=(1000.0, 7), sprung_rear=(300.0, 15)),
        batch(4, START_NS + 200_000_000, sprung_front=(500.0, 50)),
    ]
    found = series_of_batches(batches)
    assert list(found) == ["sprung_front", "sprung_rear"]
    for name, series in found.items():
        times, values = [], []
        for one in batches:
            if name in one.channels:
                rate_hz, samples = one.channels[name]
                times += [one.wall_time_ns + round(k * 1e9 / rate_hz) for k in range(samples.size)]
                values += samples.tolist()
        assert series.time_ns.tolist() == times
        assert series.acceleration_m_per_s2.tolist() == values
