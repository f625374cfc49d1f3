"""Files that a host of repositories reads: workflows, issue forms, hooks, policy, citation."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
FOLDER = ROOT / ".github/ISSUE_TEMPLATE"
FORMS = sorted(set(FOLDER.glob("*.yml")) - {FOLDER / "config.yml"})
MATRIX = re.compile(r"\$\{\{ matrix\.(\w+) \}\}")


def loaded(path: Path) -> dict[Any, Any]:
    content = yaml.safe_load(path.read_text())
    assert isinstance(content, dict)
    return content


def rules() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


def commands_of(job: dict[str, Any]) -> list[str]:
    """Return the shell commands of a job, once for each entry of its matrix."""
    found = []
    for step in job["steps"]:
        assert ("run" in step) != ("uses" in step), step
        if "run" in step:
            named = MATRIX.search(step["run"])
            values = job["strategy"]["matrix"][named[1]] if named else [""]
            found += [MATRIX.sub(value, step["run"]) for value in values]
    return found


def test_repository_has_workflows_and_forms() -> None:
    assert {path.stem for path in WORKFLOWS} >= {"tests", "nightly", "release"}
    assert len(FORMS) >= 2


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflow_runs_one_make_target_a_step(path: Path) -> None:
    for job in loaded(path)["jobs"].values():
        for command in commands_of(job):
            made = re.fullmatch(r"make ([a-z-]+)", command)
            assert made is not None, command
            assert made[1] in rules(), command


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflow_is_bounded_and_declared_untried(path: Path) -> None:
    workflow = loaded(path)
    assert "# This workflow has not yet been run by GitHub.\n" in path.read_text()
    assert workflow["permissions"] == {"contents": "read"}
    for job in workflow["jobs"].values():
        assert 0 < job["timeout-minutes"] <= 360
        for step in job["steps"]:
            assert "@" in step.get("uses", "@"), step


def test_release_publishes_what_make_dist_built_without_secret() -> None:
    jobs = loaded(ROOT / ".github/workflows/release.yml")["jobs"]
    assert commands_of(jobs["build"])[-1] == "make dist"
    uploaded = next(s for s in jobs["build"]["steps"] if "upload" in s.get("uses", ""))
    assert uploaded["with"]["path"] == "build/dist"
    assert jobs["publish"]["needs"] == "build"
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    assert commands_of(jobs["publish"]) == []
    assert "secrets." not in (ROOT / ".github/workflows/release.yml").read_text()


def test_workflows_run_what_ci_script_runs() -> None:
    jobs = loaded(ROOT / ".github/workflows/tests.yml")["jobs"].values()
    run = {command for job in jobs for command in commands_of(job)}
    script = (ROOT / ".ci/run").read_text()
    assert set(re.findall(r"^make [a-z-]+$", script, re.MULTILINE)) <= run


def test_matrix_starts_at_lowest_python_that_the_project_allows() -> None:
    versions = loaded(ROOT / ".github/workflows/tests.yml")["jobs"]["tests"]["strategy"]["matrix"]
    lowest = re.search(r'requires-python = ">=([\d.]+)"', (ROOT / "pyproject.toml").read_text())
    assert lowest is not None
    assert versions["python"][0] == lowest[1]
    assert len(versions["python"]) >= 3


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_form_asks_for_info_and_site_file(path: Path) -> None:
    form = loaded(path)
    assert {"name", "description", "body"} <= form.keys()
    fields = {field["id"]: field for field in form["body"] if "id" in field}
    assert len(fields) == sum(field["type"] != "markdown" for field in form["body"])
    for name, text in (("info", "driveby info"), ("site", "Site file"), ("version", "--version")):
        assert text in fields[name]["attributes"]["label"]
        assert fields[name]["validations"] == {"required": True}


def test_hooks_run_the_tools_of_make_lint() -> None:
    (repository,) = loaded(ROOT / ".pre-commit-config.yaml")["repos"]
    assert repository["repo"] == "local", "nothing is fetched"
    hooks = [hook["entry"].removesuffix(" --force-exclude") for hook in repository["hooks"]]
    lint = re.search(r"^lint:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert lint is not None
    lines = lint[1].replace("$(BIN)", ".venv/bin").splitlines()
    assert hooks == [line.strip().removesuffix(" .") for line in lines]


def test_security_policy_names_reporting_and_support() -> None:
    policy = (ROOT / "SECURITY.md").read_text()
    assert "## Reporting a vulnerability" in policy
    assert "## Supported versions" in policy
    assert "(docs/security.md#what-is-not-protected)" in policy


def test_version_has_one_source() -> None:
    """`pyproject.toml`; the program reads it from its metadata, the citation is compared."""
    sources = [
        path for name in ("driveby", "services", "schemas") for path in ROOT.glob(f"{name}/**/*.py")
    ]
    literal = re.compile(r"^__version__\s*(:.*)?=", re.MULTILINE)
    assert [path.name for path in sources if literal.search(path.read_text())] == []
