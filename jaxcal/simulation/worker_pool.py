"""Jobs in a few processes, with progress and errors brought back to the caller's thread."""

import multiprocessing
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from jaxcal.errors import CalibrationError
from jaxcal.progress import Progress

# Name, function, arguments. The function is called with the arguments and `report(done, total)`; both can be pickled.
Job = tuple[str, Callable[..., None], tuple[Any, ...]]

_POLL_S = 0.1


def run_jobs(jobs: Sequence[Job], progress: Progress, workers: int) -> None:
    """Run all jobs, `workers` at a time, in their order; `progress` is called from this thread.

    With one worker, or one job, everything happens in this process. Otherwise processes are spawned, so a script must
    guard its main program by `if __name__ == "__main__"`. The first exception of a job is raised here, after the jobs
    that run have ended. Raises CalibrationError when a process dies.
    """
    if workers < 1:
        raise CalibrationError(f"workers is {workers}; at least 1 is needed.")
    if workers == 1 or len(jobs) <= 1:
        for name, function, arguments in jobs:
            function(*arguments, _reporter(name, progress))
        return
    # Forking a process that runs XLA's threads could deadlock.
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager, ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context) as pool:
        messages = manager.Queue()
        futures = [pool.submit(_run, job, messages) for job in jobs]
        try:
            _follow(futures, messages, progress)
        except BrokenProcessPool as error:
            raise CalibrationError(
                "a simulation process died; most likely memory ran out. Use fewer workers, or close other programs."
            ) from error
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _reporter(name: str, progress: Progress) -> Callable[[int, int], None]:
    return lambda done, total: progress(f"simulate {name}", done, total)


def _run(job: Job, messages: Any) -> None:
    name, function, arguments = job
    function(*arguments, lambda done, total: messages.put((name, done, total)))


def _follow(futures: Sequence[Future[None]], messages: Any, progress: Progress) -> None:
    """Pass messages on until all futures are done; raise the first exception."""
    pending = set(futures)
    while pending:
        done, pending = wait(pending, timeout=_POLL_S)
        _drain(messages, progress)
        for future in done:
            future.result()
    _drain(messages, progress)


def _drain(messages: Any, progress: Progress) -> None:
    while True:
        try:
            name, done, total = messages.get_nowait()
        except queue.Empty:
            return
        _reporter(name, progress)(done, total)
