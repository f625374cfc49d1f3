"""Whether every crossing in a recording has been identified: only then may it be deleted.

    python -m services.history.processed REC.mcap OTHER.mcap…

exits with 0 if so, 1 if not or if it cannot be known. Which crossings there are follows from the
recording's own positions and site file, found as the worker finds them; what was told of them is in
this recording or in others. A process of its own, because it reads whole files.
"""

import sys
from collections.abc import Iterable
from itertools import chain
from pathlib import Path

from schemas.signals import GnssFix, decode_gnss
from schemas.site import Site
from schemas.site_file import parse_site
from services.common.errors import InputError
from services.history.store import Store
from services.identification.bridges import Bridges
from services.identification.known import Known, is_stay_of
from services.identification.streams import Boot, boot_of
from services.recordings.recording import read_identities, read_messages, read_site


def is_processed(recording: Path, others: Iterable[Path]) -> bool:
    """Whether every stay on a bridge in a recording has been identified, by whatever search.

    False too where it cannot be known: no site file in the recording, a truck that it does not
    name, a file that cannot be read.
    """
    try:
        site_toml = read_site(recording)
        if site_toml is None:
            return False
        site = parse_site(site_toml, str(recording))
        store = Store(None)
        for path in chain([recording], others):
            _read_bridges(path, store)
        known = [crossing for crossing in store.crossings() if crossing.is_identified]
        return all(
            _are_known(site, realm, vehicle, boot, known)
            for (realm, vehicle, _), boot in _boots(recording).items()
        )
    except InputError:
        return False


def _boots(recording: Path) -> dict[tuple[str, str, int], Boot]:
    """The fixes of every boot of every truck; one without positions was on no known bridge."""
    found: dict[tuple[str, str, int], dict[int, GnssFix]] = {}
    for message in read_messages(recording):
        where = message.key
        if where.owner != "vehicle":
            continue
        fixes = found.setdefault((where.realm, where.identifier, message.boot_id), {})
        if where.stream == "gnss":
            try:
                fixes[message.sequence] = decode_gnss(message.payload)
            except ValueError:
                continue
    return {name: boot_of(fixes) for name, fixes in found.items()}


def _are_known(site: Site, realm: str, vehicle: str, boot: Boot, known: list[Known]) -> bool:
    truck = {v.id: v for v in site.vehicles}.get(vehicle)
    fixes = boot.fixes()
    if truck is None or not fixes.time_s.size:
        return False
    bridges = Bridges(site.bridges, site.receiver)
    for number, stay in bridges.all_stays(truck, fixes):
        name = (realm, vehicle, bridges.bridge(number).id)
        about = [k for k in known if (k.realm, k.vehicle, k.bridge) == name]
        entry_ns = boot.wall_time_ns(stay.entry_s)
        if not any(is_stay_of(one, stay, entry_ns) for one in about):
            return False
    return True


def _read_bridges(path: Path, store: Store) -> None:
    """Take in what a file says of bridges, if it says anything."""
    if all(where.owner != "bridge" for where, _ in read_identities(path)):
        return
    for message in read_messages(path):
        store.add(message.key, message.payload)


if __name__ == "__main__":
    _recording, *_others = map(Path, sys.argv[1:])
    sys.exit(0 if is_processed(_recording, _others) else 1)
