"""An engine that goes on with an edited site file."""

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.site import Site
from schemas.site_file import site_hash
from schemas.topics import Message
from schemas.validation_records import VehicleBridgePair
from services.identification.bridge_state import NOTHING_STORED
from services.identification.outputs import Output, ValidationRequest
from tests.unit.identification.test_engine_certificates import DIGEST, ONE, OTHER, PAIR, Asking
from tests.unit.identification.test_engine_resume import (
    HEADER,
    SITE,
    START_S,
    TWO,
    bridge_states,
    until,
)

EDITED = SITE.model_copy(
    update={
        "bridges": (
            SITE.bridges[0].model_copy(
                update={"id": "bridge-0", "start_latitude_deg": 51.0, "end_latitude_deg": 51.0002}
            ),
            SITE.bridges[0].model_copy(update={"rayleigh_alpha_per_s": 0.9}),
        ),
        "vehicles": (SITE.vehicles[0].model_copy(update={"cg_height_m": 1.3}),),
    }
)
"""Another bridge comes before it, and truck and bridge have changed."""


def after(time_s: float) -> list[Message]:
    return [m for m in TWO if m.log_time_ns * 1e-9 - START_S >= time_s]


def retargeted(one: Asking, site: Site, **certificates: str) -> list[ValidationRequest]:
    header = HEADER._replace(site_hash=site_hash(site))
    known = {PAIR: DIGEST} if certificates else {}
    return list(one.engine.retarget(site, header, NOTHING_STORED, known))


def hashes(outputs: list[Output]) -> list[tuple[str, str]]:
    estimates = [pb.Estimate.FromString(o.payload) for o in outputs if o.key.stream == "estimate"]
    return [(one.crossing_id, one.site_hash) for one in estimates]


@pytest.mark.parametrize("time_s", [0.5, 7.5, 12.0, 25.0, 42.0])
def test_every_crossing_has_one_result_with_the_hash_of_its_site(time_s: float) -> None:
    """Also where the file is edited while the truck is on the bridge, or has just left it."""
    one = Asking({PAIR: DIGEST})
    before = one.fed(until(time_s))
    assert retargeted(one, EDITED, passed=DIGEST) == []
    then = [*one.fed(after(time_s)), *one.published(one.engine.finish())]
    new = site_hash(EDITED)
    assert hashes([*before, *then]) == [
        *(hashes(before)),
        *((name, new) for name in (ONE, OTHER)[len(hashes(before)) :]),
    ]
    assert {digest for _, digest in hashes(before)} <= {HEADER.site_hash}
    works = [o.result for o in then if o.result is not None]
    assert all(result.bridge == "bridge-1" for result in works)


def test_states_of_bridges_begin_anew_as_after_a_new_start() -> None:
    one = Asking({PAIR: DIGEST})
    one.fed(until(25.0))
    retargeted(one, EDITED, passed=DIGEST)
    (state,) = bridge_states(one.fed(after(25.0)))
    assert list(state.crossings_used) == [OTHER]
    assert not state.crossings_left_out


def test_crossings_that_wait_are_those_of_the_new_file() -> None:
    one = Asking()
    one.fed(TWO)
    assert retargeted(one, EDITED) == [ValidationRequest(VehicleBridgePair("truck-1", "bridge-1"))]
    assert one.engine.waiting() == {PAIR: [ONE, OTHER]}
    seen = []
    one.engine.certify(PAIR, DIGEST)
    while one.engine.has_released:
        output = list(one.engine.release())
        seen += [one for one in output if not isinstance(one, (Output, ValidationRequest))]
    assert [(work.data.vehicle, work.data.bridge) for work in seen] == [
        (EDITED.vehicles[0], EDITED.bridges[1])
    ] * 2


def test_what_the_new_file_does_not_know_is_over() -> None:
    without = EDITED.model_copy(update={"bridges": EDITED.bridges[:1]})
    one = Asking()
    one.fed(until(30.0))
    assert retargeted(one, without) == []
    assert one.engine.waiting() == {}
    assert one.fed(after(30.0)) == []
    stranger = EDITED.model_copy(
        update={"vehicles": (SITE.vehicles[0].model_copy(update={"id": "truck-9"}),)}
    )
    other = Asking({PAIR: DIGEST})
    other.fed(until(7.5))
    retargeted(other, stranger)
    assert other.fed(after(7.5)) == []
    assert other.engine.unknown_vehicles == {"truck-1"}
