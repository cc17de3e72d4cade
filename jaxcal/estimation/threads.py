"""One BLAS thread for the small dense blocks of the engine."""

import contextlib
import functools
from collections.abc import Iterator

import scipy.linalg.lapack  # noqa: F401  loads the BLAS that jax calls, so that its threads can be limited
import threadpoolctl


@contextlib.contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Limit BLAS to one thread inside the block.

    The factorisation makes thousands of calls on 60 x 60 blocks; waking a second thread for each costs up to forty
    times the arithmetic. XLA's own threads are not touched.
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _controller() -> threadpoolctl.ThreadpoolController:
    """Looking for the libraries takes 5 ms; those that count are loaded by now."""
    return threadpoolctl.ThreadpoolController()
