"""One crossing among ten is by a truck that the site file does not know: recordings to bridge.

All are of one bridge over one road, with noise and a receiver's errors. The owner takes all for the
site file's truck.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.reasons import LeftOutReason, Reason
from schemas.results import BridgeResult, CrossingResult, load_results
from schemas.site import Vehicle
from services.cli.main import main
from services.identification.bridge_state import (
    NOTHING_STORED,
    FusionSettings,
    RecentCrossings,
    add_crossings,
    state_of,
    usable,
)
from services.simulation.drive import (
    DrivenRoad,
    Measurement,
    declared_site,
    paper_site,
    simulate_drive,
    write_drives,
)
from tests.verdicts.faults import errors_of

NOISE_UG, RATE_HZ = 25.0, 500.0
SEED = 5
RATIOS = np.array([1.0, 1.0, 1.0, 0.7, 1.0, 1.0, 1.0])
OTHER_MAKE, SISTER, SAME_MOTION = 3, 5, 8
"""Which crossings are by a foreign truck."""
SPEEDS_M_PER_S = np.linspace(8.8, 11.4, 12)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900), pytest.mark.xdist_group("foreign")]


@pytest.fixture(scope="module")
def crossings(tmp_path_factory: pytest.TempPathFactory) -> tuple[CrossingResult, ...]:
    """Nine by the site's truck and three foreign ones, in the order in which they were driven."""
    folder = tmp_path_factory.mktemp("foreign")
    site = paper_site()
    trucks = [site.vehicles[0]] * SPEEDS_M_PER_S.size
    trucks[OTHER_MAKE] = of_another_make(site.vehicles[0])
    trucks[SISTER] = of_the_same_make(site.vehicles[0])
    trucks[SAME_MOTION] = of_the_same_motion(site.vehicles[0])
    drives = [
        simulate_drive(
            site.model_copy(update={"vehicles": (truck,)}),
            RATIOS,
            DrivenRoad("A", SEED),
            Measurement(NOISE_UG, rate_hz=RATE_HZ, has_receiver_errors=True, seed=(SEED, number)),
            speed_m_per_s=(float(speed), float(speed)),
        )
        for number, (truck, speed) in enumerate(zip(trucks, SPEEDS_M_PER_S, strict=True))
    ]
    recording, found = folder / "week.mcap", folder / "week.json"
    write_drives(recording, drives, declared_site(site, NOISE_UG, RATE_HZ))
    assert main(["identify", str(recording), "--json", str(found)]) == 0
    return load_results(found).crossings


def test_a_truck_of_another_make_is_named_by_its_own_crossing(
    crossings: tuple[CrossingResult, ...],
) -> None:
    ten = with_one(crossings, OTHER_MAKE)
    foreign = crossings[OTHER_MAKE]
    assert Reason.IMPLAUSIBLE_VEHICLE in foreign.reasons
    assert left_out(fused(ten)) == {foreign.crossing_id: LeftOutReason.SUSPECT}
    # Whoever wants suspect crossings too does not get this one.
    assert left_out(fused(ten, FusionSettings(with_suspect=True))) == {
        foreign.crossing_id: LeftOutReason.DISAGREES
    }


def test_a_truck_of_the_same_make_is_named_by_the_others(
    crossings: tuple[CrossingResult, ...],
) -> None:
    """Springs and dampers that the site file's spreads allow: its answer is right, by itself."""
    foreign = crossings[SISTER]
    assert foreign.verdict == "good", foreign.reasons
    assert np.abs(z_scores(foreign)).max() < 4.0
    ten = with_one(crossings, SISTER)
    at = ten.index(foreign)
    for some in (ten, ten[at - 1 : at + 2]):
        assert left_out(fused(some)) == {foreign.crossing_id: LeftOutReason.DISAGREES}


def test_a_truck_that_is_heavier_in_all_its_parts_is_named_by_the_others(
    crossings: tuple[CrossingResult, ...],
) -> None:
    """It moves as the site's truck would over a softer bridge: alone it cannot be distinguished."""
    foreign = crossings[SAME_MOTION]
    assert foreign.verdict == "good", foreign.reasons
    assert np.abs(z_scores(foreign)).max() > 4.0
    state = fused(with_one(crossings, SAME_MOTION))
    assert left_out(state) == {foreign.crossing_id: LeftOutReason.DISAGREES}


@pytest.mark.parametrize("other", [OTHER_MAKE, SISTER, SAME_MOTION])
def test_the_bridge_is_what_the_sound_crossings_say(
    crossings: tuple[CrossingResult, ...], other: int
) -> None:
    state = fused(with_one(crossings, other))
    assert (state.verdict, len(state.crossings_used)) == ("good", 9)
    assert np.abs(z_scores(state)).max() < 4.0, z_scores(state)
    assert state.finding is not None
    assert state.finding.startswith("Element 4 (12.9 to 17.1 m): ")


def with_one(crossings: tuple[CrossingResult, ...], foreign: int) -> list[CrossingResult]:
    """The nine by the site's truck, and one that is not."""
    others = {OTHER_MAKE, SISTER, SAME_MOTION} - {foreign}
    return [one for number, one in enumerate(crossings) if number not in others]


def fused(crossings: list[CrossingResult], fusing: FusionSettings = NOTHING_STORED) -> BridgeResult:
    """As `driveby fuse` does."""
    counted = add_crossings(
        RecentCrossings(), [one for one in map(usable, crossings) if one is not None]
    )
    state = state_of(counted, "bridge-1", fusing)
    assert state is not None
    return state


def left_out(state: BridgeResult) -> dict[str, LeftOutReason]:
    return {one.crossing_id: one.reason for one in state.crossings_left_out}


def z_scores(found: BridgeResult | CrossingResult) -> NDArray[np.float64]:
    """Error of every EI in its standard deviations."""
    nominal_nm2 = np.array(paper_site().bridges[0].nominal_flexural_rigidity_nm2)
    return errors_of(found, RATIOS * nominal_nm2)


def of_another_make(truck: Vehicle) -> Vehicle:
    """Three tenths heavier, most of it behind, on other springs, dampers and tyres."""
    return truck.model_copy(
        update={
            "total_mass_kg": 1.3 * truck.total_mass_kg,
            "front_axle_to_cg_m": 0.6 * truck.wheelbase_m,
            "suspension_stiffness_n_per_m": (400e3, 700e3),
            "suspension_damping_ns_per_m": (20e3, 35e3),
            "unsprung_mass_kg": (600.0, 1000.0),
            "tyre_stiffness_n_per_m": (5.5e6, 6.5e6),
        }
    )


def of_the_same_make(truck: Vehicle) -> Vehicle:
    """As heavy, on springs and dampers that are a tenth or two others."""
    front, rear = truck.suspension_stiffness_n_per_m
    front_damping, rear_damping = truck.suspension_damping_ns_per_m
    return truck.model_copy(
        update={
            "suspension_stiffness_n_per_m": (1.15 * front, 0.9 * rear),
            "suspension_damping_ns_per_m": (0.85 * front_damping, 1.2 * rear_damping),
        }
    )


def of_the_same_motion(truck: Vehicle) -> Vehicle:
    """Masses, springs and dampers a fifth larger: every acceleration of it is as before."""

    def larger(pair: tuple[float, float]) -> tuple[float, float]:
        return 1.2 * pair[0], 1.2 * pair[1]

    return truck.model_copy(
        update={
            "total_mass_kg": 1.2 * truck.total_mass_kg,
            "suspension_stiffness_n_per_m": larger(truck.suspension_stiffness_n_per_m),
            "suspension_damping_ns_per_m": larger(truck.suspension_damping_ns_per_m),
            "unsprung_mass_kg": larger(truck.unsprung_mass_kg),
            "tyre_stiffness_n_per_m": larger(truck.tyre_stiffness_n_per_m),
        }
    )
