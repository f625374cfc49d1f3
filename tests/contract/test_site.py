"""The pages as a site (`make docs`), and the snippets of its own pages."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import driveby
from schemas.results import ResultHeader
from schemas.results_on_the_wire import crossing_to_protobuf
from schemas.site_file import load_site
from schemas.topics import Key, Message
from services.recordings.writer import write_recording
from tests.unit.viewer.found import results_of, some_crossing

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("mkdocs is not installed (make docs)")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", folder],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    return folder


def test_the_site_is_built_and_every_page_is_in_it(site: Path) -> None:
    pages = {path.stem for path in site.glob("*.html")}
    assert {path.stem for path in (ROOT / "docs").glob("*.md")} <= pages
    assert {"index", "api", "messages", "ARCHITECTURE", "CONTRIBUTING", "CHANGELOG"} <= pages
    api = (site / "api.html").read_text()
    assert all(f'id="{name.lower()}"' in api for name in driveby.__all__)
    messages = re.sub(r"<[^>]+>", "", (site / "messages.html").read_text())
    for name in re.findall(r"^message (\w+)", definition(), re.MULTILINE):
        assert f"message {name}" in messages


def test_pages_of_examples_link_to_pages_of_the_site(site: Path) -> None:
    page = (site / "examples" / "sqlite" / "index.html").read_text()
    assert 'href="../../index.html#live"' in page
    assert 'href="../../contract.html"' in page
    assert (site / "examples" / "two_spans" / "site.toml").is_file()


def test_the_site_loads_nothing_from_elsewhere(site: Path) -> None:
    for page in site.glob("*.html"):
        loaded = re.findall(
            r'<(?:script|link|img|iframe)[^>]+(?:src|href)="([^"]+)"', page.read_text()
        )
        assert [url for url in loaded if url.startswith(("http", "//"))] == [], page.name


def definition() -> str:
    return (ROOT / "schemas/proto/driveby.proto").read_text()


def decoded(recording: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, ROOT / "docs/examples/decode_estimate.py", recording],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("size", [4, 100, -1000, -1])
def test_the_example_names_a_recording_without_end(tmp_path: Path, size: int) -> None:
    """The results of a worker that still runs have none."""
    sample = (ROOT / "recordings/sample/crossing.mcap").read_bytes()
    path = tmp_path / "r.mcap"
    path.write_bytes(sample[:size])
    found = decoded(path)
    assert found.returncode == 1
    assert found.stderr == (
        f"{path}: has no end yet, or was cut off (driveby recover completes it)\n"
    )


def test_the_example_decodes_an_estimate(tmp_path: Path) -> None:
    known = load_site(ROOT / "docs/site.example.toml")
    (found,) = results_of(known, some_crossing("a")).crossings
    payload = crossing_to_protobuf(found, ResultHeader("0", 1.79e9, "0" * 16, {}, 0))
    key = Key("live", "bridge", "bridge-1", "estimate")
    now = 1_790_000_000_000_000_000
    message = Message(key, payload.SerializeToString(), 1, 0, now, now)
    write_recording(tmp_path / "r.mcap", [message], site_toml=None, reason="test")
    output = decoded(tmp_path / "r.mcap").stdout
    assert output.startswith("a GOOD\n")
    assert "  EI_4 6.24e+09 (5.884e+09 to 6.614e+09) N·m²\n" in output
    assert output.count("\n") == 8
