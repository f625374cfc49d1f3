"""Docstrings of fields: the string below each field of a class, as in its source."""

import ast
import inspect
from collections.abc import Iterator
from itertools import pairwise


def field_docs(owner: type) -> Iterator[tuple[str, str]]:
    """Yield the name of each field of a class that has a string below it, and that string.

    Fields of its bases are not among them. Raise OSError or TypeError without its source, as in a
    frozen program.
    """
    (definition,) = ast.parse(inspect.cleandoc(f"\n{inspect.getsource(owner)}")).body
    assert isinstance(definition, ast.ClassDef)  # noqa: S101 - the source of a class
    for field, below in pairwise(definition.body):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(doc))),
            ):
                yield name, doc
