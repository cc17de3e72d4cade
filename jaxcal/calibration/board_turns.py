"""Boards that look the same upside down: one numbering for all cameras that see them at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxcal.calibration.assemble import CameraFrames
from jaxcal.observations import Detections
from jaxcal.targets import Target

_CANDIDATES = 60  # views that propose a relative pose
# A view agrees with a relative pose when it is nearer than this in angle, and in distance per depth of the board.
_NEAR = 0.15
_TIE = 1.3  # a second pose that agrees nearly as well makes the choice a guess

Poses = tuple[np.ndarray, np.ndarray]


class Unified(NamedTuple):
    """Cameras with one numbering: their frames and poses T_cam_target, and which turn (F,) each view was given.

    `turned[c]` indexes `target.turns`; `sentences` say what was done, and where it was a guess.
    """

    cameras: list[CameraFrames]
    poses: list[Poses]
    turned: list[np.ndarray]
    sentences: list[str]


def symmetry_sentences(target: Target, num_cameras: int) -> list[str]:
    """What a board that looks the same upside down means for several cameras; nothing for one camera."""
    if num_cameras < 2 or not any(board.is_half_turn_symmetric for board in target.boards):
        return []
    return [
        "The board looks the same upside down, so cameras cannot tell which way up it is: views of cameras are matched "
        "by the relative pose that most of them agree on. A board with rows + columns odd (or with tags) needs no "
        "such guess."
    ]


def unify_turns(
    names: Sequence[str],
    cameras: Sequence[CameraFrames],
    views: Sequence[np.ndarray],
    poses: Sequence[Poses],
    target: Target,
) -> Unified:
    """Renumber the corners of views so that all cameras agree on which way up a symmetric board is.

    `views[c]` (F,) is the view of each frame; `poses[c]` rotations (F, 3, 3) and translations (F, 3), T_cam_target.
    A turn of the board moves a camera's relative pose to the others by another amount in every view, so only the right
    turns make views agree: camera by camera, the relative pose is taken that most shared views agree with under some
    turn, and each view gets the turn that comes nearest to it. Everything is unchanged for other boards.
    """
    count = len(cameras)
    turned = [np.zeros(len(frames.frames), np.int64) for frames in cameras]
    if len(target.turns) == 1 or count < 2:
        return Unified(list(cameras), list(poses), turned, [])
    moves = _moves(target)
    depth = max(float(np.median([np.linalg.norm(t, axis=1).mean() for _, t in poses])), 1e-9)
    now = [_matrices(pose) for pose in poses]
    T_cam_ref = {0: np.eye(4)}
    sentences = []
    while len(T_cam_ref) < count:
        strength, c = max(
            (sum(_shared(views, a, b) for a in T_cam_ref), -b) for b in range(count) if b not in T_cam_ref
        )
        c = -c
        if not strength:  # seen with none of the others: the rig will not be joined either, and says so
            T_cam_ref[c] = np.eye(4)
            continue
        own, T_target_ref = _known(views, now, T_cam_ref, c)
        # T_cam_ref as each shared view has it, under every turn.
        hypotheses = now[c][own][:, None] @ moves[None] @ T_target_ref[:, None]
        chosen, turn, tie = _agreed(hypotheses, depth)
        T_cam_ref[c] = chosen
        turned[c][own] = turn
        now[c][own] = now[c][own] @ moves[turn]
        if tie:
            sentences.append(
                f"{names[c]}: which way up it saw the board is a guess, because the board hardly turned or moved "
                "between the views that it shares with other cameras. Move and turn the board more, or use one that "
                "looks different upside down."
            )
    changed = [_renumbered(frames, turn, target) for frames, turn in zip(cameras, turned, strict=True)]
    new_poses = [(T[:, :3, :3], T[:, :3, 3]) for T in now]
    return Unified(changed, new_poses, turned, sentences)


def _moves(target: Target) -> np.ndarray:
    """(S, 4, 4): what a pose T_cam_target is multiplied by when points i get the numbers turns[s, i] instead."""
    points = target.points[:, :2]
    moves = np.tile(np.eye(4), (len(target.turns), 1, 1))
    for s, turn in enumerate(target.turns):
        # The move takes the point with the new number to where the point with the old number is.
        new, old = points[turn], points
        a, b = (new - new.mean(axis=0)) @ np.array([1, 1j]), (old - old.mean(axis=0)) @ np.array([1, 1j])
        rotor = np.vdot(a, b) / abs(np.vdot(a, b))
        rotation = np.array([[rotor.real, -rotor.imag], [rotor.imag, rotor.real]])
        moves[s, :2, :2] = rotation
        moves[s, :2, 3] = old.mean(axis=0) - rotation @ new.mean(axis=0)
    return moves


def _matrices(pose: Poses) -> np.ndarray:
    matrices = np.tile(np.eye(4), (len(pose[0]), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = pose
    return matrices


def _shared(views: Sequence[np.ndarray], a: int, b: int) -> int:
    return len(np.intersect1d(views[a], views[b]))


def _known(
    views: Sequence[np.ndarray], now: Sequence[np.ndarray], T_cam_ref: dict[int, np.ndarray], c: int
) -> tuple[np.ndarray, np.ndarray]:
    """Frames (K,) of camera c whose view a joined camera shares, and T_target_ref (K, 4, 4) as that camera has it."""
    found: dict[int, np.ndarray] = {}
    for joined, pose in T_cam_ref.items():
        theirs, mine = np.intersect1d(views[joined], views[c], return_indices=True)[1:]
        for frame, other in zip(mine.tolist(), theirs.tolist(), strict=True):
            found.setdefault(frame, np.linalg.inv(now[joined][other]) @ pose)
    own = np.array(sorted(found))
    return own, np.stack([found[frame] for frame in own.tolist()])


def _agreed(hypotheses: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray, bool]:
    """The pose (4, 4) that most views agree with, each view's turn (K,) to it, and whether another does nearly as well.

    `hypotheses` (K, S, 4, 4): poses by view and turn.
    """
    some = hypotheses[:: max(1, len(hypotheses) // _CANDIDATES)].reshape(-1, 4, 4)
    distance = np.stack([_distance(candidate, hypotheses, depth) for candidate in some])  # (C, K, S)
    cost = np.minimum(distance.min(axis=2) / _NEAR, 1.0).sum(axis=1)
    best = int(np.argmin(cost))
    others = _distance(some[best], some, depth) > 2.0 * _NEAR
    tie = bool(np.any(cost[others] < _TIE * cost[best] + 0.02 * len(hypotheses)))
    return some[best], distance[best].argmin(axis=1), tie


def _distance(pose: np.ndarray, others: np.ndarray, depth: float) -> np.ndarray:
    """How far poses (..., 4, 4) are from one: the angle, or the distance per depth where that is more."""
    trace = np.einsum("ij,...ij->...", pose[:3, :3], others[..., :3, :3])
    angle = np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))
    return np.maximum(angle, np.linalg.norm(others[..., :3, 3] - pose[:3, 3], axis=-1) / depth)


def _renumbered(frames: CameraFrames, turned: np.ndarray, target: Target) -> CameraFrames:
    """The same corners with new numbers, in the dense arrays and in the detections."""
    if not turned.any():
        return frames
    number = target.turns[turned]  # (F, N): the new number of each point
    row = np.arange(len(turned))[:, None]
    pixels, seen = np.zeros_like(frames.pixels), np.zeros_like(frames.seen)
    pixels[row, number], seen[row, number] = frames.pixels, frames.seen
    old = frames.detections
    row_of = np.full(len(old.timestamps_ns), -1)
    row_of[frames.frames] = np.arange(len(frames.frames))
    place = row_of[old.frame]
    point = np.where(place >= 0, number[place, old.point], old.point)
    detections = Detections(old.timestamps_ns, old.frame, point, old.pixels, old.image_size, old.precision)
    return CameraFrames(detections, frames.frames, frames.time_ns, pixels, seen)
