"""Certificates of the paper's truck on its bridge."""

from typing import Any

from schemas import validation_records
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.validation_records import (
    ValidationCrossing,
    ValidationRecord,
    VehicleBridgePair,
    pair_hash,
)
from services.simulation.drive import paper_site

SITE = paper_site()
PAIR = VehicleBridgePair("truck-1", "bridge-1")
SETTINGS = IdentificationSettings()


def tried(number: int = 0, **values: Any) -> ValidationCrossing:
    """Return a crossing that found its two elements undamaged."""
    fields: dict[str, Any] = {
        "seed": number,
        "direction": "start_to_end",
        "ei_ratio": (1.0, 1.0),
        "verdict": "good",
        "ei_ratio_q025": (0.8, 0.8),
        "ei_ratio_q50": (1.0, 1.0),
        "ei_ratio_q975": (1.25, 1.25),
    }
    return ValidationCrossing.model_validate(fields | values)


def certificate(
    site: Site = SITE, pair: VehicleBridgePair = PAIR, **values: Any
) -> ValidationRecord:
    """Return a certificate that passed and vouches for nothing but its own form."""
    fields: dict[str, Any] = {
        "version": "0",
        "created": 0.0,
        "hash": pair_hash(site, pair, SETTINGS),
        "method_edition": validation_records.METHOD_EDITION,
        "vehicle": pair.vehicle,
        "bridge": pair.bridge,
        "settings": SETTINGS.model_dump(mode="json"),
        "seed": 1,
        "conditions": {
            "speed_m_per_s": 10.0,
            "road_class": "B",
            "road": "groove",
            "rate_hz": 1000.0,
            "noise_density_ug_per_rthz": (25.0,) * 4,
        },
        "planned": 12,
        "crossings": (tried(),),
        "figures": {
            "crossings": 1,
            "good": 1,
            "intervals": 2,
            "covered": 2,
            "weak": 0,
            "weak_found": 0,
            "evaluations": 0,
        },
        "passed": True,
        "reason": "made up",
    }
    return ValidationRecord.model_validate(fields | values)
