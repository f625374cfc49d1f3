"""The repository's pages: links lead somewhere, every command named is there."""

import re
import tomllib
from pathlib import Path

import pytest

from schemas.site_file import load_site

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").glob("**/*.md"),
        *(ROOT / "studies").glob("**/*.md"),
        ROOT / "recordings/README.md",
    ]
)


def slug(heading: str) -> str:
    """The anchor that a heading gets on a repository page."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith(("http://", "https://")):
            continue
        name, _, anchor = target.partition("#")
        file = page if not name else page.parent / name
        assert file.exists(), f"{page.name} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", file.read_text(), re.MULTILINE)
            assert anchor in {slug(heading) for heading in headings}, f"no heading for {target}"


def test_commands_page_has_every_command() -> None:
    page = (ROOT / "docs/commands.md").read_text()
    assert len(re.findall(r"^\| `driveby [a-z]+` \|", page, re.MULTILINE)) >= 25


def test_example_site_file_is_accepted() -> None:
    site = load_site(ROOT / "docs/site.example.toml")
    assert site.bridges[0].elements == 7


def test_ci_runs_the_commands_of_the_readme() -> None:
    script = ROOT / ".ci/run"
    assert script.stat().st_mode & 0o111
    assert "make test" in script.read_text()
    assert "make test" in (ROOT / "README.md").read_text()


def test_tests_that_pages_name_are_there() -> None:
    paths = [*(ROOT / "tests").glob("**/*.py")]
    tests = {name for path in paths for name in re.findall(r"def (test_\w+)", path.read_text())}
    files = {str(path) for path in paths}
    named = 0
    for page in PAGES:
        for name, is_begun in re.findall(r"`(test_\w+)(…?)`", page.read_text()):
            named += 1
            assert name in tests or (is_begun and any(one.startswith(name) for one in tests)), name
        for name in re.findall(r"`(?:tests/)?((?:\w+/)*test_\w+\.py)`", page.read_text()):
            named += 1
            assert any(file.endswith(f"/{name}") for file in files), name
    assert named > 50, "or it looks in the wrong place"


def test_version_is_the_same_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {project['version']}\n" in citation
    assert f"\nlicense: {project['license']}\n" in citation


def test_table_of_checks_names_what_alike_axles_do_to_a_crossing() -> None:
    """`wrong` alone leaves open whether the crossings of such a truck count."""
    page = (ROOT / "docs/survey.md").read_text()
    (row,) = re.findall(r"^\| axle loads \|.*", page, re.MULTILINE)
    assert "(verdicts.md#after-a-fit)" in row
    assert "`axles_alike`" in row
    assert "not fused" in row


def test_guide_links_comparison_and_realms_where_results_are_made() -> None:
    guide = (ROOT / "docs/engineer.md").read_text()
    step = guide.partition("## 5. Identify")[2].partition("\n## ")[0]
    assert "(survey.md#comparison-a-year-later)" in step
    assert "(contract.md#csv-import)" in step
