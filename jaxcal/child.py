"""A child process of Python that finds the same modules as this one, asked and answering on pipes.

Not `multiprocessing`: that would run the caller's script again in each child (which needs a `__main__` guard there),
and it cannot start children from the daemonic workers of a cluster.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import BinaryIO

Child = subprocess.Popen[bytes]


@contextlib.contextmanager
def python_child(module: str) -> Iterator[Child]:
    """A process that runs `main()` of a module; leaving the context kills it.

    It reads requests from its standard input and writes answers to `pipes()`.
    """
    # It finds the same modules as this process, and leaves the cores to others.
    path = os.pathsep.join(entry for entry in sys.path if entry)
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", f"from {module} import main; main()"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
    try:
        yield process
    finally:
        process.kill()
        # A request may be half written.
        with contextlib.suppress(BrokenPipeError):
            process.communicate()


def pipes() -> tuple[BinaryIO, BinaryIO]:
    """In a child: where requests come from, and where answers go, between which nothing that a library prints may end
    up."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return sys.stdin.buffer, answers


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
