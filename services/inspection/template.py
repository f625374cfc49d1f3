"""Template of a site file: required values are `nan`, the others have their defaults."""

from typing import Final

from schemas.site import Vehicle

TEMPLATE: Final = """\
# A site file: truck, bridge and sensors as they are known before the drive. All values in SI units.
# Replace every nan. Lines that begin with # may stay: they show a default, or may be unknown.
# Nominal values are those of a data sheet or drawing. A value KEY may have KEY_spread, its relative
# standard deviation: how far it may be off. Pairs are [front, rear].

[vehicle]
id = "truck-1"                        # a-z, 0-9, "-" and "_"
total_mass_kg = nan                   # weighed with driver, fuel and load: EI is proportional to it
wheelbase_m = nan                     # axle to axle, by tape
front_axle_to_cg_m = nan              # centre of gravity of the body: wheelbase times the share of
                                      # its weight on the rear axle
suspension_damping_ns_per_m = [nan, nan]   # of a whole axle (both wheels), like all pairs below
suspension_stiffness_n_per_m = [nan, nan]
unsprung_mass_kg = [nan, nan]         # mass below the springs: axle, wheels, brakes
tyre_stiffness_n_per_m = [nan, nan]   # of all tyres of an axle
gps_antenna_to_front_axle_m = nan     # distance behind the front axle, negative in front of it
# cg_height_m = 1.1                   # needed where the truck brakes or accelerates on the bridge
# pitch_inertia_ratio = 1.0           # pitch inertia over body mass and both axle distances
# tyre_damping_ns_per_m = [0.0, 0.0]  # 0 if unknown
# These decide how well single elements are resolved where axles follow different profiles:
# twin_tyre_distance_m = [0.0, 0.33]  # between the centres of twin tyres, 0 for single tyres
# tyre_width_m = [0.25, 0.22]         # of the tread
# tyre_contact_length_m = [0.2, 0.2]
# track_m = 2.0                       # between left and right wheels; a pair where axles differ:
                                      # single tyres help if both tracks agree to a centimetre
# rear_axle_offset_m = 0.005          # how far the rear axle runs to the left of the front one
# Accelerometers other than the usual four in the middle: a table [[vehicle.sensors]] for each, with
# channel, on, axle or position_m, lateral_m, noise_density_ug_per_rthz, rate_hz.
# sensors = []
# For a front axle and an equalised tandem, give [[vehicle.axles]] and [[vehicle.bogies]] instead of
# the wheelbase and the pairs.
# axles = []
# bogies = []
# total_mass_kg_spread = 0.01
# wheelbase_m_spread = 0.002
# front_axle_to_cg_m_spread = 0.15
# suspension_damping_ns_per_m_spread = 0.15
# suspension_stiffness_n_per_m_spread = 0.15
# unsprung_mass_kg_spread = 0.15
# tyre_stiffness_n_per_m_spread = 0.15
# cg_height_m_spread = 0.15
# pitch_inertia_ratio_spread = 0.15
# tyre_damping_ns_per_m_spread = 0.15

[bridge]
id = "bridge-1"
# owner_id = "B 317"                  # its owner's name, for reports
span_m = nan                          # between the outer bearings, to a centimetre or so
start_latitude_deg = nan              # the outer bearings, to a metre
start_longitude_deg = nan             # elements are counted from the start
end_latitude_deg = nan
end_longitude_deg = nan
elements = nan                        # for a span of 30 m: 3, or 5 to 7 with equal single tyres
flexural_rigidity_nm2 = nan           # E times I of deck and girders, undamaged, to a factor of 2;
                                      # driveby check names the EI that fits first_frequency_hz
mass_per_length_kg_per_m = nan        # with pavement and parapets
damping_ratio = nan                   # of the first mode: 0.01 steel, 0.02 concrete, or measured;
first_frequency_hz = nan              # measured, or 100 divided by the longest single span in m
# rayleigh_alpha_per_s = 0.75         # in place of ratio and frequency: damping is
# rayleigh_beta_s = 0.00034           # alpha M + beta K
# interior_supports_m = [20.0]        # of a bridge over several spans, from its start
# element_lengths_m = [10.0, 10.0]    # where elements differ in length; their sum is span_m
# flexural_rigidity_per_element_nm2 = [1.5e10, 1.4e10]
# bearings = "unknown"                # "free" to turn, "sprung", or a pair [start, end] of these
# support_rotational_stiffness_spread_nm_per_rad = 5.0e8   # default: EI over the span
# support_compliance_spread_m_per_n = 1.0e-9
# start_altitude_m = 100.0            # distinguish the bridge from one under it
# end_altitude_m = 100.0
# road_class = "A"                    # ISO 8608, for planning, simulation
# survey_speed_m_per_s = 10.0         # for planning; below 3 m/s crossings are rejected
# baseline = "first-survey.json"      # results to compare with, next to this file
# lane_offset_m = 1.6                 # centre of the lane, to the left looking from start to end
# torsional_frequency_ratio = 2.0     # first frequency in torsion over that in bending
# deck_gyration_m = 2.3               # radius of gyration of the cross-section
# flexural_rigidity_nm2_spread = 0.55
# mass_per_length_kg_per_m_spread = 0.1
# rayleigh_alpha_per_s_spread = 0.5
# rayleigh_beta_s_spread = 0.5
# lane_offset_m_spread = 0.3          # in m
# torsional_frequency_ratio_spread = 0.3
# deck_gyration_m_spread = 0.2

[sensor]                              # four: on the body above each axle, on each axle
rate_hz = nan                         # one number or four values; 100 at least
noise_density_ug_per_rthz = nan       # of the data sheet; driveby check compares it
# gravity_included = false
# up = [1, 1, 1, 1]                   # -1 where a sensor hangs upside down
# gain_spread = 0.01                  # between channels
# common_gain_spread = 0.01           # common to all channels, so in every EI
# delay_spread_s = 0.0005

[receiver]                            # the GNSS receiver
# position_spread_m = 1.5             # error that stays for minutes
# position_noise_m = 0.4              # error from fix to fix
# speed_noise_m_per_s = 0.07
# latency_s = 0.0
# latency_spread_s = 0.1
"""

_USUAL: Final = (
    "suspension_damping_ns_per_m",
    "suspension_stiffness_n_per_m",
    "unsprung_mass_kg",
    "tyre_stiffness_n_per_m",
    "twin_tyre_distance_m",
    "tyre_width_m",
    "track_m",
)
"""Keys that are alike in trucks of one kind; masses and lengths have to be measured."""
_USUAL_SPREAD: Final = 0.3
_CAUTION: Final = "# measure the truck: a spread of 0.1 narrows the intervals"


def template_of(truck: Vehicle) -> str:
    """Return the template with springs, dampers, axles and tyres of a typical truck."""
    lines = []
    caution = _CAUTION
    for line in TEMPLATE.split("\n"):
        key, _, _ = line.removeprefix("# ").partition(" = ")
        if key in _USUAL:
            line = f"{f'{key} = {list(getattr(truck, key))}':<60}# typical, not measured"
        elif key.removesuffix("_spread") in _USUAL:
            line, caution = f"{f'{key} = {_USUAL_SPREAD}':<44}{caution}".rstrip(), ""
        lines.append(line)
    return "\n".join(lines)
