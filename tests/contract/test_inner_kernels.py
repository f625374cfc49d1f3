"""Kernels without a wrapper for Python, which ends with a crash if Python calls them."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

KERNELS = {"compiled", "exact", "kernel", "summing"}
INNER = {"inner", "inner_exact", "_inner"}
PACKAGES = re.compile(r"pre_core\.(crossing|kernels|paper|physics)|two_sided_march")
"""Packages with inner kernels; a module that names none of them calls none."""
FOLDERS = ("driveby", "pre_core", "services", "studies", "docs", "tests")


def decorators(function: ast.FunctionDef) -> set[str]:
    calls = (one.func if isinstance(one, ast.Call) else one for one in function.decorator_list)
    return {one.id for one in calls if isinstance(one, ast.Name)}


def functions(tree: ast.Module, names: set[str]) -> Iterator[ast.FunctionDef]:
    """Yield the functions of a module that have one of these decorators."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and decorators(node) & names:
            yield node


def full_names(tree: ast.Module, module: str) -> dict[str, str]:
    """Return the full name of each name that a module imports or defines."""
    found = {
        node.name: f"{module}.{node.name}"
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found |= {one.asname or one.name: f"{node.module}.{one.name}" for one in node.names}
    return found


def outside(tree: ast.Module, module: str, inner: set[str]) -> list[str]:
    """Return the inner kernels that a module names elsewhere than in a kernel."""
    known = full_names(tree, module)
    kernels = list(functions(tree, KERNELS | INNER))
    inside = {id(node) for kernel in kernels for node in ast.walk(kernel)}
    found = []
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(value=ast.Name(id=package), attr=attribute):
                name = f"{known.get(package)}.{attribute}"
            case ast.Name(id=short):
                name = known.get(short, "")
            case _:
                continue
        if name in inner and id(node) not in inside:
            found.append(f"{module}: {name}")
    return found


@pytest.fixture(scope="module")
def modules(project: Path) -> dict[str, ast.Module]:
    paths = (path for folder in FOLDERS for path in (project / folder).rglob("*.py"))
    texts = {path: path.read_text() for path in paths}
    return {
        ".".join(path.relative_to(project).with_suffix("").parts): ast.parse(text)
        for path, text in texts.items()
        if PACKAGES.search(text)
    }


def test_only_kernels_call_inner_kernels(modules: dict[str, ast.Module]) -> None:
    inner = {
        f"{module}.{function.name}"
        for module, tree in modules.items()
        for function in functions(tree, INNER)
    }
    assert "pre_core.crossing.tandem.wheels" in inner
    assert [call for module, tree in modules.items() for call in outside(tree, module, inner)] == []


@pytest.mark.parametrize(
    "text",
    [
        "from pre_core.crossing.tandem import wheels\nwheels()\n",
        "from pre_core.crossing import tandem as t\ndef f():\n    t.wheels()\n",
    ],
)
def test_a_call_from_python_is_found(text: str) -> None:
    inner = {"pre_core.crossing.tandem.wheels"}
    assert len(outside(ast.parse(text), "tests.example", inner)) == 1
