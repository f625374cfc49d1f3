"""How long the gateway's work on a message of ROS 2 takes: `python -m tests.benchmarks.ros2_rate`.

Processor time of decoding an Imu, numbering it and, every hundredth time, encoding a batch; without
Zenoh, which reads in threads of its own.
"""

import time

from schemas.signals import AccelBatch, GnssFix, encode_accel
from schemas.site_file import parse_site, site_toml
from services.drives.ros2_messages import IMU
from services.drives.ros2_truck import Ros2Truck
from services.simulation.drive import paper_site
from tests import ros2

_MESSAGES = 20_000
_FIRST_NS = 1_700_000_000_000_000_000


def main() -> None:
    site = parse_site(site_toml(paper_site()) + ros2.ROS2, "site.toml")
    truck = Ros2Truck(site, "site.toml", "truck-1")
    topic = ros2.TOPICS["sprung_front"]
    stamps = [_FIRST_NS + number * 1_000_000 for number in range(_MESSAGES)]
    payloads = [ros2.imu(stamp_ns, 1.0) for stamp_ns in stamps]
    truck.convert(topic, IMU, payloads[0], stamps[0])  # rosbags makes its decoders
    begun = time.process_time()
    batches = 0
    for stamp_ns, payload in zip(stamps[1:], payloads[1:], strict=True):
        for item in truck.convert(topic, IMU, payload, stamp_ns):
            assert not isinstance(item, GnssFix)
            encode_accel(AccelBatch(1, batches, *item))
            batches += 1
    each_us = (time.process_time() - begun) / _MESSAGES * 1e6
    size = len(payloads[0])
    print(f"{each_us:.1f} µs a message of {size} bytes, {batches} batches of {_MESSAGES} messages")


if __name__ == "__main__":
    main()
