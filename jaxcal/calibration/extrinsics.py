"""Poses between cameras from the views they share: a graph, its spanning tree, and robust averages along it."""

import itertools
from collections.abc import Sequence

import numpy as np

from jaxcal.calibration.assemble import CameraFrames
from jaxcal.errors import CalibrationError

_MEDOID_VIEWS = 60


def associate(cameras: Sequence[CameraFrames], tolerance_ns: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Group frames of different cameras into views taken at the same time, within `tolerance_ns`.

    Returns the view index (F,) of every camera's frames, and the views' times (V,). A view holds at most one frame of
    each camera: frames are visited in order of time, and a frame opens a new view when it lies further than the
    tolerance from the open view's first frame or when its camera is already in it.
    """
    times = np.concatenate([c.time_ns for c in cameras])
    owner = np.concatenate([np.full(len(c.time_ns), i) for i, c in enumerate(cameras)])
    view = np.empty(len(times), dtype=np.int64)
    starts: list[int] = []
    inside: set[int] = set()
    for k in np.lexsort((owner, times)):
        if not starts or times[k] - starts[-1] > tolerance_ns or owner[k] in inside:
            starts.append(int(times[k]))
            inside = set()
        inside.add(int(owner[k]))
        view[k] = len(starts) - 1
    return [view[owner == i] for i in range(len(cameras))], np.array(starts)


def relative_pose(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """T_b_a from poses T_a_target and T_b_target in shared views: the view that agrees best with all others."""
    step = max(1, len(first[0]) // _MEDOID_VIEWS)
    (Ra, ta), (Rb, tb) = ((R[::step], t[::step]) for R, t in (first, second))
    rotation = Rb @ Ra.swapaxes(-1, -2)
    translation = tb - np.einsum("fij,fj->fi", rotation, ta)
    trace = np.einsum("aij,bij->ab", rotation, rotation)
    angle = np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))
    distance = np.linalg.norm(translation[:, None] - translation[None], axis=-1)
    depth = max(float(np.median(np.linalg.norm(ta, axis=1))), 1e-9)
    best = int(np.argmin(np.sum(angle + distance / depth, axis=1)))
    return rotation[best], translation[best]


def chain_cameras(
    names: Sequence[str],
    views: Sequence[np.ndarray],
    poses: Sequence[tuple[np.ndarray, np.ndarray]],
    tolerance_ns: int,
) -> tuple[np.ndarray, np.ndarray]:
    """T_cam_cam0 of every camera, rotations (C, 3, 3) and translations (C, 3), along the strongest shared views.

    `poses[c]` are T_cam_target of the camera's frames. Raises CalibrationError naming the cameras that share no view
    with the others.
    """
    count = len(names)
    pairs = itertools.permutations(range(count), 2)
    shared = {(a, b): np.intersect1d(views[a], views[b], return_indices=True)[1:] for a, b in pairs}
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    joined = [0]
    while len(joined) < count:
        edges = [(len(shared[a, b][0]), -b, -a) for a in joined for b in range(count) if b not in joined]
        strength, b, a = max(edges)
        a, b = -a, -b
        if strength == 0:
            left = [names[c] for c in range(count) if c not in joined]
            raise CalibrationError(
                f"{', '.join(left)} never saw the board at the same time as {', '.join(names[c] for c in joined)} "
                f"(frames within {tolerance_ns / 1e6:g} ms). Record with the board in both views at once, check that "
                "the clocks agree, or calibrate with an IMU, where cameras need not be synchronised nor overlap."
            )
        index_a, index_b = shared[a, b]
        rotation, translation = relative_pose(
            (poses[a][0][index_a], poses[a][1][index_a]), (poses[b][0][index_b], poses[b][1][index_b])
        )
        rotations[b] = rotation @ rotations[a]
        translations[b] = rotation @ translations[a] + translation
        joined.append(b)
    return rotations, translations


def rig_poses(
    views: Sequence[np.ndarray],
    count: int,
    T_cam_rig: tuple[np.ndarray, np.ndarray],
    poses: Sequence[tuple[np.ndarray, np.ndarray]],
    errors: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """T_target_rig of every view, from the camera that sees it with the smallest error; (V, 3, 3) and (V, 3)."""
    rotations, positions = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    best = np.full(count, np.inf)
    for c, view in enumerate(views):
        better = errors[c] < best[view]
        rows = view[better]
        best[rows] = errors[c][better]
        R_target_cam = poses[c][0][better].swapaxes(-1, -2)
        position = np.einsum("fij,fj->fi", R_target_cam, T_cam_rig[1][c] - poses[c][1][better])
        rotations[rows], positions[rows] = R_target_cam @ T_cam_rig[0][c], position
    return rotations, positions
