"""What a ROS 2 truck publishes where there is no router, and what no message can hold."""

from pathlib import Path

import zenoh

from schemas.events import Event, EventKind
from schemas.signals import GnssFix
from schemas.site_file import parse_site, site_toml, vehicle_toml
from services.common.errors import FailureError
from services.drives.ros2_anomalies import UNPUBLISHED
from services.drives.ros2_truck import Ros2Truck
from services.simulation.drive import paper_site
from services.truck.gateway import Gateway
from services.truck.ros2 import _InfoFirstPublisher
from services.truck.spool import Spool
from tests import ros2

FIX = GnssFix(0, 0, 10**9, 1_700_000_000_000_000_000, 50.0, 8.0, 100.0, 10.0)


def nobody() -> zenoh.Session:
    raise FailureError("no router answers")


def test_time_that_no_message_holds_is_counted_and_the_next_fix_goes_out(tmp_path: Path) -> None:
    site = parse_site(site_toml(paper_site()) + ros2.ROS2, "site.toml")
    truck = Ros2Truck(site, "site.toml", "truck-1")
    gateway = Gateway(nobody, "sim-ros", "truck-1", Spool(tmp_path))
    out = _InfoFirstPublisher(gateway, vehicle_toml(site, "truck-1"), truck)
    out.put(FIX._replace(device_time_ns=1 << 64))
    out.put(FIX)
    out.put(FIX._replace(device_time_ns=1 << 64))
    gateway.close()
    assert truck.anomalies.count(ros2.FIX_TOPIC, UNPUBLISHED) == 2
    assert out.sent == 3  # what the truck is, and the fix in its two forms


def test_event_without_a_router_waits_for_nobody(tmp_path: Path) -> None:
    gateway = Gateway(nobody, "sim-ros", "truck-1", Spool(tmp_path))
    assert not gateway.event(Event(EventKind.REFUSED, 1))
    gateway.close()
