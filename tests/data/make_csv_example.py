"""Writes tests/data/csv_example: a truck that never was, over a bridge that never was.

Sums of sines, not mechanics: for tests of reading, clocks and recordings in a clone that stands
alone. Run it with the folder to write to; without one it writes beside itself.
"""

import math
import sys
from pathlib import Path

RATE_HZ = 100
SECONDS = 6.0
SPEED_M_PER_S = 10.0
START_S = 1_790_000_000
LATITUDE_DEG, LONGITUDE_DEG = 47.0, 8.0
METRES_PER_DEGREE_EAST = 76_056.4  # at that latitude, on the ellipsoid
SPAN_M = 20.0

SITE = f"""\
# A made-up truck and bridge. The bridge lies from west to east.
[vehicle]
id = "truck-x"
total_mass_kg = 9000.0
wheelbase_m = 4.0
front_axle_to_cg_m = 1.2
suspension_damping_ns_per_m = [25000.0, 30000.0]
suspension_stiffness_n_per_m = [450000.0, 420000.0]
unsprung_mass_kg = [450.0, 750.0]
tyre_stiffness_n_per_m = [4800000.0, 4300000.0]
gps_antenna_to_front_axle_m = 1.0

[bridge]
id = "bridge-x"
span_m = {SPAN_M}
start_latitude_deg = {LATITUDE_DEG}
start_longitude_deg = {LONGITUDE_DEG}
end_latitude_deg = {LATITUDE_DEG}
end_longitude_deg = {LONGITUDE_DEG + SPAN_M / METRES_PER_DEGREE_EAST:.8f}
elements = 5
flexural_rigidity_nm2 = 1.2e10
mass_per_length_kg_per_m = 4000.0
rayleigh_alpha_per_s = 0.7
rayleigh_beta_s = 0.005

[sensor]
rate_hz = {RATE_HZ}
noise_density_ug_per_rthz = 25.0
"""


def accel() -> str:
    """Body at 1.5 and 2 Hz, axles at 11 and 13 Hz, in m/s²."""
    lines = ["time_s,sprung_front,sprung_rear,unsprung_front,unsprung_rear"]
    for i in range(round(SECONDS * RATE_HZ)):
        t = i / RATE_HZ
        values = [
            amplitude * math.sin(2 * math.pi * frequency * t + phase)
            for amplitude, frequency, phase in ((0.4, 1.5, 0), (0.5, 2, 1), (3, 11, 2), (4, 13, 3))
        ]
        lines.append(f"{START_S + t:.6f}," + ",".join(f"{value:.6f}" for value in values))
    return "\n".join(lines) + "\n"


def gps() -> str:
    """From 20 m before the bridge to 20 m behind it, ten fixes a second."""
    lines = ["time_s,latitude_deg,longitude_deg,altitude_m,speed_mps"]
    for i in range(round(SECONDS * 10)):
        east_m = -20 + SPEED_M_PER_S * i / 10
        longitude = LONGITUDE_DEG + east_m / METRES_PER_DEGREE_EAST
        lines.append(
            f"{START_S + i / 10:.3f},{LATITUDE_DEG:.8f},{longitude:.8f},400.00,{SPEED_M_PER_S:.3f}"
        )
    return "\n".join(lines) + "\n"


def main(folder: Path) -> None:
    """Write the three files."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "site.toml").write_text(SITE)
    (folder / "accel_00.csv").write_text(accel())
    (folder / "gps_00.csv").write_text(gps())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "csv_example")
