"""The kinds of surveys that `driveby validate --surveys` simulates.

A table of plain values: the command's help names them, so nothing heavy is imported here.
"""

from typing import Final, NamedTuple

_LORRY_KG, _EMPTY_KG, _LOADED_KG = 16_300.0, 7_300.0, 24_000.0


class SurveyKind(NamedTuple):
    """Conditions of a survey."""

    crossings: int
    changes: float = 0.0
    """Relative standard deviation of EI from crossing to crossing; common to all elements in every
    other survey, each element's own in the others."""
    tyres: str | None = None
    """Rear tyres, on a 2-D road surface; None: both axles follow one profile."""
    offset_m: float = 0.005
    wander_m: float = 0.12
    masses_kg: tuple[float | None, ...] = (None,)
    """Total masses of the trucks that take turns; None for the site's."""
    both_ways: bool = False
    elements: int | None = None
    everything: bool = False
    """Whether all effects are added: suspension friction, compliant bearings, damped tyres and a
    lorry that has just left the bridge."""
    scenario: int | None = None
    """Scenario of the paper with the ratios of EI; the level common to all elements is drawn."""
    ei_ratios: tuple[float, ...] | None = None
    """Ratios of EI instead of a scenario; with neither, each element's EI is drawn."""
    noise_ug_per_rthz: float = 25.0
    deck_roughness: float = 1.0
    """Roughness of the pavement on the bridge over that of the road."""
    largest_joint_m: float = 0.0
    """Largest height of joints at both ends of the bridge."""
    anisotropy: float = 1.0
    """Lateral correlation length of the surface over that of an isotropic one."""
    has_tandem: bool = False
    """Whether trucks without a mass in `masses_kg` have an equalised tandem, on a 2-D surface;
    `offset_m` is then that of its second axle."""
    friction_share: float = 0.0
    """Friction of the tandem's springs over their static load."""


KINDS: Final = {
    "steady": SurveyKind(16),
    "changing-2": SurveyKind(16, 0.02),
    "changing-5": SurveyKind(16, 0.05),
    "twin": SurveyKind(12, tyres="twin", masses_kg=(_LORRY_KG,)),
    "single-5": SurveyKind(12, tyres="single", masses_kg=(_LORRY_KG,)),
    "single-10": SurveyKind(8, tyres="single", offset_m=0.01, masses_kg=(_LORRY_KG,)),
    "loaded-and-empty": SurveyKind(16, tyres="twin", masses_kg=(_LOADED_KG, _EMPTY_KG)),
    "two-trucks": SurveyKind(12, tyres="twin", masses_kg=(_LORRY_KG, 12_000.0)),
    "both-ways": SurveyKind(12, tyres="twin", masses_kg=(_LORRY_KG,), both_ways=True),
    "five-elements": SurveyKind(12, tyres="twin", masses_kg=(_LORRY_KG,), elements=5),
    "three-elements": SurveyKind(12, tyres="twin", masses_kg=(_LORRY_KG,), elements=3),
    "twin-rough-deck": SurveyKind(
        10, tyres="twin", masses_kg=(_LORRY_KG,), deck_roughness=2.5, largest_joint_m=0.015
    ),
    "twin-smooth-deck": SurveyKind(10, tyres="twin", masses_kg=(_LORRY_KG,), deck_roughness=0.5),
    "single-rough-deck": SurveyKind(
        10, tyres="single", masses_kg=(_LORRY_KG,), deck_roughness=2.5, largest_joint_m=0.015
    ),
    "single-smooth-deck": SurveyKind(
        10, tyres="single", masses_kg=(_LORRY_KG,), deck_roughness=0.5
    ),
    "tandem": SurveyKind(12, has_tandem=True),
    "tandem-rubbing": SurveyKind(12, has_tandem=True, friction_share=0.08),
    "tandem-aside": SurveyKind(12, has_tandem=True, offset_m=0.02),
    "tandem-weak": SurveyKind(8, has_tandem=True, ei_ratios=(1.0, 1.0, 0.8, 1.0, 1.0, 1.0, 1.0)),
    "mixed-fleet": SurveyKind(12, tyres="single", masses_kg=(None, _LORRY_KG), has_tandem=True),
    "everything": SurveyKind(16, tyres="twin", masses_kg=(_LORRY_KG,), everything=True),
    "scenario-1": SurveyKind(16, scenario=1, noise_ug_per_rthz=100.0),
    "scenario-4": SurveyKind(16, scenario=4, noise_ug_per_rthz=100.0),
    "scenario-10": SurveyKind(16, scenario=10, noise_ug_per_rthz=100.0),
    "scenario-5": SurveyKind(16, scenario=5, noise_ug_per_rthz=100.0),
    "scenario-11": SurveyKind(16, scenario=11, noise_ug_per_rthz=100.0),
}
