"""Validation records of a folder: writing them, and the passed ones of a site's pairs."""

import logging
from pathlib import Path

from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.validation_records import (
    ValidationRecord,
    VehicleBridgePair,
    load_validation,
    pair_hash,
    validation_json,
    validation_path,
)
from services.common.errors import InputError
from services.common.files import make_folder, write_atomically

_log = logging.getLogger(__name__)


def save(folder: Path, certificate: ValidationRecord) -> Path:
    """Write a validation record; return its path. Raise InputError or FailureError on failure."""
    make_folder(folder)
    path = validation_path(folder, certificate.hash)
    write_atomically(path, validation_json(certificate))
    return path


def passed_validations(
    folder: Path, site: Site, settings: IdentificationSettings
) -> dict[VehicleBridgePair, str]:
    """Return the hash of the passed validation record, by pair of a site that has one.

    An unreadable file is a warning; an absent folder has none.
    """
    vehicles = {vehicle.id for vehicle in site.vehicles}
    bridges = {bridge.id for bridge in site.bridges}
    found = {}
    for path in sorted(folder.glob("*.json")):
        try:
            one = load_validation(path)
        except InputError as error:
            _log.warning("%s", error)
            continue
        is_ours = one.vehicle in vehicles and one.bridge in bridges
        if is_ours and one.passed and one.hash == pair_hash(site, one.pair, settings):
            found[one.pair] = one.hash
    return found
