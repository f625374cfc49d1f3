"""Memory that is free is given back to the system."""

import contextlib
import ctypes


def give_back_memory() -> None:
    """Give back what a burst needed; does nothing where the C library cannot.

    glibc keeps what was freed below what is still used: a service that runs for months would keep
    as much as its worst moment took.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
