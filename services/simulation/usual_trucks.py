"""Usual trucks, for forecasts and simulated surveys: a loaded tipper with a tandem, and a lorry.

Values are those of ordinary trucks; a single truck differs from them.
"""

from typing import Any, Final

from schemas.site import Vehicle
from schemas.site_axle_tables import TYRES

TANDEM_KG: Final = 24_800.0
LORRY_KG: Final = 16_300.0
_PLACES_M: Final = (0.0, 4.60, 5.95)
_LOADS_KG: Final = (7_800.0, 8_500.0, 8_500.0)
_UNSPRUNG_KG: Final = (700.0, 1_050.0, 1_050.0)
_SPRINGS_N_PER_M: Final = (3.4e5, 8.5e5, 8.5e5)
_DAMPERS_NS_PER_M: Final = (24e3, 31e3, 31e3)
_TYRES_N_PER_M: Final = (2.0e6, 3.7e6, 3.7e6)
_TRACKS_M: Final = (2.05, 1.83, 1.83)


def usual_tandem(noise_ug_per_rthz: float, tyres: str = "twin") -> Vehicle:
    """Return a three-axle tipper of `TANDEM_KG` with `tyres` ("single" or "twin") on its tandem.

    Four sensors are in the middle: on the body above the front axle and above the tandem, and on
    both axles of the tandem.
    """
    axles = []
    for i, place in enumerate(_PLACES_M):
        kind = "single" if i == 0 else tyres
        of = TYRES[kind]
        axles.append(
            {
                "position_m": place,
                "tyres": kind,
                "tyre_width_m": of.width_m,
                "twin_tyre_distance_m": of.twin_distance_m,
                "track_m": _TRACKS_M[i] if tyres == "twin" else _TRACKS_M[0],
                "load_kg": _LOADS_KG[i],
                "unsprung_mass_kg": _UNSPRUNG_KG[i],
                "suspension_stiffness_n_per_m": _SPRINGS_N_PER_M[i],
                "suspension_damping_ns_per_m": _DAMPERS_NS_PER_M[i],
                "tyre_stiffness_n_per_m": _TYRES_N_PER_M[i],
            }
        )
    middle_m = 0.5 * (_PLACES_M[1] + _PLACES_M[2])
    table: dict[str, Any] = {
        "id": "tandem",
        "total_mass_kg": TANDEM_KG,
        "gps_antenna_to_front_axle_m": 0.0,
        "cg_height_m": 1.3,
        "axles": axles,
        "bogies": [{"axles": [2, 3], "equalised": True}],
        "sensors": [
            _sensor("sprung_front", noise_ug_per_rthz, on="body", position_m=0.0),
            _sensor("sprung_rear", noise_ug_per_rthz, on="body", position_m=middle_m),
            _sensor("unsprung_2", noise_ug_per_rthz, on="axle", axle=2),
            _sensor("unsprung_3", noise_ug_per_rthz, on="axle", axle=3),
        ],
    }
    return Vehicle.model_validate(table)


def usual_lorry(tyres: str = "twin") -> Vehicle:
    """Return a lorry of two axles of `LORRY_KG` with `tyres` ("single" or "twin") behind.

    With single tyres both axles have the same tyres and one track. Four sensors are in the middle.
    """
    kinds = (TYRES["single"], TYRES[tyres])
    front, behind, _ = _TYRES_N_PER_M
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
