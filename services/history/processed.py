"""Whether every crossing in a recording has been identified: only then may it be deleted.

    python -m services.history.processed REC.mcap OTHER.mcap…

exits with 0 if so, 1 if not or if it cannot be known. Which crossings there are follows from the
recording's own positions and site file, which were identified from the state `done` that the worker
publishes, in this recording or in others. A process of its own, because it reads whole files.
"""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.signals import decode_gnss
from schemas.site import Site, parse_site
from services.common.errors import InputError
from services.common.geodesy import bridge_frame, to_chainage
from services.identification.stays import MERGE_S, find_stays
from services.recordings.recording import read_identities, read_messages, read_site

_Fix = tuple[float, float, float, float]


class _Done(NamedTuple):
    realm: str
    vehicle: str
    bridge: str
    entry_s: float
    exit_s: float


def is_processed(recording: Path, others: Iterable[Path]) -> bool:
    """Whether every stay on a bridge in a recording has been identified.

    False too where it cannot be known: no site file in the recording, a truck that it does not
    name, a file that cannot be read.
    """
    try:
        site_toml = read_site(recording)
        if site_toml is None:
            return False
        site = parse_site(site_toml, str(recording))
        done = [d for path in (recording, *others) for d in _done(path)]
        return all(
            _is_known(site, realm, vehicle, fixes, done)
            for (realm, vehicle, _), fixes in _fixes(recording).items()
        )
    except InputError:
        return False


def _fixes(recording: Path) -> dict[tuple[str, str, int], list[_Fix]]:
    found: dict[tuple[str, str, int], dict[int, _Fix]] = {}
    for message in read_messages(recording):
        where = message.key
        if where.owner != "vehicle":
            continue
        name = (where.realm, where.identifier, message.boot_id)
        boot = found.setdefault(name, {})  # a truck without positions was on no known bridge
        if where.stream == "gnss":
            try:
                fix = decode_gnss(message.payload)
            except ValueError:
                continue
            boot[message.sequence] = (
                fix.wall_time_ns * 1e-9,
                fix.latitude_deg,
                fix.longitude_deg,
                fix.speed_m_per_s,
            )
    return {name: [boot[n] for n in sorted(boot)] for name, boot in found.items()}


def _is_known(site: Site, realm: str, vehicle: str, fixes: list[_Fix], done: list[_Done]) -> bool:
    truck = {v.id: v for v in site.vehicles}.get(vehicle)
    if truck is None or not fixes:
        return False
    time_s, latitude_deg, longitude_deg, speed_m_per_s = np.array(fixes).T
    for bridge in site.bridges:
        chainage_m, lateral_m = to_chainage(bridge_frame(bridge), latitude_deg, longitude_deg)
        stays = find_stays(
            time_s,
            chainage_m,
            lateral_m,
            speed_m_per_s,
            span_m=bridge.span_m,
            wheelbase_m=truck.wheelbase_m,
            antenna_to_front_axle_m=truck.gps_antenna_to_front_axle_m,
        )
        for stay in stays:
            if not any(
                (d.realm, d.vehicle, d.bridge) == (realm, vehicle, bridge.id)
                and d.entry_s - MERGE_S <= stay.exit_s
                and stay.entry_s <= d.exit_s + MERGE_S
                for d in done
            ):
                return False
    return True


def _done(path: Path) -> list[_Done]:
    streams = {(where.owner, where.stream) for where, _ in read_identities(path)}
    if ("bridge", "crossing") not in streams:
        return []
    found = []
    for message in read_messages(path):
        if message.key.owner != "bridge" or message.key.stream != "crossing":
            continue
        try:
            crossing = decode("driveby.v1.Crossing", message.payload)
        except ValueError:
            continue
        if isinstance(crossing, pb.Crossing) and crossing.state == pb.DONE:
            found.append(
                _Done(
                    message.key.realm,
                    crossing.vehicle,
                    crossing.bridge,
                    crossing.entry_time_ns * 1e-9,
                    crossing.exit_time_ns * 1e-9,
                )
            )
    return found


if __name__ == "__main__":
    _recording, *_others = map(Path, sys.argv[1:])
    sys.exit(0 if is_processed(_recording, _others) else 1)
