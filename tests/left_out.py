"""Summary of what a test run left out, by cause, and how to include it."""

from collections import Counter
from typing import Any

import pytest

COMMANDS = {
    "soak": "make soak",
    "faults": "make faults",
    "containers": "make containers",
    "slow": "make test-all",
}
"""Command that runs the tests of each mark; the first mark that a test has decides."""
REMEDIES = {
    "Vulkan": "apt install mesa-vulkan-drivers libvulkan1",
    "browser": "apt install chromium",
    "mkdocs": "make docs",
    "bash is not": "apt install bash",
    "fish is not": "apt install fish",
    "zsh is not": "apt install zsh",
    "tmpfs": "run as root",
    "root may": "run as another user than root",
    "for containers": "sh tests/containers/engine.sh start; sh tests/containers/images.sh",
    "../shared": "reference data, not in the repository",
}
"""Remedy of each reason to skip, by a part of the reason."""
_DESELECTED = pytest.StashKey[Counter[str]]()
_SENT = "deselected_by_mark"


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_DESELECTED] = Counter()


def pytest_deselected(items: list[pytest.Item]) -> None:
    for item in items:
        marks = [mark for mark in COMMANDS if item.get_closest_marker(mark)]
        if marks:
            item.config.stash[_DESELECTED][marks[0]] += 1


def pytest_sessionfinish(session: pytest.Session) -> None:
    """With pytest-xdist every worker collects the same tests and reports to the controller."""
    sent = getattr(session.config, "workeroutput", None)
    if sent is not None:
        sent[_SENT] = dict(session.config.stash[_DESELECTED].items())


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    sent = getattr(node, "workeroutput", {}).get(_SENT, {})
    node.config.stash[_DESELECTED] |= Counter(sent)


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    lines = summary(
        [report.longrepr[2] for report in terminalreporter.getreports("skipped")],
        config.stash[_DESELECTED],
    )
    if lines:
        terminalreporter.section("left out")
        for line in lines:
            terminalreporter.write_line(line)


def summary(reasons: list[str], deselected: Counter[str]) -> list[str]:
    """Return one line for each cause, the most frequent first."""
    causes = Counter(reason.removeprefix("Skipped: ") for reason in reasons)
    lines = [f"{count} skipped: {cause}{remedy(cause)}" for cause, count in causes.most_common()]
    for mark, count in deselected.most_common():
        lines.append(f"{count} deselected: marked {mark} ({COMMANDS[mark]})")
    return lines


def remedy(cause: str) -> str:
    """Return the remedy in brackets, or nothing if the cause contains it or none is known."""
    for part, command in REMEDIES.items():
        if part in cause and command not in cause:
            return f" ({command})"
    return ""
