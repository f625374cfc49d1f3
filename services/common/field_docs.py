"""Docstrings of the fields of public NamedTuples, where `help()` finds them."""

import ast
import inspect
from itertools import pairwise
from typing import TypeVar

Class = TypeVar("Class", bound=type)


def with_field_docs(named_tuple: Class) -> Class:
    """Let `help()` show the string below each field of a NamedTuple.

    Without its source, as in a frozen program, the fields keep Python's own docstrings.
    """
    try:
        text = inspect.cleandoc(f"\n{inspect.getsource(named_tuple)}")
    except (OSError, TypeError):
        return named_tuple
    (definition,) = ast.parse(text).body
    assert isinstance(definition, ast.ClassDef)  # noqa: S101 - the source of a class
    for field, below in pairwise(definition.body):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(doc))),
            ):
                getattr(named_tuple, name).__doc__ = inspect.cleandoc(doc)
    return named_tuple
