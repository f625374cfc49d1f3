"""TOML from anybody costs no more than a site file, and no honest file is refused for that."""

import os
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from schemas import toml_text
from schemas.errors import InputError
from schemas.site_file import load_site, parse_site
from schemas.toml_text import MAX_BYTES, MAX_DEPTH, parse_toml

TEXT = (Path(__file__).parents[2] / "data" / "csv_example" / "site.toml").read_text()


@pytest.fixture
def unparsed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parsing itself would take gigabytes: it must not even begin."""

    def begun(text: str) -> dict[str, Any]:
        raise AssertionError("the parser was begun")

    monkeypatch.setattr(tomllib, "loads", begun)


def complaint(text: str) -> str:
    with pytest.raises(InputError) as caught:
        parse_site(text, "site.toml")
    return str(caught.value)


@pytest.mark.usefixtures("unparsed")
@pytest.mark.parametrize(
    ("text", "output"),
    [
        (".".join(["a"] * 30_000) + " = 1", "line 1: a key is more than 8 deep"),
        ("\n[" + " . ".join(["a"] * 9) + "]", "line 2: a key is more than 8 deep"),
        ("[[ \"a\" . 'b' .c.d.e.f.g.h.i ]]", "line 1: a key is more than 8 deep"),
        ("x = {y = " + ".".join(["a"] * 9) + " = 1}", "line 1: a key is more than 8 deep"),
        ('x = "#"\n' + ".".join(["a"] * 9) + " = 1", "line 2: a key is more than 8 deep"),
        ('x = """\n""""\n' + ".".join(["a"] * 9) + " = 1", "line 3: a key is more than 8 deep"),
        ("x = '''a'''''\n" + ".".join(["a"] * 9) + " = 1", "line 2: a key is more than 8 deep"),
        ('x = "\\\\"\n' + ".".join(["a"] * 9) + " = 1", "line 2: a key is more than 8 deep"),
        ("x = " + "[" * 9, "line 1: is more than 8 deep in brackets"),
        ("x = " + "{a = " * 9, "line 1: is more than 8 deep in brackets"),
        ("[a.b.c]\n" * 1001, "more than 1000 keys of three parts"),
        ("[[bridge]]\n" * 80_000, "more than 150000 tables and lists"),
        ("x = 1\n" * 500_001, "more than 500000 keys"),
        ("#" + "x" * MAX_BYTES, "is larger than 16 MiB"),
        ("#" + "ü" * (MAX_BYTES // 2), "is larger than 16 MiB"),
    ],
)
def test_what_costs_too_much_is_refused_unparsed(text: str, output: str) -> None:
    assert output in complaint(text)


@pytest.mark.parametrize(
    "text",
    [
        "# " + "a." * 50,
        'x = "' + "a." * 50 + '"',
        "x = '" + "a." * 50 + "'",
        'x = """\n' + "a." * 50 + '\n[[[[[[[[[["""',
        "x = '''\n" + "a." * 50 + "\n'''",
        'x = """\\"""' + "a." * 50 + '"""',
        'x = """a""" # [[[[[[[[[[',
        'x = "\\"[[[[[[[[[["',
        'x = "' + "a." * 50 + '\\\\"',
        '"' + "a." * 50 + '" = 1',
        "x = " + "[" * MAX_DEPTH + "1.5" + "]" * MAX_DEPTH,
        ".".join(["a"] * MAX_DEPTH) + " = 1979-05-27T07:32:00.999",
        "x = [1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5]",
        "x = [1,2]\n" * 1 + "".join(f"y{n} = [1]\n" for n in range(100)),
    ],
)
def test_what_only_looks_deep_is_read(text: str) -> None:
    assert parse_toml(text, "x") == tomllib.loads(text)


@given(st.text(alphabet="a.=\"'#\\\n []{}1,", max_size=60))
@example('x = """a""""\ny = 1')
@example("a = ''''b''''")
def test_what_is_toml_and_not_deep_is_never_refused(text: str) -> None:
    """Texts this short are no deeper than eight unless their dots and brackets are so many."""
    try:
        expected = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    if max(text.count("."), text.count("["), text.count("{")) < MAX_DEPTH:
        assert parse_toml(text, "x") == expected


def keys_in(value: Any) -> set[str]:
    """All keys, however deep; what stands in a string is none."""
    if isinstance(value, list):
        return {key for inner in value for key in keys_in(inner)}
    if isinstance(value, dict):
        return set(value) | {key for inner in value.values() for key in keys_in(inner)}
    return set()


@given(
    st.text(alphabet="a=\"'#\\\n []{}1,", max_size=40),
    st.text(alphabet="a=\"'#\\\n []{}1,", max_size=40),
)
@example("", "=1")
@example("a = [{", "=1}]")
@example("1='", "'")
def test_no_string_or_comment_hides_a_deep_key_from_the_check(before: str, after: str) -> None:
    """If the parser would take the deep key for one, so does the check."""
    text = f"{before}{'.'.join(['zz'] * 9)}{after}"
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    if "zz" in keys_in(table):
        with pytest.raises(InputError, match="deep"):
            parse_toml(text, "x")


def test_a_string_that_never_ends_is_gone_through_once() -> None:
    """Every third character could begin a string: none of them may read on to the end again."""
    output = complaint('x = """' + '\\"""' * 400_000)
    assert "is not TOML" in output
    assert "is not TOML" in complaint('x = "' + '\\"' * 400_000)


def test_a_number_of_thousands_of_digits_is_not_an_error_of_ours() -> None:
    assert "is not TOML" in complaint("x = " + "1" * 5000)


def test_thousands_of_bridges_are_read() -> None:
    head, bridge = TEXT[: TEXT.index("[bridge]")], TEXT[TEXT.index("[bridge]") :]
    bridge, tail = bridge[: bridge.index("[sensor]")], bridge[bridge.index("[sensor]") :]
    many = bridge.replace("[bridge]", "[[bridge]]")
    text = head + "".join(many.replace("bridge-x", f"b-{n}") for n in range(5000)) + tail
    assert len(parse_site(text, "x").bridges) == 5000


def test_unknown_fields_and_tables_are_not_counted_without_end() -> None:
    assert "has 101 fields" in complaint("[vehicle]\n" + "".join(f"x{n}=1\n" for n in range(101)))
    assert "has 101 fields" in complaint("".join(f"x{n}=1\n" for n in range(101)))
    assert "has 20001 [[bridge]]" in complaint("[[bridge]]\n" * 20_001)
    values = ", ".join(['"x"'] * 101)
    output = complaint(TEXT.replace("[sensor]", f"element_lengths_m = [{values}]\n[sensor]"))
    assert "[bridge] element_lengths_m has 101 values" in output


def test_a_file_that_is_too_large_or_none_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="is larger than 16 MiB"):
        load_site(path)
    pipe = tmp_path / "pipe.toml"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="is not an ordinary file"):
        load_site(pipe)


def test_lines_of_windows_are_lines(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_bytes(TEXT.replace("\n", "\r\n").encode())
    assert load_site(path) == parse_site(TEXT, "x")


def test_only_one_place_parses_toml() -> None:
    """Another one would let in again what is refused here."""
    root = Path(toml_text.__file__).parents[1]
    users = {
        str(path.relative_to(root))
        for folder in ("schemas", "services", "pre_core")
        for path in (root / folder).rglob("*.py")
        if "tomllib.load" in path.read_text()
    }
    assert users == {"schemas/toml_text.py"}


@pytest.mark.parametrize(
    ("line", "output"),
    [
        ("span_m = 22,0", "22,0 has a decimal comma, TOML has a point: 22.0"),
        ("  span_m=-1,5e3  # m", "-1,5e3 has a decimal comma, TOML has a point: -1.5e3"),
    ],
)
def test_a_decimal_comma_is_named(line: str, output: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_toml(f"[bridge]\nid = 'b'\n{line}\nelements = 5\n", "site.toml")
    assert str(caught.value) == f"site.toml: line 3: is not TOML: {output}"


def test_a_comma_between_values_is_no_decimal_comma() -> None:
    with pytest.raises(InputError, match="line 1, column"):
        parse_toml("pair = 1,2, 3\n", "site.toml")
    assert parse_toml("pair = [1,2]\n", "site.toml") == {"pair": [1, 2]}
