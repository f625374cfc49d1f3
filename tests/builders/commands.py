"""Commands run in this process, as `driveby` runs them in one of its own."""

from typing import NamedTuple

import pytest

from services.cli import main as cli


class Ended(NamedTuple):
    """How a command ended: exit code, standard output, standard error."""

    code: int
    out: str
    err: str


def run(capsys: pytest.CaptureFixture[str], *words: object) -> Ended:
    """Run `driveby WORDS…`; return its exit code and what it printed since the last call."""
    code = cli.main([str(word) for word in words])
    return Ended(code, *capsys.readouterr())
