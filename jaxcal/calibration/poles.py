"""Lenses that ended on a pole: a corner where the image jumps, since numerator and denominator both pass zero there."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.calibration.assemble import CameraFrames, split_groups
from jaxcal.calibration.problem import corner_errors
from jaxcal.calibration.robust import RobustFit
from jaxcal.estimation import on_device

# The rig is turned by so much (rad), and where a pixel then moves so many times as far as others, a pole is beside it.
# Of a lens of 120 degrees without one, the rim moves four times as far as the middle.
_TURN = 1e-6
_JUMP = 20.0
_SENTENCE = (
    "cam{camera}: whether this is the optimum is not certain: its lens has a pole on a corner (frame {frame}, point "
    "{point}), where numerator and denominator of the distortion both pass zero. Such a lens fits that corner's noise, "
    "and the image jumps there. Use a model with fewer parameters (pinhole-radtan5, pinhole-equi), or record more "
    "views that reach the rim."
)


def pole_sentences(fit: RobustFit, cameras: Sequence[CameraFrames]) -> list[str]:
    """A sentence for each camera whose lens has parameters that may cancel, and a pole on a corner in use."""
    layout = fit.problem.layout
    may_cancel = [bool(fit.problem.templates[layout.place(c)[0]].usual_spread) for c in range(layout.num_cameras)]
    if not any(may_cancel):
        return []
    still = _errors(fit, cameras, np.zeros(3))
    turned = [_errors(fit, cameras, _TURN * axis) for axis in np.eye(3)]
    sentences = []
    for c, frames in enumerate(cameras):
        moves = [np.linalg.norm(errors[c] - still[c], axis=-1) for errors in turned]
        farthest = np.where(fit.kept[c], np.max(moves, axis=0), 0.0)
        if may_cancel[c] and fit.kept[c].any() and farthest.max() > _JUMP * np.median(farthest[fit.kept[c]]):
            row, point = np.unravel_index(np.argmax(farthest), farthest.shape)
            sentences.append(_SENTENCE.format(camera=c, frame=int(frames.frames[row]), point=int(point)))
    return sentences


def _errors(fit: RobustFit, cameras: Sequence[CameraFrames], turn: np.ndarray) -> list[np.ndarray]:
    """Errors (F, N, 2) px of each camera, the rig turned by a rotation vector (3,)."""
    rotations = np.asarray(fit.state.rotations) @ Rotation.from_rotvec(turn).as_matrix()
    state = eqx.tree_at(lambda s: s.rotations, fit.state, on_device(rotations))
    errors = corner_errors(fit.problem, state)
    return split_groups(fit.problem.layout, cameras, [np.asarray(part) for part in errors])
