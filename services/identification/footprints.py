"""Positions of a truck's axles on the road, as far as its site file declares them."""

from typing import Final

import numpy as np

from pre_core.physics.surface import TYPICAL_FOOTPRINTS, Footprint
from pre_core.physics.tandem import NO_TANDEM, FrontAxles, TandemTruck
from schemas.site import Vehicle
from schemas.site_axle_tables import TYRES, Axle

_TRACK_M: Final = 1.83
"""Track of axles with twin tyres."""
_OF_FRONT: Final = (
    "unsprung_mass_kg",
    "tyre_stiffness_n_per_m",
    "tyre_damping_ns_per_m",
    "suspension_stiffness_n_per_m",
    "suspension_damping_ns_per_m",
)
"""Keys of an axle ahead of a tandem that `FrontAxles` has, too."""


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


def front_footprints_of(vehicle: Vehicle) -> tuple[Footprint, ...]:
    """Return the footprints of the axles ahead of a tandem, beside that of the tandem's first one.

    There are none for a truck of two axles.
    """
    tandem = vehicle.tandem
    if tandem is None:
        return ()
    first = _of_axle(tandem.first)
    footprints = (_of_axle(one.axle, "single") for one in tandem.front_axles)
    return tuple(one._replace(offset_m=one.offset_m - first.offset_m) for one in footprints)


def tandem_truck_of(vehicle: Vehicle) -> TandemTruck:
    """Return the truck with a tandem as the method knows it; `NO_TANDEM` for one of two axles."""
    tandem = vehicle.tandem
    if tandem is None:
        return NO_TANDEM
    first_m = tandem.first.position_m
    axles = [one.axle for one in tandem.front_axles]
    return TandemTruck(
        first_m - tandem.front.position_m,
        vehicle.wheelbase_m,
        FrontAxles(
            ahead_m=np.array([first_m - axle.position_m for axle in axles]),
            share=np.array([one.share for one in tandem.front_axles]),
            **{key: np.array([float(getattr(one, key)) for one in axles]) for key in _OF_FRONT},
        ),
        tandem.is_equalised,
    )


def displaced_trucks_of(vehicle: Vehicle) -> tuple[TandemTruck, ...]:
    """Return the truck with one value of an axle ahead of a tandem displaced, one by one.

    Values are mass, tyre and tyre damping of each axle, and its springs if there are several; each
    is displaced by the standard deviation of its prior. There are none without a tandem.
    """
    tandem, truck = vehicle.tandem, tandem_truck_of(vehicle)
    if tandem is None:
        return ()
    displaced = []
    for number, one in enumerate(tandem.front_axles):
        for key in _OF_FRONT if len(tandem.front_axles) > 1 else _OF_FRONT[:3]:
            nominal = float(getattr(one.axle, key))
            if not nominal and key == "suspension_damping_ns_per_m":
                continue  # a spring without a damper
            values = getattr(truck.front, key).copy()
            values[number] = (
                nominal * (1.0 + vehicle.spread(key)) if nominal else vehicle.scale_at_zero(key)
            )
            displaced.append(truck._replace(front=truck.front._replace(**{key: values})))
    return tuple(displaced)


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
