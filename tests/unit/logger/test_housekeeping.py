"""What the logger reports of recordings that an earlier run left open."""

from pathlib import Path

from services.logger.housekeeping import recovery_text

FOUND = {"messages": 120, "damaged_bytes": 0}


def test_missing_end_of_a_file_is_no_loss_yet() -> None:
    text = recovery_text(Path("live/truck-1.mcap"), FOUND | {"lost": None})
    assert text.startswith("truck-1.mcap was cut off; 120 messages recovered to ")
    assert "the end of the file is missing" in text
    assert text.endswith("from the trucks again count as missing or lost")
    assert "unknown number lost" not in text


def test_known_loss_is_a_number() -> None:
    text = recovery_text(Path("live/truck-1.mcap"), FOUND | {"lost": 0})
    assert text.endswith("truck-1.recovered.mcap, 0 bytes damaged, 0 lost")
