"""A pool of detector processes."""

import contextlib
import pickle
import queue
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed

from jaxcal.child import Child, python_child
from jaxcal.detection.worker import Chunk, Corners, Failure
from jaxcal.errors import CalibrationError


def detect_in_processes(chunks: Iterable[Chunk], workers: int) -> Iterator[tuple[Chunk, Corners]]:
    """Detect corners in chunks with `workers` processes; results come as they are ready, in any order.

    Raises CalibrationError when an image cannot be read or a process dies. Leaving the iteration early ends the
    processes.
    """
    with contextlib.ExitStack() as stack:
        free: queue.SimpleQueue[Child] = queue.SimpleQueue()
        for _ in range(workers):
            free.put(stack.enter_context(python_child("jaxcal.detection.worker")))
        threads = ThreadPoolExecutor(workers)
        stack.callback(threads.shutdown, wait=True, cancel_futures=True)
        futures = {threads.submit(_ask, free, chunk): chunk for chunk in chunks}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            for future in futures:
                future.cancel()


def _ask(free: "queue.SimpleQueue[Child]", chunk: Chunk) -> Corners:
    process = free.get()
    try:
        answer = _exchange(process, chunk)
    finally:
        free.put(process)
    if isinstance(answer, Corners):
        return answer
    if answer.expected:
        raise CalibrationError(answer.message)
    raise RuntimeError(f"a detection process failed:\n{answer.message}")


def _exchange(process: Child, chunk: Chunk) -> Corners | Failure:
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        pickle.dump(chunk, process.stdin)
        process.stdin.flush()
        return pickle.load(process.stdout)
    except (EOFError, BrokenPipeError, pickle.UnpicklingError) as error:
        raise CalibrationError(
            f"detection: a worker process ended unexpectedly (exit status {process.poll()}) in frames "
            f"{chunk.frames[0]} to {chunk.frames[-1]}. If memory ran out, use fewer workers; workers=1 needs none."
        ) from error
