"""Docstrings of the fields of public NamedTuples, where `help()` finds them."""

import inspect
from typing import TypeVar

from schemas.field_docs import field_docs

Class = TypeVar("Class", bound=type)


def with_field_docs(named_tuple: Class) -> Class:
    """Let `help()` show the string below each field of a NamedTuple.

    Without its source, as in a frozen program, the fields keep Python's own docstrings.
    """
    try:
        docs = list(field_docs(named_tuple))
    except (OSError, TypeError):
        return named_tuple
    for name, doc in docs:
        getattr(named_tuple, name).__doc__ = inspect.cleandoc(doc)
    return named_tuple
