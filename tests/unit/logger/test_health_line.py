"""The note of a logger's health on clocks."""

from services.logger.health_line import clock_note, health_line


def test_clocks_that_are_ahead_are_named() -> None:
    figures = {"clock_offset_s/b": -3599.0, "clock_offset_s/a": -0.5, "clock_offset_s/c": 0.1}
    assert clock_note(figures) == "clocks ahead: a by 0.5 s, b by 3599.0 s"


def test_clocks_that_are_behind_are_named() -> None:
    behind = "clocks behind, or all samples late: b by 9.0 s"
    assert clock_note({"clock_offset_s/b": 9.0}) == behind
    both = {"clock_offset_s/a": -0.5, "clock_offset_s/b": 9.0}
    assert clock_note(both) == f"clocks ahead: a by 0.5 s; {behind}"


def test_right_clocks_need_no_note() -> None:
    assert clock_note({"clock_offset_s/a": -0.4, "lag_s": -99.0, "clock_offset_s/b": 1.9}) == ""


def test_one_truck_and_one_file_are_singular() -> None:
    line = health_line({"trucks_alive": 1.0, "files": 1.0, "disk_free_bytes": 5e9})
    assert line.startswith("1 truck, ")
    assert ", 1 open file, " in line
    assert health_line({}).startswith("0 trucks, ")


def test_offsets_of_years_are_in_days() -> None:
    note = clock_note({"clock_offset_s/a": -129_600_000.0, "clock_offset_s/b": 86_400.0})
    assert (
        note == "clocks ahead: a by 1500.0 days; clocks behind, or all samples late: b by 1.0 days"
    )
    assert ", lag 2200.0 days (old samples" in health_line({"lag_s": 190_080_000.0})


def test_unknown_space_is_not_zero() -> None:
    """Before the writer has looked, a logger that had just started had `0.0 GB left`."""
    assert health_line({"files": 2.0}).endswith(", 2 open files")
