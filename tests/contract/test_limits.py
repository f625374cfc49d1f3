"""The limits of the code's size, and what is beyond them today.

`EXCEPTIONS` may only shrink. A test fails when something not listed is beyond its limit, when
something listed has grown, when it is within the limit, so that its line has to go, and when it has
no reason. What is renamed or moved keeps its number, or a smaller one.
"""

import ast
import gc
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

# They share the parsed modules with tests/contract/test_words.py.
pytestmark = pytest.mark.xdist_group("parsed modules")

ROOT = Path(__file__).parents[2]
PACKAGES = ("driveby", "pre_core", "schemas", "services", "studies")
ROOMS = ("pre_core", "services", "studies")
"""Packages whose rooms are empty `__init__` files and whose class names are counted together."""
MODULE_LINES = 450
CLASS_LINES = 250
FUNCTION_LINES = 60
"""From `def` to the end, with the docstring and without decorators."""
ARGUMENTS = 7
"""Without `self` and `cls`."""
OFTEN = frozenset({"State", "Info", "Problem"})
"""Class names that each search has for itself."""


class Excess(NamedTuple):
    """What is beyond a limit: its number, and the reason for leaving it so."""

    number: int
    reason: str


EXCEPTIONS: dict[str, dict[str, Excess]] = {
    "lines of a module": {},
    "lines of a class": {},
    "lines of a function": {
        "pre_core.physics.march:march": Excess(
            140,
            "The loop over the steps is one kernel over some thirty local arrays; every part of it "
            "would take most of them as arguments.",
        ),
    },
    "arguments": {
        "services.notebook.simulate:simulate": Excess(
            10,
            "It is public as `driveby.simulate` and has the options of the command, all of them by "
            "keyword.",
        ),
    },
    "statements in a room's __init__": {
        "pre_core": Excess(
            5,
            "Whatever is imported first of it must put off the parts of NumPy that SciPy would "
            "load: a twentieth of a start, and 9 MB.",
        ),
    },
    "classes of one name": {},
}
MOST_EXCEPTIONS = 3
"""Number of exceptions; it may only shrink."""
FEWEST_WORDS = 8
"""Words of a reason."""


class Module(NamedTuple):
    """A module of ours: its dotted name, its text, and the same taken apart."""

    name: str
    text: str
    tree: ast.Module


def module_of(name: str, text: str) -> Module:
    return Module(name, text, ast.parse(text))


@cache
def modules_by_path() -> dict[Path, Module]:
    """Return all modules but the generated ones, which are parsed once for two files of tests."""
    found = {}
    # The trees live to the end: a search for garbage among them takes longer than to make them.
    was_on = gc.isenabled()
    gc.disable()
    try:
        for package in PACKAGES:
            for path in sorted((ROOT / package).rglob("*.py")):
                if not path.stem.endswith("_pb2"):
                    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
                    found[path] = module_of(name, path.read_text())
    finally:
        if was_on:
            gc.freeze()
            gc.enable()
    assert len(found) > 200, "or it looks in the wrong place"
    return found


@pytest.fixture(scope="module")
def modules() -> list[Module]:
    return [*modules_by_path().values()]


def definitions(node: ast.AST, of: str = "") -> Iterator[tuple[str, ast.AST]]:
    """Yield all classes and functions, also those within others, with their qualified names."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = f"{of}{child.name}"
            yield name, child
            yield from definitions(child, f"{name}.")
        else:
            yield from definitions(child, of)


def lines_of(node: ast.AST) -> int:
    assert isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
    assert node.end_lineno is not None
    return node.end_lineno - node.lineno + 1


def arguments_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    by_position = [*function.args.posonlyargs, *function.args.args]
    is_method = bool(by_position) and by_position[0].arg in ("self", "cls")
    return len(by_position) + len(function.args.kwonlyargs) - is_method


def statements_of(tree: ast.Module) -> int:
    """Count the statements of a module other than docstrings."""
    return sum(
        not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant)) for one in tree.body
    )


def measured(modules: list[Module]) -> dict[str, dict[str, int]]:
    """Return everything that is beyond a limit, by limit and name."""
    found: dict[str, dict[str, int]] = {limit: {} for limit in EXCEPTIONS}
    classes: dict[str, int] = defaultdict(int)

    def note(limit: str, name: str, number: int, most: int) -> None:
        if number > most:
            found[limit][name] = number

    for module, text, tree in modules:
        note("lines of a module", module, text.count("\n"), MODULE_LINES)
        if module.endswith(".__init__") and module.split(".")[0] in ROOMS:
            room = module.removesuffix(".__init__")
            note("statements in a room's __init__", room, statements_of(tree), 0)
        for name, node in definitions(tree):
            where = f"{module}:{name}"
            if isinstance(node, ast.ClassDef):
                note("lines of a class", where, lines_of(node), CLASS_LINES)
                classes[node.name] += module.split(".")[0] in ROOMS
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                note("lines of a function", where, lines_of(node), FUNCTION_LINES)
                note("arguments", where, arguments_of(node), ARGUMENTS)
    for name, number in classes.items():
        if name not in OFTEN:
            note("classes of one name", name, number, 1)
    return found


def beyond(found: Mapping[str, int], listed: Mapping[str, Excess]) -> list[str]:
    """Compare what is beyond a limit with the list of what may be."""
    return [
        *(f"{name}: is {found[name]}, beyond the limit" for name in sorted(found.keys() - listed)),
        *(
            f"{name}: has grown from {listed[name].number} to {found[name]}"
            for name in sorted(found.keys() & listed)
            if found[name] > listed[name].number
        ),
        *(
            f"{name}: is within the limit, remove its line"
            for name in sorted(listed.keys() - found)
        ),
    ]


def without_reason(listed: Mapping[str, Excess]) -> list[str]:
    """Return the exceptions whose reason is not a sentence."""
    return [
        name
        for name, (_, reason) in listed.items()
        if len(reason.split()) < FEWEST_WORDS or not reason.endswith(".")
    ]


@pytest.fixture(scope="module")
def of_ours(modules: list[Module]) -> dict[str, dict[str, int]]:
    return measured(modules)


@pytest.mark.parametrize("limit", EXCEPTIONS)
def test_nothing_new_is_beyond_a_limit(limit: str, of_ours: dict[str, dict[str, int]]) -> None:
    assert beyond(of_ours[limit], EXCEPTIONS[limit]) == []


def test_exceptions_are_few_and_have_a_reason() -> None:
    assert sum(map(len, EXCEPTIONS.values())) == MOST_EXCEPTIONS
    assert [name for listed in EXCEPTIONS.values() for name in without_reason(listed)] == []


def test_an_exception_without_a_reason_is_found() -> None:
    sound = "Its parts would share nearly all of their arrays."
    reasons = {"a": "", "b": "It is long.", "c": sound, "d": sound.removesuffix(".")}
    listed = {name: Excess(70, reason) for name, reason in reasons.items()}
    assert without_reason(listed) == ["a", "b", "d"]


def test_a_list_may_only_shrink() -> None:
    listed = {name: Excess(number, "") for name, number in (("a", 70), ("b", 80), ("c", 90))}
    assert beyond({"a": 70, "b": 79, "c": 90}, listed) == []
    assert beyond({"a": 71, "b": 80, "d": 61}, listed) == [
        "d: is 61, beyond the limit",
        "a: has grown from 70 to 71",
        "c: is within the limit, remove its line",
    ]


def test_everything_beyond_a_limit_is_found() -> None:
    long = "".join(f"        a = {n}\n" for n in range(60))
    lines = "".join(f"    b{n} = {n}\n" for n in range(250 - 62))
    code = f'"""Doc."""\n\n\nclass A:\n    def f(self, a, b, c, d, *, e, f, g, h):\n{long}{lines}'
    found = measured(
        [
            module_of("services.room.one", code + "\n" * 300),
            module_of("services.room.__init__", "from a import b\n"),
            module_of("pre_core.__init__", '"""Doc."""\n'),
            module_of("pre_core.two", "class A:\n    class State: ...\n\n\nclass State: ...\n"),
            module_of("schemas.three", "class A: ...\n"),
        ]
    )
    assert found == {
        "lines of a module": {"services.room.one": 553},
        "lines of a class": {},
        "lines of a function": {"services.room.one:A.f": 61},
        "arguments": {"services.room.one:A.f": 8},
        "statements in a room's __init__": {"services.room": 1},
        "classes of one name": {"A": 2},
    }
    longer = measured([module_of("services.room.one", f"{code}    c = 1\n    d = 2\n")])
    assert longer["lines of a class"] == {"services.room.one:A": 252}


HEAVY = ("numba", "zenoh", "rerun", "matplotlib", "scipy", "pydantic", "numpy", "pandas", "xarray")


SELDOM_NEEDED = ("interpolate", "optimize", "signal", "stats")
"""Parts of SciPy that take as long to import as a fifth of a worker's start."""


def test_seldom_needed_parts_of_scipy_are_imported_where_they_are_used(
    modules: list[Module],
) -> None:
    at_once = {
        (module.name, node.module)
        for module in modules
        if not module.name.startswith("studies.")
        for node in module.tree.body
        if isinstance(node, ast.ImportFrom) and node.module
    }
    assert {module for _, module in at_once} > {"scipy.linalg", "scipy.special"}
    names = {f"scipy.{part}" for part in SELDOM_NEEDED}
    assert [one for one in sorted(at_once) if one[1] in names] == []


def printed(code: str) -> str:
    """Run code in a process of its own; return the last line it prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def test_help_does_not_import_the_heavy_libraries() -> None:
    code = (
        "import sys\nfrom services.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        f"print('LOADED', sorted(set({HEAVY!r}) & sys.modules.keys()))"
    )
    assert printed(code) == "LOADED []"


@pytest.mark.parametrize(("given", "loaded"), [(["--help"], []), (["watch", "--help"], ["watch"])])
def test_only_the_command_that_is_parsed_is_imported(given: list[str], loaded: list[str]) -> None:
    code = (
        "import sys\nfrom services.cli.main import main\n"
        f"try:\n    main({given!r})\nexcept SystemExit:\n    pass\n"
        "within = 'services.cli.commands.'\n"
        "print(sorted(n.removeprefix(within) for n in sys.modules if n.startswith(within)))"
    )
    assert printed(code) == str(loaded)


PUT_OFF = {"pre_core": ["numpy.ctypeslib", "numpy.f2py", "numpy.testing"]}
"""Modules of others in whose place importing a package puts something else; may only shrink."""


@pytest.mark.parametrize("package", ["driveby", "pre_core"])
def test_importing_a_package_leaves_the_process_alone(package: str) -> None:
    code = (
        "import gc, os, sys\nimport numpy\n"
        "def now(): return dict(os.environ), gc.get_threshold(), gc.isenabled()\n"
        f"before = now()\nimport {package}\nafter = now()\n"
        "kinds = {name: type(module).__name__ for name, module in sys.modules.items()}\n"
        "lazy = sorted(n for n in kinds if n.startswith('numpy') and 'Lazy' in kinds[n])\n"
        "print(before == after, lazy)"
    )
    assert printed(code) == f"True {PUT_OFF.get(package, [])}"
