"""Certificates of a folder: which pairs of a site have one that passed; writing them."""

import logging
from pathlib import Path

from schemas.certificates import (
    Certificate,
    Pair,
    certificate_json,
    certificate_path,
    load_certificate,
    pair_hash,
)
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.common.errors import InputError
from services.common.files import make_folder, write_atomically

_log = logging.getLogger(__name__)


def save(folder: Path, certificate: Certificate) -> Path:
    """Write a certificate; return where. InputError or FailureError if that is not possible."""
    make_folder(folder)
    path = certificate_path(folder, certificate.hash)
    write_atomically(path, certificate_json(certificate))
    return path


def found_in(folder: Path, site: Site, settings: IdentificationSettings) -> dict[Pair, str]:
    """By pair of a site, the hash of its certificate in a folder, if it has one that passed.

    A file that cannot be read is a warning; a folder that is not there has none.
    """
    vehicles = {vehicle.id for vehicle in site.vehicles}
    bridges = {bridge.id for bridge in site.bridges}
    found = {}
    for path in sorted(folder.glob("*.json")):
        try:
            one = load_certificate(path)
        except InputError as error:
            _log.warning("%s", error)
            continue
        is_ours = one.vehicle in vehicles and one.bridge in bridges
        if is_ours and one.passed and one.hash == pair_hash(site, one.pair, settings):
            found[one.pair] = one.hash
    return found
