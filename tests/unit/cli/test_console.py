"""The console of commands."""

import pytest

from services.cli.parsing import a_console


def test_no_sentence_is_wrapped_in_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    """A number and its unit were on two lines of a log, at the 80th column."""
    sentence = "overall stiffness: 0.96 ± 0.03 of nominal; " * 5
    a_console().print(sentence, highlight=False)
    assert capsys.readouterr().out == f"{sentence}\n"
