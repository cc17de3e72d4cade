"""Where a study's tasks run: in threads, in local processes, or on a Dask cluster. A worker that dies loses nothing.

Local processes are plain children on pipes, as those of detection: `multiprocessing` would run the caller's script
again in each. A chunk whose worker died is given to a fresh one; only its rows' arrival counts.
"""

import contextlib
import os
import pickle
import queue
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

from jaxcal.errors import CalibrationError
from jaxcal.studies.tasks import Payload, Task, execute

Rows = list[dict[str, Any]]
# So often a chunk may end its worker before it is taken for the culprit.
_MOST_DEATHS = 3


def in_threads(payload: Payload, chunks: Sequence[Sequence[Task]], workers: int) -> Iterator[Rows]:
    """In this process: for compiled runs, which share one program and leave Python alone while they compute."""
    if workers == 1:
        yield from (execute(payload, chunk) for chunk in chunks)
        return
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(execute, payload, chunk) for chunk in chunks]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            for future in futures:
                future.cancel()


def in_processes(payload: Payload, chunks: Sequence[Sequence[Task]], workers: int) -> Iterator[Rows]:
    """In `workers` child processes, each with its share of the threads. Raises CalibrationError when a chunk ends its
    worker again and again."""
    with contextlib.ExitStack() as stack:
        pool = _Pool(payload, workers)
        stack.callback(pool.close)
        threads = ThreadPoolExecutor(workers)
        stack.callback(threads.shutdown, wait=True, cancel_futures=True)
        futures = [threads.submit(pool.ask, chunk) for chunk in chunks]
        stack.callback(lambda: [future.cancel() for future in futures])
        stack.callback(pool.stop)
        for future in as_completed(futures):
            yield future.result()


class _Pool:
    """Idle workers; one that has died is replaced when its chunk is asked for again."""

    def __init__(self, payload: Payload, workers: int) -> None:
        self._start = pickle.dumps(payload)
        self._threads = max((os.cpu_count() or 1) // workers, 1)
        self._idle: queue.SimpleQueue[subprocess.Popen[bytes] | None] = queue.SimpleQueue()
        self._all: list[subprocess.Popen[bytes]] = []
        self._stopped = False
        for _ in range(workers):
            self._idle.put(None)

    def ask(self, chunk: Sequence[Task]) -> Rows:
        """The rows of a chunk."""
        for _ in range(_MOST_DEATHS):
            worker = self._idle.get() or self._new()
            try:
                answer = _exchange(worker, chunk)
            except (EOFError, BrokenPipeError, pickle.UnpicklingError):
                self._idle.put(None)
                if self._stopped:
                    break
                continue
            self._idle.put(worker)
            if isinstance(answer, str):
                raise RuntimeError(f"a worker of the study failed:\n{answer}")
            return answer
        raise CalibrationError(
            f"study: run {chunk[0].index} ended its worker process {_MOST_DEATHS} times. If memory ran out, use fewer "
            "workers. What is done is stored; the study goes on from there."
        )

    def stop(self) -> None:
        """End all workers, busy ones too."""
        self._stopped = True
        for worker in self._all:
            worker.kill()

    def close(self) -> None:
        for worker in self._all:
            worker.kill()
            worker.communicate()

    def _new(self) -> "subprocess.Popen[bytes]":
        path = os.pathsep.join(entry for entry in sys.path if entry)
        count = str(self._threads)
        limits = {"OMP_NUM_THREADS": count, "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": count}
        if self._threads == 1:
            flags = os.environ.get("XLA_FLAGS", "")
            limits["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
        command = [sys.executable, "-c", "from jaxcal.studies.workers import main; main()"]
        environment = os.environ | {"PYTHONPATH": path} | limits
        worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        self._all.append(worker)
        assert worker.stdin is not None
        worker.stdin.write(self._start)
        worker.stdin.flush()
        return worker


def _exchange(worker: "subprocess.Popen[bytes]", chunk: Sequence[Task]) -> Any:
    assert worker.stdin is not None
    assert worker.stdout is not None
    pickle.dump(list(chunk), worker.stdin)
    worker.stdin.flush()
    return pickle.load(worker.stdout)


def main() -> None:
    """A worker process: the payload first, then chunks, on standard input; rows, or a traceback, on standard output."""
    import traceback

    # What a library prints must not come between the answers.
    answers, sys.stdout = sys.stdout.buffer, sys.stderr
    payload: Payload = pickle.load(sys.stdin.buffer)
    while True:
        try:
            chunk = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            answer: Any = execute(payload, chunk)
        except Exception:
            answer = traceback.format_exc()
        pickle.dump(answer, answers)
        answers.flush()


def on_dask(payload: Payload, chunks: Sequence[Sequence[Task]], address: str) -> Iterator[Rows]:
    """On the cluster whose scheduler listens at `address` (tcp://...). Its workers need jaxcal, and for rig.yaml files
    the same folders. Raises CalibrationError where `distributed` is missing or nobody listens."""
    try:
        import distributed
    except ImportError as error:
        raise CalibrationError("--scheduler needs Dask: pip install 'jaxcal[dask]'.") from error
    try:
        client = distributed.Client(address, timeout="10s", set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise CalibrationError(f"{address}: no Dask scheduler answers there ({error}).") from error
    with client:
        # A task, rather than scattered data: when the worker that holds it dies, it is made again.
        data = client.submit(pickle.loads, pickle.dumps(payload), pure=False)
        futures = [client.submit(execute, data, list(chunk), pure=False, retries=_MOST_DEATHS) for chunk in chunks]
        for future in distributed.as_completed(futures, loop=client.loop):
            try:
                rows = future.result()
            except distributed.KilledWorker as error:
                raise CalibrationError(f"study: a run ended its workers again and again ({error}).") from error
            yield rows
