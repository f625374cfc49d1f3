"""Operations on four numbers at once, of which the vector kernels are composed.

A `Lanes` is a tuple of four floats, one for each of four parameter vectors (or modes). In this form
numba's compiler keeps each tuple in one 256-bit register, which it does not achieve for short inner
loops over arrays. None of the functions allocates.
"""

import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pickle import UnpicklingError
from typing import Any, TypeVar, cast

from numba import config, njit

from pre_core.arrays import FloatArray

# LLVM packs the tuples into vector registers only with its superword pass, which numba leaves off.
# It changes speed alone. The cache of compiled kernels does not know the flag, so every kernel is
# compiled by `compiled` below, and none before this line.
setattr(config, "SLP_VECTORIZE", 1)  # noqa: B010 - the type stubs do not know it

_UNREADABLE = (AttributeError, ImportError, EOFError, TypeError, ValueError, UnpicklingError)
"""Errors of unpickling code that another version of the program stored, or a damaged file."""

Lanes = tuple[float, float, float, float]

LANES = 4

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[Function], Function]:
    """Return the decorator that compiles a kernel with these options of numba's `njit`.

    A wrapper for calls from C or Python contains another copy of the kernel, which takes as long to
    compile; none is called from C. Kernels copy rows by loops: an assignment to a slice checks its
    shape, and the check takes three seconds to compile.
    """
    of_numba: Any = njit  # the type stubs do not know all options

    def decorate(function: Function) -> Function:
        kernel: Any = of_numba(function, nogil=True, no_cfunc_wrapper=True, **options)
        if kernel is not function:  # so it is with NUMBA_DISABLE_JIT
            _store_if_possible(kernel)
        return cast("Function", kernel)

    return decorate


def _store_if_possible(dispatcher: Any) -> None:
    """Let numba store a kernel's machine code; without permission or room, it stores nothing.

    The process then compiles the kernel itself: a full disk must not cost a crossing. So it does
    where stored code is damaged, or names a type that this version of the program does not have.
    """
    try:
        dispatcher.enable_caching()
    except RuntimeError:
        _warn_without_cache("no folder for them can be written; NUMBA_CACHE_DIR names another")
        return
    cache = dispatcher._cache
    load, save = cache.load_overload, cache.save_overload

    def load_if_possible(signature: object, target: object) -> object:
        try:
            return load(signature, target)
        except _UNREADABLE:
            with suppress(OSError):
                cache.flush()
            return None

    def save_if_possible(signature: object, code: object) -> None:
        try:
            save(signature, code)
        except (OSError, *_UNREADABLE) as error:
            _warn_without_cache(getattr(error, "strerror", None) or str(error))

    cache.load_overload, cache.save_overload = load_if_possible, save_if_possible


def _warn_without_cache(cause: str) -> None:
    """Warn that kernels are compiled again; Python prints one warning for each cause."""
    text = f"compiled kernels are not stored, so a start takes minutes: {cause}"
    warnings.warn(text, RuntimeWarning, stacklevel=1)


# A kernel contains a copy of each kernel that it calls, which is optimised together with it and may
# round differently. Without inlining, the copy that is loaded first is run, so that a process that
# compiles and one that loads compiled kernels can differ in the last digits. So all are inlined.
_inlined = partial(compiled, error_model="numpy", forceinline=True)

# Contraction allows fused multiply-add; no other reordering of the arithmetic is allowed, so that
# results depend only to rounding on which vectors are evaluated together.
_CONTRACTED = {"contract", "nsz"}
kernel = _inlined(fastmath=_CONTRACTED)

# For sums over many terms, which may be taken in any order.
summing = _inlined(fastmath={"contract", "nsz", "reassoc"})

# For kernels that only kernels call: a call from Python would crash the process.
_inner = partial(_inlined, no_cpython_wrapper=True)
inner = _inner(fastmath=_CONTRACTED)
# Every operation is rounded as written.
inner_exact = _inner()


@inner
def load(a: FloatArray, i: int) -> Lanes:
    """Return row i of an array (n, 4)."""
    return (a[i, 0], a[i, 1], a[i, 2], a[i, 3])


@inner
def store(a: FloatArray, i: int, v: Lanes) -> None:
    """Write row i of an array (n, 4)."""
    a[i, 0] = v[0]
    a[i, 1] = v[1]
    a[i, 2] = v[2]
    a[i, 3] = v[3]


@inner
def add(a: Lanes, b: Lanes) -> Lanes:
    """Return a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3])


@inner
def sub(a: Lanes, b: Lanes) -> Lanes:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3])


@inner
def mul(a: Lanes, b: Lanes) -> Lanes:
    """Return a b."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2], a[3] * b[3])


@inner
def scale(a: Lanes, s: float) -> Lanes:
    """Return a s, with one s for all lanes."""
    return (a[0] * s, a[1] * s, a[2] * s, a[3] * s)


@inner
def fma(a: Lanes, b: Lanes, c: Lanes) -> Lanes:
    """Return a b + c."""
    return (a[0] * b[0] + c[0], a[1] * b[1] + c[1], a[2] * b[2] + c[2], a[3] * b[3] + c[3])


@inner
def fma_scalar(a: Lanes, s: float, c: Lanes) -> Lanes:
    """Return a s + c, with one s for all lanes."""
    return (a[0] * s + c[0], a[1] * s + c[1], a[2] * s + c[2], a[3] * s + c[3])
