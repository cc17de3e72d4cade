"""One BLAS thread for the small dense blocks of the engine."""

import contextlib
from collections.abc import Iterator

import scipy.linalg.lapack  # noqa: F401  loads the BLAS that jax calls, so that its threads can be limited
import threadpoolctl


@contextlib.contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Limit BLAS to one thread inside the block.

    The factorisation makes thousands of calls on 60 x 60 blocks; waking a second thread for each costs up to forty
    times the arithmetic. XLA's own threads are not touched.
    """
    with threadpoolctl.threadpool_limits(limits=1, user_api="blas"):
        yield
