"""Former spellings of options are accepted for good; help and pages show today's."""

import pytest

from services.cli import main as cli
from services.common.errors import InputError

SAME = [
    ("validate --method pre --worlds 3", "validate --method pre --out-of-model 3"),
    ("validate --certificates d", "validate --validations d"),
    ("identify a.mcap --certificates d", "identify a.mcap --validations d"),
    ("worker --site s --certificates=d", "worker --site s --validations=d"),
    ("worker --site s --no-certificates", "worker --site s --skip-validation"),
    ("worker --site s --limit 5", "worker --site s --cpu-limit 5"),
    ("alarm check --learning 9", "alarm check --training 9"),
    ("history add r --later", "history add r --defer-fusion"),
    ("--verbose identify a.mcap --patience 7", "--verbose identify a.mcap --reconnect-timeout 7"),
    ("import d --site s -o x --name n", "import d --site s -o x --realm n"),
    (
        "simulate --scenario 6 --left 3e5:17:0.1 -o x",
        "simulate --scenario 6 --departed-vehicle 3e5:17:0.1 -o x",
    ),
]


@pytest.mark.parametrize(("former", "current"), SAME)
def test_former_spelling_parses_as_the_current_one(former: str, current: str) -> None:
    parse = cli._parser().parse_args
    expected = vars(parse(current.split()))
    found = vars(parse(former.split()))
    del expected["parser"], found["parser"]
    assert found == expected


def test_help_shows_no_former_spelling(capsys: pytest.CaptureFixture[str]) -> None:
    for former, current in SAME:
        words = former.removeprefix("--verbose ").split()
        with pytest.raises(SystemExit):
            cli.main([words[0], "--help"])
        shown = capsys.readouterr().out
        current_words = {one.split("=")[0] for one in current.split()}
        (old,) = {one.split("=")[0] for one in words} - current_words
        assert f"{old} " not in shown
        assert f"{old}\n" not in shown


def test_arguments_behind_two_dashes_stay() -> None:
    options = cli._parser().parse_args(["history", "--", "--later"])
    assert options.words == ["--later"]
    assert not options.defer_fusion


def test_other_commands_keep_their_options() -> None:
    with pytest.raises(
        InputError, match=r"unrecognized arguments: --limit \(see driveby view --help"
    ):
        cli._parser().parse_args(["view", "a.mcap", "--limit"])


def test_values_that_are_called_like_a_command_are_none() -> None:
    """The spool may be a folder `worker`: `truck` has no `--cpu-limit` for all that."""
    with pytest.raises(InputError, match="unrecognized arguments: --limit"):
        cli._parser().parse_args(["truck", "a.mcap", "--spool", "worker", "--limit", "5"])
