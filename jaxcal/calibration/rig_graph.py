"""First poses of cameras and boards among each other, from who saw what together: a graph, merged strongest tie first.

Cameras that see a board at the same time are tied to each other; boards that a camera sees at the same time are too.
Where neither holds, two cameras that each watch a board of their own while the rig moves are tied by hand-eye
calibration (Shah 2013, "Solving the robot-world/hand-eye calibration problem using the Kronecker product").
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal.calibration.poses import Poses, inverse, medoid, product
from jaxcal.errors import CalibrationError

# A rotation of the rig has to be clear of noise to tie cameras by hand-eye: singular value ratio of its equations.
_HAND_EYE_CLEAR = 0.02
_LEAST_HAND_EYE_VIEWS = 4


@dataclass(frozen=True)
class Sightings:
    """Boards seen by one camera: view (S,), board (S,), T_cam_board (rotations (S, 3, 3), translations (S, 3)), and
    the root mean square error (S,), px, of each pose."""

    view: np.ndarray
    board: np.ndarray
    pose: Poses
    error: np.ndarray


@dataclass(frozen=True)
class RigGraph:
    """T_cam_rig of every camera (the rig's frame is cam0's) and T_target_board of every board (the target's is board
    0's)."""

    T_cam_rig: Poses
    T_target_board: Poses


class _Clusters:
    """Bodies (cameras or boards) gathered in rigid clusters; `place[i]` is T_body_cluster."""

    def __init__(self, count: int) -> None:
        self.of = np.arange(count)
        self.rotation = np.tile(np.eye(3), (count, 1, 1))
        self.translation = np.zeros((count, 3))

    def merge(self, kept: int, joined: int, T_joined_kept: tuple[np.ndarray, np.ndarray]) -> None:
        """Move the bodies of cluster `joined` into cluster `kept`."""
        inside = self.of == joined
        R, t = T_joined_kept
        self.translation[inside] += self.rotation[inside] @ t
        self.rotation[inside] = self.rotation[inside] @ R
        self.of[inside] = kept

    def places(self, bodies: np.ndarray) -> Poses:
        return self.rotation[bodies], self.translation[bodies]


def solve_graph(names: Sequence[str], sightings: Sequence[Sightings], num_boards: int, tolerance_ns: int) -> RigGraph:
    """Tie all cameras and boards together. Raises CalibrationError naming those that nothing connects, and what
    recording would."""
    cameras, boards = _Clusters(len(names)), _Clusters(num_boards)
    owner = np.concatenate([np.full(len(s.view), c) for c, s in enumerate(sightings)])
    seen = Sightings(
        view=np.concatenate([s.view for s in sightings]),
        board=np.concatenate([s.board for s in sightings]),
        pose=tuple(np.concatenate([s.pose[k] for s in sightings]) for k in range(2)),  # type: ignore[arg-type]
        error=np.concatenate([s.error for s in sightings]),
    )
    while True:
        if _tie_strongest(cameras, boards, owner, seen):
            continue
        if not _tie_by_hand_eye(cameras, boards, owner, seen):
            break
    _require_connected(names, cameras, boards, owner, seen, tolerance_ns)
    rig, target = cameras.places(np.array([0])), boards.places(np.array([0]))
    return RigGraph(
        T_cam_rig=product(cameras.places(np.arange(len(names))), inverse(rig)),
        T_target_board=product(target, inverse(boards.places(np.arange(num_boards)))),
    )


def _cluster_poses(cameras: _Clusters, boards: _Clusters, owner: np.ndarray, seen: Sightings) -> Poses:
    """T_camera-cluster_board-cluster of every sighting."""
    return product(product(inverse(cameras.places(owner)), seen.pose), boards.places(seen.board))


def _best_per_view(view: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Index of the best sighting of each view, views increasing."""
    order = np.lexsort((error, view))
    return order[np.concatenate([[True], np.diff(view[order]) > 0])] if len(order) else order


def _tie_strongest(cameras: _Clusters, boards: _Clusters, owner: np.ndarray, seen: Sightings) -> bool:
    """Merge the two clusters that most views tie directly; False when there are none."""
    pose = _cluster_poses(cameras, boards, owner, seen)
    by_pair = {}
    for a, b in sorted({(int(a), int(b)) for a, b in zip(cameras.of[owner], boards.of[seen.board], strict=True)}):
        rows = np.flatnonzero((cameras.of[owner] == a) & (boards.of[seen.board] == b))
        by_pair[a, b] = rows[_best_per_view(seen.view[rows], seen.error[rows])]
    best: tuple[int, bool, int, int, np.ndarray, np.ndarray] | None = None
    for (a1, b1), (a2, b2) in itertools.combinations(by_pair, 2):
        if (a1 == a2) == (b1 == b2):
            continue
        first, second = by_pair[a1, b1], by_pair[a2, b2]
        _, i, j = np.intersect1d(seen.view[first], seen.view[second], return_indices=True)
        if len(i) and (best is None or len(i) > best[0]):
            of_cameras = b1 == b2
            kept, joined = (a1, a2) if of_cameras else (b1, b2)
            best = (len(i), of_cameras, kept, joined, first[i], second[j])
    if best is None:
        return False
    _, of_cameras, kept, joined, first, second = best
    one, other = (pose[0][first], pose[1][first]), (pose[0][second], pose[1][second])
    if of_cameras:
        depth = float(np.median(np.linalg.norm(one[1], axis=1)))
        cameras.merge(kept, joined, medoid(product(other, inverse(one)), depth))
    else:
        depth = float(np.median(np.linalg.norm(one[1], axis=1)))
        boards.merge(kept, joined, medoid(product(inverse(other), one), depth))
    return True


def _tie_by_hand_eye(cameras: _Clusters, boards: _Clusters, owner: np.ndarray, seen: Sightings) -> bool:
    """Merge two camera clusters and two board clusters by the rig's motion; False where no pair determines it."""
    pose = _cluster_poses(cameras, boards, owner, seen)
    pairs = sorted({(int(a), int(b)) for a, b in zip(cameras.of[owner], boards.of[seen.board], strict=True)})
    best: tuple[float, int, int, int, int, Poses, Poses] | None = None
    for (a1, b1), (a2, b2) in itertools.combinations(pairs, 2):
        if a1 == a2 or b1 == b2:
            continue
        rows = []
        for a, b in ((a1, b1), (a2, b2)):
            own = np.flatnonzero((cameras.of[owner] == a) & (boards.of[seen.board] == b))
            rows.append(own[_best_per_view(seen.view[own], seen.error[own])])
        _, i, j = np.intersect1d(seen.view[rows[0]], seen.view[rows[1]], return_indices=True)
        if len(i) < _LEAST_HAND_EYE_VIEWS:
            continue
        first, second = rows[0][i], rows[1][j]
        X, Z, clear = hand_eye((pose[0][first], pose[1][first]), (pose[0][second], pose[1][second]))
        score = clear * np.sqrt(len(i))
        if clear > _HAND_EYE_CLEAR and (best is None or score > best[0]):
            best = (score, a1, a2, b1, b2, X, Z)
    if best is None:
        return False
    _, a1, a2, b1, b2, X, Z = best
    cameras.merge(a1, a2, (X[0][0], X[1][0]))
    boards.merge(b1, b2, tuple(part[0] for part in inverse(Z)))  # type: ignore[arg-type]
    return True


def hand_eye(first: Poses, second: Poses) -> tuple[Poses, Poses, float]:
    """X = T_cam2_cam1 and Z = T_board1_board2 from T_cam1_board1 and T_cam2_board2 at the same times (n of each).

    T_cam2_board2 = X T_cam1_board1 Z is linear in the two rotations together (their common null vector), then in the
    two translations. Also returns how clearly the motion determines them: the smallest singular value that should
    not vanish over the largest; it vanishes when the rig turned about one axis only. X and Z hold one pose each.
    """
    (Q, q), (P, p) = first, second
    eye = np.eye(3)
    # Row-major vec: vec(X' P) = (I kron P') vec(X'), vec(Q Z) = (Q kron I) vec(Z).
    rows = [np.concatenate([np.kron(eye, Pv.T), -np.kron(Qv, eye)], axis=1) for Pv, Qv in zip(P, Q, strict=True)]
    _, values, vectors = np.linalg.svd(np.concatenate(rows))
    null = vectors[-1]
    X, Z = (_nearest_rotation(part) for part in (null[:9].reshape(3, 3), null[9:].reshape(3, 3)))
    if np.sign(np.linalg.det(null[:9].reshape(3, 3))) < 0:
        X, Z = (_nearest_rotation(-part) for part in (null[:9].reshape(3, 3), null[9:].reshape(3, 3)))
    X = X.T
    # t_P = X (Q t_Z + q) + t_X
    left = np.concatenate([np.concatenate([X @ Qv, eye], axis=1) for Qv in Q])
    right = (p - q @ X.T).ravel()
    solution, *_ = np.linalg.lstsq(left, right, rcond=None)
    clear_turn = values[-2] / values[0]
    lengths = np.linalg.svd(left, compute_uv=False)
    return (
        (X[None], solution[None, 3:]),
        (Z[None], solution[None, :3]),
        float(min(clear_turn, lengths[-1] / lengths[0])),
    )


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _require_connected(
    names: Sequence[str],
    cameras: _Clusters,
    boards: _Clusters,
    owner: np.ndarray,
    seen: Sightings,
    tolerance_ns: int,
) -> None:
    alone = [name for c, name in enumerate(names) if cameras.of[c] != cameras.of[0]]
    with_first = [name for c, name in enumerate(names) if cameras.of[c] == cameras.of[0]]
    if alone:
        one, other = names.index(alone[0]), names.index(with_first[0])
        together = len(np.intersect1d(seen.view[owner == one], seen.view[owner == other]))
        several = len(boards.of) > 1
        if together:
            remedy = (
                "they watched different boards at the same time, but the rig hardly turned, or about one axis only. "
                "Turn it about two axes by 20 degrees or more while each camera sees its board, or show one board to "
                "both."
            )
        elif several:
            remedy = (
                "Record with one board in both views at once, or with a board in front of each of them while the rig "
                "turns about two axes; check that the clocks agree."
            )
        else:
            remedy = (
                "Record with the board in both views at once, or put up a second board (other ids), so that each "
                "camera sees one while the rig turns about two axes, and describe both in the target file; check that "
                "the clocks agree (`sync_tolerance_s`); or calibrate with an IMU, where cameras need not be "
                "synchronised nor overlap."
            )
        raise CalibrationError(
            f"{', '.join(alone)} never saw the board at the same time as {', '.join(with_first)} (frames within "
            f"{tolerance_ns / 1e6:g} ms): {remedy}"
            if not together
            else f"nothing ties {', '.join(alone)} to {', '.join(with_first)}: {remedy}"
        )
    lost = [b for b in range(len(boards.of)) if boards.of[b] != boards.of[0]]
    unseen = [b for b in lost if not np.any(seen.board == b)]
    if unseen:
        raise CalibrationError(
            f"board {unseen[0]} of the target was never seen, though the target file describes it. Take it out there, "
            "or check its ids and sizes."
        )
    if lost:
        raise CalibrationError(
            f"board {lost[0]} of the target was never seen together with the others, not even by different cameras. "
            "Record with two boards in view at once, or calibrate with one board."
        )


def rig_poses(graph: RigGraph, sightings: Sequence[Sightings], count: int) -> Poses:
    """T_target_rig of every view, from the sighting with the smallest error; rotations (V, 3, 3), translations."""
    rotations, positions = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    best = np.full(count, np.inf)
    for c, s in enumerate(sightings):
        board = (graph.T_target_board[0][s.board], graph.T_target_board[1][s.board])
        camera = (graph.T_cam_rig[0][[c]], graph.T_cam_rig[1][[c]])
        rotation, position = product(product(board, inverse(s.pose)), camera)
        for k in np.flatnonzero(s.error < best[s.view]):
            v = s.view[k]
            if s.error[k] < best[v]:
                best[v], rotations[v], positions[v] = s.error[k], rotation[k], position[k]
    return rotations, positions
