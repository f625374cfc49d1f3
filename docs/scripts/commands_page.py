"""The page of commands, made from the parser: `python docs/scripts/commands_page.py` writes it."""

import argparse
from pathlib import Path

from services.cli import main as cli

PAGE = Path(__file__).parents[1] / "commands.md"
_PAGES = {
    "alarm": "alarms.md",
    "catalog": "catalog.md",
    "certs": "security.md",
    "check": "survey.md#is-everything-in-order",
    "cluster": "cluster.md",
    "export": "data.md",
    "fuse": "fusion.md",
    "gateway": "ros2.md",
    "history": "history.md",
    "identify": "method-pre.md",
    "import": "contract.md#csv-import",
    "info": "data.md",
    "logger": "logger.md",
    "replay": "replay.md",
    "report": "report.md",
    "survey": "survey.md",
    "truck": "truck.md",
    "validate": "validation.md",
    "view": "viewer.md",
    "watch": "watch.md",
    "worker": "worker.md",
}
"""Where a command is explained."""

_HEAD = """# Commands

Made by `python docs/scripts/commands_page.py` from the program's own help. Every command explains its options with `--help` and an example; `eval "$(driveby --print-completion bash)"` (or `zsh`) completes commands and options.

Exit codes: 0 done, 1 failed, 2 bad input (`recover`, `identify --into` and `history add` also 3: done, but something is lost). All sockets listen on 127.0.0.1 unless told otherwise; between machines every session proves its identity by a certificate ([security](security.md)).
"""  # noqa: E501 - a paragraph of Markdown is one line


def page() -> str:
    """Return the page: every command with its summary, its options and its own page."""
    lines = [_HEAD, "| command | purpose | options | page |", "| --- | --- | --- | --- |"]
    whole = cli._parser()
    (commands,) = [a for a in whole._actions if isinstance(a, argparse._SubParsersAction)]
    summaries = {a.dest: a.help or "" for a in commands._choices_actions}
    common = _options(whole)
    for name, one in commands.choices.items():
        own = ", ".join(f"`{option}`" for option in _options(one) if option not in common)
        link = f"[{_PAGES[name].split('.')[0]}]({_PAGES[name]})" if name in _PAGES else ""
        lines.append(f"| `driveby {name}` | {summaries[name]} | {own} | {link} |")
    every = [set(one._option_string_actions) for one in commands.choices.values()]
    shared = ", ".join(f"`{option}`" for option in common if all(option in one for one in every))
    return "\n".join([*lines, "", f"Every command also takes {shared}.", ""])


def _options(one: argparse.ArgumentParser) -> list[str]:
    """Return the long names of the options that the help shows."""
    shown = [a for a in one._actions if a.help != argparse.SUPPRESS and a.option_strings]
    return sorted({a.option_strings[-1] for a in shown})


if __name__ == "__main__":
    PAGE.write_text(page())
