"""Checks of arguments: a wrong one is an InputError of one line that names it."""

import inspect
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from operator import index
from os import PathLike
from pathlib import Path
from typing import Final, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from services.common.errors import InputError

_Arguments = ParamSpec("_Arguments")
_Found = TypeVar("_Found")

_SHOWN: Final = 40
"""Largest number of characters of a value in a message."""


def known_arguments(
    hint: str = "",
) -> Callable[[Callable[_Arguments, _Found]], Callable[_Arguments, _Found]]:
    """Return a decorator by which unknown, missing and repeated arguments raise InputError.

    `hint` states where else an unknown argument may belong.
    """

    def decorated(function: Callable[_Arguments, _Found]) -> Callable[_Arguments, _Found]:
        signature = inspect.signature(function)
        known = ", ".join(signature.parameters)

        @wraps(function)
        def checked(*given: _Arguments.args, **named: _Arguments.kwargs) -> _Found:
            try:
                signature.bind(*given, **named)
            except TypeError as error:
                raise InputError(
                    f"{function.__name__}: {error}; its arguments are {known}{hint}"
                ) from None
            return function(*given, **named)

        return checked

    return decorated


@contextmanager
def naming_force() -> Iterator[None]:
    """Name the argument `force` in errors of code that the command line shares, not its option."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace("--force", "force=True")) from None


def number(name: str, value: object, low: float, high: float) -> float:
    """Return a number of this range; raise InputError for another value."""
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if isinstance(value, str | bytes | None) or found.shape != ():
        raise wrong(name, value, f"a number from {low:g} to {high:g}")
    if not low <= float(found) <= high:
        raise InputError(f"{name} is {float(found):g}, it must be from {low:g} to {high:g}")
    return float(found)


def whole(name: str, value: object, low: int, high: int) -> int:
    """Return a whole number of this range; raise InputError for another value."""
    try:
        found = index(value)  # type: ignore[arg-type]
    except TypeError as error:
        raise wrong(name, value, f"a whole number from {low} to {high}") from error
    if not low <= found <= high:
        raise InputError(f"{name} is {found}, it must be a whole number from {low} to {high}")
    return found


def numbers(name: str, value: ArrayLike, low: float, high: float, right: str) -> tuple[float, ...]:
    """Return the numbers of a sequence or array (n,); raise InputError for anything else.

    `right` states what the value must be.
    """
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise wrong(name, value, right) from error
    if found.ndim != 1 or isinstance(value, str | bytes):
        raise wrong(name, value, right)
    return tuple(number(name, one, low, high) for one in found.tolist())


def one_or_two(
    name: str, value: object, low: float, high: float, meaning: str
) -> tuple[float, float]:
    """Return a number twice, or the two of a sequence or array; raise InputError otherwise.

    `meaning` names the two.
    """
    if isinstance(value, str | bytes) or np.ndim(value) == 0:  # type: ignore[arg-type]
        found = number(name, value, low, high)
        return found, found
    right = f"a number from {low:g} to {high:g} or a pair {meaning}"
    pair = numbers(name, value, low, high, right)  # type: ignore[arg-type]
    if len(pair) != 2:
        raise wrong(name, value, right)
    return pair[0], pair[1]


def path_of(name: str, value: object, right: str) -> Path:
    """Return a path; raise InputError for anything that names no file."""
    if not isinstance(value, str | PathLike):
        raise wrong(name, value, right)
    return Path(value)


def file_of(value: object) -> Path:
    """Return the path of a file to write; raise InputError for anything that names no file."""
    return path_of("path", value, "the name of a file to write")


def names_of(name: str, value: object) -> list[str]:
    """Return the names of a sequence, or a single one; raise InputError for anything else."""
    if isinstance(value, str):
        return [value]
    found = list(value) if isinstance(value, Iterable) else [value]
    names = [one for one in found if isinstance(one, str)]
    if len(names) < len(found):
        raise wrong(name, value, 'a list of names such as ["EI_1", "rhoA"]')
    return names


def _shown(value: object) -> str:
    """Return a value as a message shows it: short ones themselves, others by their type."""
    plain = isinstance(value, str | int | float | list | tuple | None)
    shown = f'"{value}"' if isinstance(value, str) else repr(value)
    if plain and len(shown) <= _SHOWN and "\n" not in shown:
        return shown
    kind = type(value).__name__
    return f"{'an' if kind[0] in 'AEIOUaeiou' else 'a'} {kind}"


def wrong(name: str, value: object, right: str) -> InputError:
    """Return the error of an argument; `right` states what it must be."""
    return InputError(f"{name} is {_shown(value)}, it must be {right}")
