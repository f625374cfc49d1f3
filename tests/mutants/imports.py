"""Who imports whom, among the project's own modules and tests."""

import ast
from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path

Imports = Mapping[str, frozenset[str]]
"""By file, relative to the project: the files that it imports."""


def imports_of(project: Path, files: Iterable[str]) -> Imports:
    """Read every file's imports, those inside of functions too."""
    modules = {module_of(file): file for file in files}
    return {file: _imported(project / file, modules) for file in modules.values()}


def module_of(file: str) -> str:
    return file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _imported(path: Path, modules: Mapping[str, str]) -> frozenset[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            below = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in modules else node.module for name in below]
        found.update(modules[name] for name in names if name in modules)
    return frozenset(found)


def distances_to(imports: Imports, target: str) -> dict[str, int]:
    """How many imports every file that reaches `target` is away from it."""
    importers: dict[str, list[str]] = {}
    for file, imported in imports.items():
        for one in imported:
            importers.setdefault(one, []).append(file)
    distances = {target: 0}
    queue = deque([target])
    while queue:
        file = queue.popleft()
        for importer in importers.get(file, []):
            if importer not in distances:
                distances[importer] = distances[file] + 1
                queue.append(importer)
    return distances
