"""Which views tell most: greedy D-optimal selection."""

import heapq

import numpy as np
from jaxtyping import Array, Float

from jaxcal.calibration import vision
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.state import RigState
from jaxcal.estimation import single_threaded_blas
from jaxcal.programs import stored_jit

# The greedy choice starts from this share of the information of all views together, so that it is never singular.
_FIRST_SHARE = 1e-9


def most_informative_views(problem: RigProblem, state: RigState, count: int) -> np.ndarray:
    """Up to `count` views, increasing, of a camera-only problem: each next one raises the determinant of the
    information about the shared parameters most.

    Greedy D-optimal design with lazy evaluation (Minoux 1978): the gain of a view can only shrink as others are
    chosen (log-determinants are submodular), so most need not be computed anew. Deterministic: ties go to the earlier
    view. `state` may be an initial estimate; information hardly depends on its last digits.
    """
    information = view_information(problem, state)
    if len(information) <= count:
        return np.arange(len(information))
    total = information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    information = information * scale[:, None] * scale[None, :]
    chosen_sum = _FIRST_SHARE * np.eye(len(total))
    # Gains by whole factors: the determinant of an empty start means nothing.
    current = np.linalg.slogdet(chosen_sum)[1]
    gains = np.linalg.slogdet(chosen_sum + information)[1] - current
    queue = [(-float(gain), v, 0) for v, gain in enumerate(gains)]
    heapq.heapify(queue)
    chosen: list[int] = []
    while queue and len(chosen) < count:
        gain, v, age = heapq.heappop(queue)
        if age < len(chosen):
            fresh = np.linalg.slogdet(chosen_sum + information[v])[1] - current
            heapq.heappush(queue, (-float(fresh), v, len(chosen)))
            continue
        if not np.isfinite(gain):
            break
        chosen.append(v)
        chosen_sum = chosen_sum + information[v]
        current = np.linalg.slogdet(chosen_sum)[1]
    return np.sort(np.array(chosen))


def view_information(problem: RigProblem, state: RigState) -> Float[np.ndarray, "V F F"]:
    """What each view says of the free shared parameters (F of them) once its own pose is solved for; views without a
    corner say nothing and are kept, as zeros, so that places in the chain are those of views."""
    views, size = problem.free_chain.shape[0], problem.layout.size
    shared, cross = np.zeros((views, size, size)), np.zeros((views, 6, size))
    window = np.zeros((views, 6, 6))
    for group, data in enumerate(problem.corners):
        with single_threaded_blas():
            own, between, pose = (np.asarray(part) for part in _frame_equations(problem, state, group))
        view_of, camera_of, seen = np.asarray(data.view), np.asarray(data.rig_camera), pose.any(axis=(1, 2))
        for camera in np.unique(camera_of):
            rows = np.flatnonzero(seen & (camera_of == camera))  # a camera has one frame in a view
            view, columns = view_of[rows], problem.columns(int(camera))
            shared[np.ix_(view, columns, columns)] += own[rows]
            cross[np.ix_(view, np.arange(6), columns)] += between[rows]
            window[view] += pose[rows]
    free = np.asarray(problem.free)
    seen = window.any(axis=(1, 2))
    window[~seen] = np.eye(6)
    reduced = shared - cross.swapaxes(1, 2) @ np.linalg.solve(window, cross)
    return reduced[:, free][:, :, free]


@stored_jit
def _frame_equations(problem: RigProblem, state: RigState, group: int) -> tuple[Array, Array, Array]:
    """Per frame: Hessian of the shared coordinates (F, q, q), cross (F, 6, q) and of the pose (F, 6, 6)."""
    data = problem.corners[group]
    poses = problem.poses(state, data)
    return vision.equations_of_each_frame(
        problem.templates[group], state, data, poses, group, *problem.target_arrays(state), problem.robust
    )
