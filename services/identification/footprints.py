"""Positions of a truck's axles on the road, as far as its site file declares them."""

from typing import Final

from pre_core.physics.surface import TYPICAL_FOOTPRINTS, Footprint
from pre_core.physics.tandem import NO_LEAD, Lead
from schemas.site import Vehicle
from schemas.site_axle_tables import TYRES, Axle

_TRACK_M: Final = 1.83
"""Track of axles with twin tyres."""


def footprints_of(
    vehicle: Vehicle, usual: tuple[Footprint, Footprint] = TYPICAL_FOOTPRINTS
) -> tuple[Footprint, Footprint]:
    """Return the footprints of the compared axles, as `usual` where the site file has no value.

    These are the front and the rear axle, or both of a tandem; the second one has the offset.
    """
    if vehicle.tandem is not None:
        first, second = (_of_axle(axle) for axle in vehicle.tandem.axles)
        return first._replace(offset_m=0.0), second._replace(
            offset_m=second.offset_m - first.offset_m
        )
    pairs = {
        "width_m": vehicle.tyre_width_m,
        "length_m": vehicle.tyre_contact_length_m,
        "twin_distance_m": vehicle.twin_tyre_distance_m,
        "track_m": vehicle.track_m,
    }
    axles = []
    for axle, common in enumerate(usual):
        stated = {name: pair[axle] for name, pair in pairs.items() if pair is not None}
        if stated.get("twin_distance_m") == 0.0:  # single tyres, with their usual width
            common = Footprint()
        axles.append(common._replace(**stated))
    return axles[0], axles[1]._replace(offset_m=vehicle.rear_axle_offset_m or 0.0)


def lead_footprint_of(vehicle: Vehicle) -> Footprint:
    """Return the footprint of the axle ahead of a tandem, with that of the tandem's first one.

    For a truck of two axles it is the typical front axle's.
    """
    tandem = vehicle.tandem
    if tandem is None:
        return TYPICAL_FOOTPRINTS[0]
    lead, first = _of_axle(tandem.lead, "single"), _of_axle(tandem.first)
    return lead._replace(offset_m=lead.offset_m - first.offset_m)


def lead_of(vehicle: Vehicle) -> Lead:
    """Return the axle ahead of a tandem, `NO_LEAD` for a truck of two axles."""
    tandem = vehicle.tandem
    if tandem is None:
        return NO_LEAD
    return Lead(
        tandem.first.position_m,
        vehicle.wheelbase_m,
        tandem.lead.unsprung_mass_kg,
        tandem.lead.tyre_stiffness_n_per_m,
        tandem.lead.tyre_damping_ns_per_m,
        tandem.lead.suspension_stiffness_n_per_m,
        tandem.lead.suspension_damping_ns_per_m,
        tandem.is_equalised,
    )


def displaced_leads_of(vehicle: Vehicle) -> tuple[Lead, ...]:
    """Return the axle ahead of a tandem with mass, tyre and tyre damping displaced one by one.

    Each is displaced by the standard deviation of its prior. There are none without a tandem.
    """
    tandem, lead = vehicle.tandem, lead_of(vehicle)
    if tandem is None:
        return ()

    def displaced(key: str) -> float:
        nominal = float(getattr(tandem.lead, key))
        return nominal * (1.0 + vehicle.spread(key)) if nominal else vehicle.scale_at_zero(key)

    return (
        lead._replace(unsprung_mass_kg=displaced("unsprung_mass_kg")),
        lead._replace(tyre_stiffness_n_per_m=displaced("tyre_stiffness_n_per_m")),
        lead._replace(tyre_damping_ns_per_m=displaced("tyre_damping_ns_per_m")),
    )


def _of_axle(axle: Axle, usually: str = "twin") -> Footprint:
    """Return the footprint of an axle, `usually` "twin" or "single" without declared tyres."""
    kind = axle.tyres or ("single" if axle.twin_tyre_distance_m == 0.0 else usually)
    usual = TYRES[kind]
    distance, length = axle.twin_tyre_distance_m, axle.tyre_contact_length_m
    return Footprint(
        axle.tyre_width_m or usual.width_m,
        usual.twin_distance_m if distance is None else distance,
        length or usual.contact_length_m,
        axle.track_m or _TRACK_M,
        axle.lateral_offset_m or 0.0,
    )
