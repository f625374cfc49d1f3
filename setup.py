"""How the wheel differs from the checkout: all of it lies inside the package `driveby`.

In the checkout `services`, `schemas` and `pre_core` stand at the top. Installed like that they
would shadow other people's packages of these names. So the build moves them to
`driveby/services`, … and rewrites what names them: imports, and strings that are the name of one
of their modules and nothing else (`python -m services`, `resources.files("services")`). Nothing is
done to an editable installation. All else about the build is in pyproject.toml.

With the variable SOURCE_DATE_EPOCH (`make dist`) the same sources give the same bytes: setuptools
takes the wheel's times from it, and `SameBytes` those of the source archive.
"""

import ast
import gzip
import os
import re
import shutil
import tarfile
from pathlib import Path
from typing import Any

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.egg_info import egg_info
from setuptools.command.sdist import sdist

OUTER = "driveby"
INNER = ("pre_core", "schemas", "services")
MODULE = re.compile(rf"({'|'.join(INNER)})(\.[A-Za-z_]\w*)*")


class BuildInside(build_py):
    """Build as always, then move the inner packages in."""

    def run(self) -> None:
        """Called by setuptools."""
        super().run()
        if self.editable_mode:
            return
        build = Path(self.build_lib)
        for name in INNER:
            inside = build / OUTER / name
            shutil.rmtree(inside, ignore_errors=True)
            (build / name).rename(inside)
        for path in sorted((build / OUTER).rglob("*.py*")):
            if path.suffix in (".py", ".pyi"):
                path.write_bytes(moved_inside(path.read_bytes(), str(path)))


class NamesOnlyOuter(egg_info):
    """Metadata that say what `import` finds."""

    def run(self) -> None:
        """Called by setuptools."""
        super().run()
        Path(self.egg_info, "top_level.txt").write_text(f"{OUTER}\n")


class SameBytes(sdist):
    """Source archive without its builder's names, modes of files and times."""

    def make_archive(self, base_name: str, format: str, **places: Any) -> str:  # noqa: A002 - its name
        """Called by setuptools."""
        if format != "gztar" or "SOURCE_DATE_EPOCH" not in os.environ:
            return str(super().make_archive(base_name, format, **places))
        seconds = int(os.environ["SOURCE_DATE_EPOCH"])

        def anonymous(member: tarfile.TarInfo) -> tarfile.TarInfo:
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mode = 0o755 if member.isdir() else 0o644
            member.mtime = seconds
            return member

        archive = Path(f"{base_name}.tar.gz")
        archive.parent.mkdir(parents=True, exist_ok=True)
        with (
            archive.open("wb") as file,
            gzip.GzipFile("", "wb", fileobj=file, mtime=seconds) as packed,
            tarfile.open(fileobj=packed, mode="w") as tar,
        ):
            tar.add(places["base_dir"], filter=anonymous)  # in the order of names
        return str(archive)


def moved_inside(source: bytes, name: str) -> bytes:
    """The source with every mention of an inner module preceded by `driveby.`.

    SyntaxError for `import services.x` without `as`: it would bind another name.
    """
    lines = source.splitlines(keepends=True)
    places: list[tuple[int, int]] = []
    for node in ast.walk(ast.parse(source, name)):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and _is_inner(node.module):
            line = lines[node.lineno - 1]
            keyword = re.compile(rb"from\s+").match(line, node.col_offset)
            if keyword is None:
                raise SyntaxError(f"{name}:{node.lineno}: from and the module on one line expected")
            places.append((node.lineno, keyword.end()))
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if _is_inner(alias.name) and alias.asname is None:
                    raise SyntaxError(f"{name}:{node.lineno}: import {alias.name} as … expected")
                if _is_inner(alias.name):
                    places.append((alias.lineno, alias.col_offset))
        elif isinstance(node, ast.Constant) and _is_inner(node.value):
            line = lines[node.lineno - 1]
            quote = re.compile(rb"[A-Za-z]*(\"\"\"|'''|\"|')").match(line, node.col_offset)
            if quote is None:  # a part of an f-string
                raise SyntaxError(f"{name}:{node.lineno}: {node.value} as a string of its own")
            places.append((node.lineno, quote.end()))
    for number, column in sorted(places, reverse=True):
        line = lines[number - 1]
        lines[number - 1] = line[:column] + OUTER.encode() + b"." + line[column:]
    return b"".join(lines)


def _is_inner(name: object) -> bool:
    return isinstance(name, str) and MODULE.fullmatch(name) is not None


if __name__ == "__main__":
    setup(cmdclass={"build_py": BuildInside, "egg_info": NamesOnlyOuter, "sdist": SameBytes})
