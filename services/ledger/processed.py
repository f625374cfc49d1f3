"""Check whether every crossing in a recording is identified: only then may it be deleted.

    python -m services.ledger.processed REC.mcap OTHER.mcap…

The exit code is 0 if so, and 1 if not or if it cannot be determined. The crossings follow from the
recording's own positions and site file, as in the worker; their published results are in this
recording or in the others. It runs in a process of its own because it reads whole files.
"""

import sys
from collections.abc import Iterable
from itertools import chain
from pathlib import Path

from schemas.site import Site
from schemas.site_file import parse_site
from services.common.errors import InputError
from services.finding.bridges import Bridges
from services.finding.drive import DriveMessages, drives_of
from services.finding.streams import boot_of
from services.identification.known import CrossingRecord, is_stay_of
from services.ledger.crossing_log import CrossingLog
from services.recordings.recording import read_identities, read_messages, read_site


def is_processed(recording: Path, others: Iterable[Path]) -> bool:
    """Return whether every stay on a bridge in a recording is identified, by whatever search.

    The answer is also False if it cannot be determined: there is no site file in the recording, the
    site file lacks the truck, or a file is unreadable.
    """
    try:
        site_toml = read_site(recording)
        if site_toml is None:
            return False
        site = parse_site(site_toml, str(recording))
        log = CrossingLog(None)
        for path in chain([recording], others):
            _read_bridges(path, log)
        known = [crossing for crossing in log.crossings() if crossing.is_identified]
        return all(
            _are_known(site, drive, known)
            for drive in drives_of(read_messages(recording), most_batches=0)
        )
    except InputError:
        return False


def _are_known(site: Site, drive: DriveMessages, known: list[CrossingRecord]) -> bool:
    truck = {v.id: v for v in site.vehicles}.get(drive.vehicle)
    boot = boot_of(drive.fixes)
    fixes = boot.fixes()
    # Without positions the truck's whereabouts are unknown.
    if truck is None or not fixes.time_s.size:
        return False
    bridges = Bridges(site.bridges, site.receiver)
    for number, stay in bridges.all_stays(truck, fixes):
        name = (drive.realm, drive.vehicle, bridges.bridge(number).id)
        about = [k for k in known if (k.realm, k.vehicle, k.bridge) == name]
        entry_ns = boot.wall_time_ns(stay.entry_s)
        if not any(is_stay_of(one, stay, entry_ns) for one in about):
            return False
    return True


def _read_bridges(path: Path, log: CrossingLog) -> None:
    """Add a file's messages of bridges to the log, if it has any."""
    if all(where.owner != "bridge" for where, _ in read_identities(path)):
        return
    for message in read_messages(path):
        log.add(message.key, message.payload)


if __name__ == "__main__":
    _recording, *_others = map(Path, sys.argv[1:])
    sys.exit(0 if is_processed(_recording, _others) else 1)
