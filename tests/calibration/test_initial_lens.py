"""The first lens is found without a guess from 12 to 190 degrees of view, past outliers; what cannot work is said."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxcal import CalibrationError, CameraModel, Checkerboard, Detections, camera_model
from jaxcal.calibration.assemble import CameraFrames, camera_frames
from jaxcal.calibration.generic_search import spread_views
from jaxcal.calibration.initial_lens import initial_lens
from jaxcal.calibration.lens_poses import board_poses

SIZE = (640, 480)
BOARD = Checkerboard(6, 8, 0.05)
NARROW = camera_model("pinhole-radtan").create([3200.0, 3190.0, 330.0, 230.0], [-0.3, 0.5, 0.0005, -0.0003])
RADTAN = camera_model("pinhole-radtan").create([441.3, 440.2, 315.6, 243.9], [-0.287, 0.083, -0.0004, 0.0003])
# 190 degrees across the image's width.
FISHEYE = camera_model("pinhole-equi").create([193.0, 194.0, 322.0, 236.0], [0.01, -0.004, 0.001, -0.0002])
DOUBLE_SPHERE = camera_model("ds-none").create([-0.15, 0.58, 180.0, 181.0, 318.0, 243.0])


def seen_through(lens: CameraModel, seed: int, count: int = 20, tilt_deg: float = 45.0, noise_px: float = 0.1) -> tuple:
    """Detections of a board all over the image and its true poses (F, 3, 3), (F, 3)."""
    rng = np.random.default_rng(seed)
    tries = 8 * count
    pixels = rng.uniform(0.03, 0.97, (tries, 2)) * SIZE
    sight = np.asarray(lens.unproject(pixels))
    angle, focal = rng.uniform(60.0, 260.0, tries), float(np.asarray(lens.paraxial()[0])[0, 0])
    distance = 0.35 / (2.0 * np.tan(np.minimum(angle / focal, 1.6) / 2.0))
    right = np.cross([0.0, -1.0, 0.0], -sight)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    facing = np.stack([right, np.cross(-sight, right), -sight], axis=-1)
    way, tilt = rng.uniform(0, 2 * np.pi, tries), np.deg2rad(rng.uniform(0, tilt_deg, tries))
    axis = np.stack([np.cos(way), np.sin(way), np.zeros(tries)], axis=1)
    rotation = facing @ Rotation.from_rotvec(tilt[:, None] * axis).as_matrix()
    translation = sight * distance[:, None] - rotation @ BOARD.points.mean(axis=0)
    points = np.einsum("fij,nj->fni", rotation, BOARD.points) + translation[:, None]
    projected = np.asarray(lens.project(points))
    back = np.sum(np.asarray(lens.unproject(projected)) * points, axis=-1) / np.linalg.norm(points, axis=-1)
    inside = np.all((projected > 1.0) & (projected < np.array(SIZE) - 2.0), axis=-1) & (back > 1.0 - 1e-9)
    good = np.flatnonzero(inside.all(axis=1))[:count]
    assert len(good) == count
    corners = len(BOARD.points)
    noisy = projected[good] + noise_px * rng.standard_normal((count, corners, 2))
    detections = Detections(
        1000 * np.arange(count),
        np.repeat(np.arange(count), corners),
        np.tile(np.arange(corners), count),
        noisy.reshape(-1, 2),
        SIZE,
    )
    return detections, rotation[good], translation[good]


def frames_of(detections: Detections) -> CameraFrames:
    return camera_frames(detections, BOARD, "cam0")


def apart(lens: CameraModel, truth: CameraModel, frames: CameraFrames) -> float:
    """Median distance (px) between the images of a ray through a corner, less the shift that a small turn makes."""
    rays = np.asarray(truth.unproject(frames.pixels[frames.seen]))
    away = np.asarray(lens.project(rays)) - np.asarray(truth.project(rays))
    return float(np.median(np.linalg.norm(away - np.median(away, axis=0), axis=1)))


@pytest.mark.parametrize(
    "truth", [NARROW, RADTAN, FISHEYE, DOUBLE_SPHERE], ids=["narrow", "radtan", "fisheye", "double sphere"]
)
def test_lens_and_poses_are_found_without_a_guess(truth: CameraModel) -> None:
    detections, rotation, translation = seen_through(truth, seed=1)
    frames = frames_of(detections)
    lens = initial_lens("cam0", type(truth), frames, BOARD)
    found, place, rms_px = board_poses(lens, frames, BOARD)
    assert rms_px.max() < 0.2  # sqrt(2) x 0.1 px, and a little
    if truth is NARROW:  # its focal length is known to a percent or so; the poses go along with it
        assert np.asarray(lens.intrinsics[:2]) == pytest.approx(3200.0, rel=0.1)
        return
    assert apart(lens, truth, frames) < 0.6
    turn = Rotation.from_matrix(np.swapaxes(found, 1, 2) @ rotation).magnitude()
    assert np.rad2deg(np.median(turn)) < 0.3
    assert np.median(np.linalg.norm(place - translation, axis=1) / np.linalg.norm(translation, axis=1)) < 0.01


@pytest.mark.parametrize("truth", [RADTAN, FISHEYE], ids=["radtan", "fisheye"])
def test_a_fifth_of_wrong_corners_and_a_tenth_of_mislabelled_views(truth: CameraModel) -> None:
    """Corners displaced by up to 50 px; in some views the board's rows and columns are confused."""
    detections, _, _ = seen_through(truth, seed=2)
    rng = np.random.default_rng(5)
    pixels = detections.pixels.copy()
    wrong = rng.random(len(pixels)) < 0.2
    way = rng.uniform(0, 2 * np.pi, wrong.sum())
    pixels[wrong] += rng.uniform(0, 50, (wrong.sum(), 1)) * np.stack([np.cos(way), np.sin(way)], axis=1)
    point = detections.point.reshape(20, -1).copy()
    point[[3, 11]] = BOARD.points.shape[0] - 1 - np.arange(48).reshape(6, 8).T.ravel()
    bad = dataclasses.replace(detections, pixels=np.clip(pixels, -0.5, np.array(SIZE) - 0.5), point=point.reshape(-1))
    frames = frames_of(bad)
    lens = initial_lens("cam0", type(truth), frames, BOARD)
    assert apart(lens, truth, frames_of(detections)) < 1.0


def test_poses_do_not_depend_on_the_other_views_nor_on_what_is_not_seen() -> None:
    detections, _, _ = seen_through(FISHEYE, seed=3)
    frames = frames_of(detections)
    rotation, translation, _ = board_poses(FISHEYE, frames, BOARD)
    some = np.array([4, 0, 9])
    again = board_poses(FISHEYE, frames.take(some), BOARD)
    np.testing.assert_allclose(again[0], rotation[some], atol=1e-6)
    np.testing.assert_allclose(again[1], translation[some], atol=1e-6)
    hidden = np.where(frames.seen[..., None], frames.pixels, 1e9)
    hidden[:, :5] = 1e9
    seen = frames.seen.copy()
    seen[:, :5] = False
    partial = dataclasses.replace(frames, pixels=hidden, seen=seen)
    turn = Rotation.from_matrix(np.swapaxes(board_poses(FISHEYE, partial, BOARD)[0], 1, 2) @ rotation).magnitude()
    assert np.rad2deg(np.median(turn)) < 1.0


def test_a_model_that_cannot_hold_the_lens_is_refused_with_advice() -> None:
    detections, _, _ = seen_through(FISHEYE, seed=4)
    with pytest.raises(CalibrationError, match=r"failed, because pinhole-none cannot hold.*field of view of.*ds-none"):
        initial_lens("cam0", camera_model("pinhole-none"), frames_of(detections), BOARD)


def test_corners_of_no_board_are_refused() -> None:
    detections, _, _ = seen_through(RADTAN, seed=5)
    pixels = np.random.default_rng(0).uniform(0.0, 1.0, detections.pixels.shape) * SIZE
    with pytest.raises(CalibrationError, match="cam0: failed, because no lens explains the views"):
        initial_lens("cam0", type(RADTAN), frames_of(dataclasses.replace(detections, pixels=pixels)), BOARD)


@pytest.mark.parametrize("views", [1, 3])
def test_few_views_give_some_lens(views: int) -> None:
    detections, _, _ = seen_through(RADTAN, seed=6)
    frames = frames_of(detections).take(np.arange(views))
    lens = initial_lens("cam0", type(RADTAN), frames, BOARD)
    assert np.isfinite(lens.parameters).all()
    assert 0.1 * SIZE[0] < float(lens.intrinsics[0]) < 20.0 * SIZE[0]
    assert board_poses(lens, frames, BOARD)[2].max() < 0.3


def test_frontal_views_give_a_common_focal_length() -> None:
    """Nothing tells focal length from distance then; it must not run away."""
    detections, _, _ = seen_through(RADTAN, seed=7, tilt_deg=0.0)
    facing = np.diag([1.0, -1.0, -1.0])
    rng = np.random.default_rng(0)
    place = np.stack([*rng.uniform(-0.5, 0.2, (2, 20)), np.full(20, 1.0)], axis=-1)
    points = (BOARD.points @ facing.T)[None] + place[:, None]
    pixels = np.asarray(RADTAN.project(points)) + 0.1 * rng.standard_normal((20, 48, 2))
    frames = frames_of(dataclasses.replace(detections, pixels=np.clip(pixels, 0, np.array(SIZE) - 1.0).reshape(-1, 2)))
    lens = initial_lens("cam0", type(RADTAN), frames, BOARD)
    assert 0.2 * SIZE[0] < float(lens.intrinsics[0]) < 5.0 * SIZE[0]


def test_collinear_corners_do_not_crash() -> None:
    detections, _, _ = seen_through(RADTAN, seed=8)
    keep = detections.point < 8  # the lowest row
    line = dataclasses.replace(
        detections, frame=detections.frame[keep], point=detections.point[keep], pixels=detections.pixels[keep]
    )
    try:
        lens = initial_lens("cam0", type(RADTAN), frames_of(line), BOARD)
    except CalibrationError:
        return
    assert np.isfinite(lens.parameters).all()


def test_spread_views_are_all_different_and_repeatable() -> None:
    frames = frames_of(seen_through(RADTAN, seed=9)[0])
    chosen = spread_views(frames, 7)
    assert len(set(chosen)) == 7
    np.testing.assert_array_equal(chosen, spread_views(frames, 7))
    np.testing.assert_array_equal(spread_views(frames, 50), np.arange(20))
