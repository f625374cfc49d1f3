"""Restriction of BLAS to one thread during a computation.

Our matrices are small: threads that wait for each other at every column cost several times the work
itself. The commands set OPENBLAS_NUM_THREADS before numpy is imported; in a notebook numpy is
already loaded, and only the library itself can be limited.
"""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit the BLAS of this process to one thread, and restore its previous limit.

    The limit applies to the whole process, including multiplications in other threads.
    """
    import scipy.linalg  # noqa: F401 - brings a BLAS of its own, which must be loaded to be limited
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
