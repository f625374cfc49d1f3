"""Usual trucks, for forecasts and simulated surveys: loaded tippers with a tandem, and a lorry.

Values are those of ordinary trucks; a single truck differs from them.
"""

from typing import Any, Final

from schemas.site import Vehicle
from schemas.site_axle_tables import TYRES

TANDEM_KG: Final = 24_800.0
FOUR_AXLES_KG: Final = 32_000.0
LORRY_KG: Final = 16_300.0
_FRONT: Final[dict[str, Any]] = {
    "unsprung_mass_kg": 700.0,
    "suspension_stiffness_n_per_m": 3.4e5,
    "suspension_damping_ns_per_m": 24e3,
    "tyre_stiffness_n_per_m": 2.0e6,
}
_BEHIND: Final[dict[str, Any]] = {
    "unsprung_mass_kg": 1_050.0,
    "suspension_stiffness_n_per_m": 8.5e5,
    "suspension_damping_ns_per_m": 31e3,
    "tyre_stiffness_n_per_m": 3.7e6,
}
_TRACKS_M: Final = (2.05, 1.83)


def usual_tandem(noise_ug_per_rthz: float, tyres: str = "twin") -> Vehicle:
    """Return a three-axle tipper of `TANDEM_KG` with `tyres` ("single" or "twin") on its tandem.

    Four sensors are in the middle: on the body above the front axle and above the tandem, and on
    both axles of the tandem.
    """
    places, loads = ((0.0,), (4.60, 5.95)), ((7_800.0,), (8_500.0, 8_500.0))
    return _tipper("tandem", TANDEM_KG, places, loads, noise_ug_per_rthz, tyres)


def usual_four_axles(noise_ug_per_rthz: float, tyres: str = "twin") -> Vehicle:
    """Return a four-axle tipper of `FOUR_AXLES_KG`, with two steered axles and a tandem.

    Sensors and `tyres` are as in `usual_tandem`; the steered axles have springs of their own.
    """
    places, loads = ((0.0, 1.95), (5.10, 6.45)), ((6_800.0, 6_800.0), (9_200.0, 9_200.0))
    return _tipper("four-axles", FOUR_AXLES_KG, places, loads, noise_ug_per_rthz, tyres)


def _tipper(
    identifier: str,
    total_mass_kg: float,
    places_m: tuple[tuple[float, ...], tuple[float, ...]],
    loads_kg: tuple[tuple[float, ...], tuple[float, ...]],
    noise_ug_per_rthz: float,
    tyres: str,
) -> Vehicle:
    """Return a tipper with axles at these places, ahead of the tandem and in it."""
    axles: list[dict[str, Any]] = []
    for behind, values in enumerate((_FRONT, _BEHIND)):
        kind = tyres if behind else "single"
        of = TYRES[kind]
        for place, load in zip(places_m[behind], loads_kg[behind], strict=True):
            axles.append(
                {
                    "position_m": place,
                    "tyres": kind,
                    "tyre_width_m": of.width_m,
                    "twin_tyre_distance_m": of.twin_distance_m,
                    "track_m": _TRACKS_M[behind] if tyres == "twin" else _TRACKS_M[0],
                    "load_kg": load,
                    **values,
                }
            )
    ahead, (first, second) = len(places_m[0]), places_m[1]
    number = ahead + 1
    bogies: list[dict[str, Any]] = [{"axles": [number, number + 1], "equalised": True}]
    front_m = sum(places_m[0]) / ahead
    table: dict[str, Any] = {
        "id": identifier,
        "total_mass_kg": total_mass_kg,
        "gps_antenna_to_front_axle_m": 0.0,
        "cg_height_m": 1.3,
        "axles": axles,
        "bogies": bogies,
        "sensors": [
            _sensor("sprung_front", noise_ug_per_rthz, on="body", position_m=front_m),
            _sensor("sprung_rear", noise_ug_per_rthz, on="body", position_m=0.5 * (first + second)),
            *(
                _sensor(f"unsprung_{axle}", noise_ug_per_rthz, on="axle", axle=axle)
                for axle in (number, number + 1)
            ),
        ],
    }
    return Vehicle.model_validate(table)


def usual_lorry(tyres: str = "twin") -> Vehicle:
    """Return a lorry of two axles of `LORRY_KG` with `tyres` ("single" or "twin") behind.

    With single tyres both axles have the same tyres and one track. Four sensors are in the middle.
    """
    kinds = (TYRES["single"], TYRES[tyres])
    front, behind = (of["tyre_stiffness_n_per_m"] for of in (_FRONT, _BEHIND))
    if tyres == "single":  # twin tyres are two a side, a single axle has the front one's two tyres
        behind = front
    return Vehicle.model_validate(
        {
            "id": "lorry",
            "total_mass_kg": LORRY_KG,
            "gps_antenna_to_front_axle_m": 0.0,
            "cg_height_m": 1.3,
            "wheelbase_m": 4.75,
            "front_axle_to_cg_m": 2.85,
            "suspension_damping_ns_per_m": (20e3, 34e3),
            "suspension_stiffness_n_per_m": (3.2e5, 8.5e5),
            "unsprung_mass_kg": (700.0, 1_100.0),
            "tyre_stiffness_n_per_m": (front, behind),
            "tyre_width_m": tuple(kind.width_m for kind in kinds),
            "twin_tyre_distance_m": tuple(kind.twin_distance_m for kind in kinds),
            "track_m": (_TRACKS_M[0], _TRACKS_M[1] if tyres == "twin" else _TRACKS_M[0]),
        }
    )


def _sensor(channel: str, noise_ug_per_rthz: float, **place: Any) -> dict[str, Any]:
    return {"channel": channel, "noise_density_ug_per_rthz": noise_ug_per_rthz, **place}
