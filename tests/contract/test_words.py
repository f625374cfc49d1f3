"""The language of the code: docstrings, names and shapes, beyond what ruff checks."""

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.contract.test_limits import ROOT, Module, definitions, module_of, modules_by_path

# They share the parsed modules with tests/contract/test_limits.py.
pytestmark = pytest.mark.xdist_group("parsed modules")

FIRST_WORDS = ("Of", "That", "So", "Who", "Whoever", "By", "What", "How", "As", "Less")
NOT_A_VERB_FOR_CODE = re.compile(r"(?<![a-z])(told|tells?|telling)(?![a-z])", re.IGNORECASE)
OF_FILES = re.compile(r"\.tell\b|def tell\b")
"""The position in a file keeps its name, as in `io`."""
ARRAY = re.compile(r"\b(FloatArray|NDArray|Floats|IntArray|BoolArray|ComplexArray)\b")
SHAPE = re.compile(r"\([\w…+ -]{1,12},([\w…+, -]{1,40})?\)|\(…\)|\bshape\b")


@pytest.fixture(scope="module")
def modules() -> list[Module]:
    """Our modules, without those that a compiler wrote."""
    return [
        module._replace(name=path.relative_to(ROOT).as_posix())
        for path, module in modules_by_path().items()
    ]


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the text behind every definition, fields and constants included, with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            for child in node.body:
                if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                    yield child.lineno, str(child.value.value)


def bad_summaries(module: Module) -> list[str]:
    """Return the docstrings that begin without a head."""
    return [
        f"{module.name}:{line}: {text.strip().splitlines()[0]}"
        for line, text in docstrings(module.tree)
        if re.split(r"\W", text.strip(), maxsplit=1)[0] in FIRST_WORDS
    ]


def tellings(module: Module) -> list[str]:
    """Return the names, comments and docstrings in which code tells, rather than does something."""
    if not NOT_A_VERB_FOR_CODE.search(module.text):
        return []
    prose = {line for line, _ in docstrings(module.tree)}
    found = []
    for token in tokenize.generate_tokens(io.StringIO(module.text).readline):
        is_prose = token.type == tokenize.STRING and token.start[0] in prose
        if not is_prose and token.type not in (tokenize.NAME, tokenize.COMMENT):
            continue
        if NOT_A_VERB_FOR_CODE.search(token.string) and not OF_FILES.search(token.line):
            found.append(f"{module.name}:{token.start[0]}: {token.string.strip()[:80]}")
    return found


def shapeless(module: Module) -> list[str]:
    """Return the public functions of arrays whose docstring names no shape."""
    found = []
    inside = {
        inner
        for _, node in definitions(module.tree)
        if isinstance(node, ast.FunctionDef)
        for _, inner in definitions(node)
    }
    for name, node in definitions(module.tree):
        is_public = not re.search(r"(^|\.)_", name) and node not in inside
        if not isinstance(node, ast.FunctionDef) or not is_public:
            continue
        every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        types = [one.annotation for one in every] + [node.returns]
        has_arrays = any(one is not None and ARRAY.search(ast.unparse(one)) for one in types)
        if has_arrays and not SHAPE.search(ast.get_docstring(node) or ""):
            found.append(f"{module.name}:{node.lineno}: {name}")
    return found


def repeated_names(modules: list[Module]) -> list[str]:
    """Return the classes whose public name another class of these modules has, too."""
    public = [
        (module.name, node.name)
        for module in modules
        for node in module.tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    names = Counter(name for _, name in public)
    return [f"{module}: {name}" for module, name in public if names[name] > 1]


def test_no_summary_begins_without_a_head(modules: list[Module]) -> None:
    assert [line for module in modules for line in bad_summaries(module)] == []


def test_code_avoids_the_verb_tell(modules: list[Module]) -> None:
    # Modules without the verb need not be parsed.
    laboratory = [
        module_of(path.relative_to(ROOT).as_posix(), text)
        for folder in ("tests", "studies")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if path != Path(__file__) and NOT_A_VERB_FOR_CODE.search(text := path.read_text())
    ]
    assert [line for module in (*modules, *laboratory) for line in tellings(module)] == []


def test_public_classes_have_names_of_their_own(modules: list[Module]) -> None:
    assert repeated_names(modules) == []


def test_functions_of_arrays_name_shapes(modules: list[Module]) -> None:
    ours = [module for module in modules if module.name.startswith("pre_core/")]
    assert [line for module in ours for line in shapeless(module)] == []


def test_what_the_rules_are_about_is_found() -> None:
    text = '''"""Of a room."""
told = 1  # who is told
satellite = file.tell()


class A:
    """A class."""

    field: int
    """Who."""

    def f(self, a: FloatArray) -> None:
        """Return a value."""

    def g(self, a: FloatArray) -> None:
        """Return a value of `a` (n,)."""
'''
    module = module_of("pre_core/a.py", text)
    assert bad_summaries(module) == ["pre_core/a.py:1: Of a room.", "pre_core/a.py:10: Who."]
    assert tellings(module) == ["pre_core/a.py:2: told", "pre_core/a.py:2: # who is told"]
    assert shapeless(module) == ["pre_core/a.py:12: A.f"]
    assert repeated_names([module]) == []
    assert repeated_names([module, module]) == ["pre_core/a.py: A"] * 2
