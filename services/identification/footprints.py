"""Where a truck's axles stand on the road, as far as its site file tells."""

from pre_core.physics.surface import COMMON_LORRY, Footprint
from schemas.site import Vehicle


def footprints_of(
    vehicle: Vehicle, usual: tuple[Footprint, Footprint] = COMMON_LORRY
) -> tuple[Footprint, Footprint]:
    """Front and rear axle: as the site file says, else as `usual`; the rear one's offset too."""
    pairs = {
        "width_m": vehicle.tyre_width_m,
        "length_m": vehicle.tyre_contact_length_m,
        "twin_distance_m": vehicle.twin_tyre_distance_m,
        "track_m": vehicle.track_m,
    }
    axles = []
    for axle, common in enumerate(usual):
        stated = {name: pair[axle] for name, pair in pairs.items() if pair is not None}
        if stated.get("twin_distance_m") == 0.0:  # single tyres, as wide as such are
            common = Footprint()
        axles.append(common._replace(**stated))
    return axles[0], axles[1]._replace(offset_m=vehicle.rear_axle_offset_m or 0.0)
