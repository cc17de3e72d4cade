"""Arrays of rigid transforms in plain numpy: rotations (n, 3, 3) with translations (n, 3)."""

import numpy as np

Poses = tuple[np.ndarray, np.ndarray]

_MEDOID_VIEWS = 60


def product(first: Poses, second: Poses) -> Poses:
    """T_a_c = T_a_b T_b_c, one by one; a single transform on either side is applied to all of the other."""
    return first[0] @ second[0], np.einsum("...ij,...j->...i", first[0], second[1]) + first[1]


def inverse(poses: Poses) -> Poses:
    """T_b_a of every T_a_b."""
    back = poses[0].swapaxes(-1, -2)
    return back, -np.einsum("...ij,...j->...i", back, poses[1])


def medoid(poses: Poses, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """The one transform that agrees best with all others; metres count as radians at distance `depth`."""
    step = max(1, len(poses[0]) // _MEDOID_VIEWS)
    rotation, translation = poses[0][::step], poses[1][::step]
    trace = np.einsum("aij,bij->ab", rotation, rotation)
    angle = np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))
    distance = np.linalg.norm(translation[:, None] - translation[None], axis=-1)
    best = int(np.argmin(np.sum(angle + distance / max(depth, 1e-9), axis=1)))
    return rotation[best], translation[best]
