"""Views that stand the wrong way round are turned over, and no others."""

import equinox as eqx
import numpy as np
import pytest
from posed_corners import BOARD, FACING, matrix
from scipy.spatial.transform import Rotation

from jaxcal import Detections
from jaxcal.calibration import solving
from jaxcal.calibration.assemble import camera_frames
from jaxcal.calibration.initial_poses import mirrored_poses
from jaxcal.calibration.mirrored import turn_mirrored
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.state import RigState
from jaxcal.cameras import Pinhole
from jaxcal.estimation import on_device

SIZE = (640, 480)
NOISE_PX = 0.05
COUNT = 8


def problem_with_mirrored(
    focal: float, mirrored: list[int], cameras: int
) -> tuple[RigProblem, RigState, np.ndarray, np.ndarray]:
    """Boards tilted by 20 to 50 degrees that fill two thirds of the image; cameras 0.1 m apart, the lenses known.

    Returns the problem, a start where some views are mirrored about cam0's line of sight, and true T_target_rig.
    """
    rng = np.random.default_rng(5)
    lens = Pinhole.create([focal, focal, 319.5, 239.5])
    tilt = np.deg2rad(rng.uniform(20.0, 50.0, COUNT))
    around = rng.uniform(0.0, 2.0 * np.pi, COUNT)
    turns = Rotation.from_rotvec(np.stack([tilt * np.cos(around), tilt * np.sin(around), 0.0 * tilt], axis=1))
    rotation = turns.as_matrix() @ FACING
    middle = BOARD.points.mean(axis=0)
    distance = focal * np.ptp(BOARD.points[:, 0]) / (0.6 * SIZE[0])
    translation = np.array([0.0, 0.0, distance]) - rotation @ middle
    places = -0.1 * np.arange(cameras)[:, None] * np.array([1.0, 0.0, 0.0])
    frames = []
    for place in places:
        in_camera = np.einsum("fij,nj->fni", rotation, BOARD.points) + (translation + place)[:, None]
        pixels = np.asarray(lens.project(in_camera)) + rng.normal(0.0, NOISE_PX, (*in_camera.shape[:2], 2))
        frame, point = np.indices(pixels.shape[:2]).reshape(2, -1)
        inside = np.all((pixels > 0) & (pixels < np.array(SIZE) - 1), axis=-1).ravel()
        detections = Detections(
            10**8 * np.arange(COUNT), frame[inside], point[inside], pixels.reshape(-1, 2)[inside], SIZE
        )
        frames.append(camera_frames(detections, BOARD, "cam"))
    start, moved = rotation.copy(), translation.copy()
    start[mirrored], moved[mirrored] = mirrored_poses(rotation[mirrored], translation[mirrored], middle)
    problem, state = solving.camera_problem(
        [lens] * cameras,
        frames,
        BOARD,
        views=[np.arange(COUNT)] * cameras,
        weights=[np.full(f.seen.shape, NOISE_PX**-2.0) for f in frames],
        T_cam_rig=(np.tile(np.eye(3), (cameras, 1, 1)), places),
        T_target_rig=(start.swapaxes(-1, -2), -np.einsum("fji,fj->fi", start, moved)),
        loss_width=2.5,
    )
    truth = np.linalg.inv(matrix(rotation, translation))
    return problem, state, truth[:, :3, :3], truth[:, :3, 3]


def turn_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.rad2deg(Rotation.from_matrix(a @ b.swapaxes(-1, -2)).magnitude())


@pytest.mark.parametrize("cameras", [1, 2])
def test_views_in_mirrored_poses_are_turned_over_and_others_left(cameras: int) -> None:
    """Ten degrees of view: the board and its mirror image differ by a few tenths of a pixel."""
    focal = 3600.0 if cameras == 1 else 2400.0
    problem, state, rotation, _ = problem_with_mirrored(focal, [1, 4, 6], cameras)
    before = turn_deg(np.asarray(state.rotations)[:COUNT], rotation)
    assert before[[1, 4, 6]].min() > 30.0
    turned = turn_mirrored(problem, state, 100)
    assert turn_deg(np.asarray(turned.rotations)[:COUNT], rotation).max() < 8.0
    others = np.setdiff1d(np.arange(len(state.rotations)), [1, 4, 6])
    np.testing.assert_array_equal(np.asarray(turned.rotations)[others], np.asarray(state.rotations)[others])
    np.testing.assert_array_equal(np.asarray(turned.positions)[others], np.asarray(state.positions)[others])


def test_nothing_is_solved_where_perspective_tells_them_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state, *_ = problem_with_mirrored(500.0, [], 1)

    def never(*_: object, **__: object) -> None:
        raise AssertionError("a wide lens needs no second look")

    monkeypatch.setattr("jaxcal.calibration.mirrored.solve", never)
    assert turn_mirrored(problem, state, 100) is state


def test_corners_that_cannot_be_projected_and_views_without_any_are_survived() -> None:
    problem, state, rotation, _ = problem_with_mirrored(3600.0, [2], 1)
    weight = np.array(problem.corners[0].weight)
    weight[3] = 0.0
    problem = eqx.tree_at(lambda p: p.corners[0].weight, problem, on_device(weight))
    positions = np.array(state.positions)
    positions[5] = [0.0, 0.0, np.nan]
    turned = turn_mirrored(problem, eqx.tree_at(lambda s: s.positions, state, on_device(positions)), 100)
    assert turn_deg(np.asarray(turned.rotations)[:COUNT], rotation)[2] < 8.0
    np.testing.assert_array_equal(np.asarray(turned.rotations)[3], np.asarray(state.rotations)[3])
