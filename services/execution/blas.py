"""One thread of BLAS while we compute.

Our matrices are small: threads that wait for each other at every column cost several times the
work itself. The commands say so by OPENBLAS_NUM_THREADS before numpy is imported; in a notebook
numpy has long been there, and only the library itself can be told.
"""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit the BLAS of this process to one thread, and give back what it had before.

    The limit is the whole process's: what other threads multiply meanwhile is limited, too.
    """
    import scipy.linalg  # noqa: F401 - brings a BLAS of its own, which must be loaded to be limited
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
