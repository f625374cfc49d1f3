"""Messages of a file, grouped by truck and boot."""

from schemas.topics import Key, Message
from services.finding.drive import DriveMessages, Drives, drives_of
from tests.unit.drives.recorded import START_NS, drive

DRIVE = list(drive())


def named(message: Message, **changes: object) -> Message:
    return message._replace(key=message.key._replace(**changes))  # type: ignore[arg-type]


def test_each_boot_of_each_truck_in_each_realm_is_a_drive() -> None:
    again = [m._replace(boot_id=m.boot_id + 1) for m in DRIVE]
    other = [named(m, identifier="truck-2") for m in DRIVE]
    replayed = [named(m, realm="replay-x") for m in DRIVE]
    (one,) = drives_of(DRIVE)
    found = drives_of([*DRIVE, *again, *other, *replayed])
    assert [(d.realm, d.vehicle, d.boot_id - one.boot_id) for d in found] == [
        (one.realm, "truck-1", 0),
        (one.realm, "truck-1", 1),
        (one.realm, "truck-2", 0),
        ("replay-x", "truck-1", 0),
    ]
    assert {len(d.fixes) for d in found} == {len(one.fixes)}


def test_messages_are_in_their_order_and_count_once_whatever_order_they_came_in() -> None:
    (one,) = drives_of(DRIVE)
    (other,) = drives_of([*reversed(DRIVE), *DRIVE])
    assert [b.sequence for b in other.batches()] == [b.sequence for b in one.batches()]
    assert other.fixes_in_order() == one.fixes_in_order()
    assert one.fixes_in_order()[0].wall_time_ns >= START_NS


def test_what_cannot_be_decoded_is_left_out_but_its_truck_is_known() -> None:
    fix = next(m for m in DRIVE if m.key.stream == "gnss")
    drives = Drives()
    assert not drives.add(fix._replace(payload=b"\xff"))
    assert not drives.add(fix._replace(key=Key(fix.key.realm, "bridge", "b", "state")))
    assert drives.all() == [DriveMessages(fix.key.realm, "truck-1", fix.boot_id, {}, {})]
    assert drives.add(fix)
    assert [list(d.fixes) for d in drives.all()] == [[fix.sequence]]


def test_no_more_batches_are_decoded_than_are_wanted() -> None:
    batches = [m for m in DRIVE if m.key.stream == "accel"]
    broken = batches[0]._replace(payload=b"\xff")
    drives = Drives(most_batches=1)
    assert [drives.add(m) for m in (broken, *batches[1:4])] == [False, True, False, False]
    assert [list(d.accelerations) for d in drives.all()] == [[batches[1].sequence]]
