"""A process that helps to write a report: it draws the figures of the residuals while the report's own computes."""

import gc
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from jaxcal.child import Child, pipes
from jaxcal.results.calibration import Calibration
from jaxcal.results.report.camera_figures import residual_pictures
from jaxcal.results.report.drawing import Picture

# Of a camera: its place in the calibration.
ResidualPictures = Callable[[int], list[Picture]]


def main() -> None:
    """The helper: one calibration comes in, and the figures of its cameras go out, one camera after the other."""
    gc.disable()  # as `write_report` does
    requests, answers = pipes()
    calibration = pickle.load(requests)
    for index in range(len(calibration.cameras)):
        pickle.dump(_drawn(calibration, index), answers)
        answers.flush()


def ask(helper: Child | None, calibration: Calibration) -> ResidualPictures:
    """The figures of the residuals of a calibration's cameras, which the helper starts to draw.

    Those that it does not deliver (a camera model that only the caller's script knows, a process that was killed), and
    all where there is no helper, are drawn in this process when they are asked for.
    """
    if helper is None:
        return lambda index: _drawn(calibration, index)
    thread = ThreadPoolExecutor(1)
    answers = [thread.submit(_deliver, helper, calibration)]
    answers += [thread.submit(_receive, helper) for _ in calibration.cameras[1:]]
    thread.shutdown(wait=False)

    def pictures(index: int) -> list[Picture]:
        return answers[index].result() or _drawn(calibration, index)

    return pictures


def _drawn(calibration: Calibration, index: int) -> list[Picture]:
    return residual_pictures(calibration.cameras[index], calibration.target, f"c{index}")


def _deliver(helper: Child, calibration: Calibration) -> list[Picture] | None:
    """Send the calibration, and receive the first camera's figures."""
    assert helper.stdin is not None
    try:
        helper.stdin.write(pickle.dumps(calibration))
        helper.stdin.flush()
    # What a user's own camera model cannot be pickled for is told by many names.
    except (OSError, pickle.PicklingError, AttributeError, TypeError):
        helper.kill()
    return _receive(helper)


def _receive(helper: Child) -> list[Picture] | None:
    assert helper.stdout is not None
    try:
        return pickle.load(helper.stdout)
    except (EOFError, OSError, pickle.UnpicklingError):
        return None
