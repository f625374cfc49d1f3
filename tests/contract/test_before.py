"""Files and messages of each version are read today with the same meaning (tests/before.py)."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.before import essentials, fields_of, make, of_files, unpacked

FOLDERS = sorted((Path(__file__).parents[1] / "data" / "before").iterdir())
RELATIVE = 1e-6
"""Between numbers that are computed again from what was read: processors round differently."""


@pytest.fixture(scope="module", params=FOLDERS, ids=lambda folder: folder.name)
def corpus(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the corpus of one version."""
    return unpacked(request.param, tmp_path_factory.mktemp("corpus"))


def different(before: Any, now: Any, where: str = "") -> list[str]:
    """Name what is not as it was; what has been added since is not missing there."""
    if isinstance(before, dict) and isinstance(now, dict):
        return [
            line
            for key, value in before.items()
            for line in different(value, now.get(key), f"{where}.{key}")
        ]
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True))
        return [line for n, (a, b) in pairs for line in different(a, b, f"{where}[{n}]")]
    if isinstance(before, float) and isinstance(now, float | int):
        return [] if now == pytest.approx(before, rel=RELATIVE) else [f"{where}: {before} {now}"]
    return [] if before == now else [f"{where}: {before!r:.100} {now!r:.100}"]


def test_stored_files_keep_their_meaning(corpus: Path) -> None:
    stored = json.loads((corpus / "essentials.json").read_text())
    assert len(stored) > 8, "or it compares nothing"
    assert different(stored, json.loads(json.dumps(essentials(corpus)))) == []


def test_stored_messages_keep_their_meaning(corpus: Path) -> None:
    stored = json.loads((corpus / "messages.json").read_text())
    assert stored["AccelBatch"]["fields"], "or it compares nothing"
    for name, message in stored.items():
        found = fields_of(name, bytes.fromhex(message["payload"]))
        assert different(message["fields"], found, name) == []


def test_lost_changed_and_renamed_values_are_different() -> None:
    before = {"a": [1, 2.0], "b": {"c": "x"}, "d": None}
    assert different(before, before | {"new": 1}) == []
    assert different(before, before | {"a": [1, 2.0 + 1e-7]}) == []
    assert different(before, before | {"a": [1, 2.0 + 1e-5]}) == [".a[1]: 2.0 2.00001"]
    assert different(before, before | {"a": [1]}) == [".a: [1, 2.0] [1]"]
    assert different(before, before | {"a": [2, 2.0]}) == [".a[0]: 1 2"]
    assert different(before, before | {"b": {"e": "x"}}) == [".b.c: 'x' None"]


def test_a_changed_file_is_seen(tmp_path: Path) -> None:
    copied = unpacked(FOLDERS[0], tmp_path)
    stored = json.loads((copied / "essentials.json").read_text())
    site = copied / "paper.toml"
    site.write_text(site.read_text().replace("30.0", "31.0", 1))
    shutil.rmtree(copied / "history/crossings/realm=sim-drive")
    found = different(stored, json.loads(json.dumps(of_files(copied))))
    assert [line for line in found if line.startswith(".sites.paper.toml")]
    assert [line for line in found if line.startswith(".history")]


def test_a_corpus_is_never_written_again() -> None:
    with pytest.raises(SystemExit, match="stays as it is"):
        make(FOLDERS[0])


def test_a_corpus_is_small() -> None:
    for folder in FOLDERS:
        files = [path for path in folder.rglob("*") if path.is_file()]
        assert sum(path.stat().st_size for path in files) < 300_000
