"""Projection uncertainty is what a change of the lens does to projections once the camera has moved to undo it."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_erosion
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxcal.cameras import CameraModel, PinholeEquidistant, PinholeRadtan, camera_model
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections
from jaxcal.results import Calibration, CameraCalibration, load_calibration, projection_uncertainty
from jaxcal.results.projection_uncertainty import can_be_told, projection_covariance
from jaxcal.targets import Checkerboard

BOARD = Checkerboard(rows=5, cols=6, spacing=0.05)
SIZE = (640, 480)
SPLINED = camera_model("splined-3-10-8-110").from_focal(380.0, SIZE)
LENSES: dict[str, CameraModel] = {
    "radtan": PinholeRadtan.create([430.0, 433.0, 321.0, 238.0], [-0.25, 0.07, 0.0007, -0.0005]),
    "equidistant": PinholeEquidistant.create([380.0, 378.0, 316.0, 243.0], [0.02, -0.01, 0.004, -0.001]),
    "splined": SPLINED.with_parameters(
        SPLINED.parameters + jnp.asarray(np.append(np.zeros(4), np.random.default_rng(3).normal(0, 0.01, 160)))
    ),
}
PIXELS = np.array([[319.5, 239.5], [60.0, 50.0], [560.0, 420.0], [130.0, 400.0], [600.0, 240.0]])


def calibration_with(lens: CameraModel, covariance: np.ndarray, views: int = 14) -> Calibration:
    """A camera that saw the board without noise in poses all over its image; `covariance` of its lens."""
    rng = np.random.default_rng(5)
    poses, pixels = [], []
    while len(poses) < views:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        T[:3, 3] = -T[:3, :3] @ BOARD.points.mean(axis=0) + rng.uniform([-0.3, -0.25, 0.35], [0.3, 0.25, 0.7])
        places = BOARD.points @ T[:3, :3].T + T[:3, 3]
        seen, real = project(lens, places), np.asarray(jax.vmap(lens.is_valid)(jnp.asarray(places)))
        if real.all() and np.all((seen > 5) & (seen < np.array(SIZE) - 6)):
            poses.append(T)
            pixels.append(seen)
    count = len(BOARD.points)
    detections = Detections(
        1000 * np.arange(views), np.repeat(np.arange(views), count), np.tile(np.arange(count), views),
        np.concatenate(pixels), SIZE,
    )  # fmt: skip
    camera = CameraCalibration(
        name="cam0", model=lens, image_size=SIZE, T_cn_cnm1=None, T_cam_imu=None, timeshift_cam_imu=None,
        detections=detections, residuals_px=np.zeros((views * count, 2)), inlier=np.ones(views * count, dtype=bool),
        corner_sigma_px=0.1, T_cam_target=np.stack(poses),
    )  # fmt: skip
    blocks = (("cam0.intrinsics", 4), ("cam0.distortion", len(covariance) - 4))
    return Calibration((camera,), BOARD, None, None, blocks, covariance, np.zeros(1))


def project(lens: CameraModel, points: np.ndarray) -> np.ndarray:
    return np.asarray(_project(lens, jnp.asarray(points)))


@eqx.filter_jit
def _project(lens: CameraModel, points: jnp.ndarray) -> jnp.ndarray:
    return lens.project(points)


def moved_pixels(calibration: Calibration, other: CameraModel, range_m: float | None) -> np.ndarray:
    """Where `other` projects what the calibration's lens shows at PIXELS, the camera moved by non-linear least squares
    over all corners."""
    (camera,) = calibration.cameras
    assert camera.T_cam_target is not None
    T = camera.T_cam_target
    corners = (np.einsum("fij,nj->fni", T[:, :3, :3], BOARD.points) + T[:, None, :3, 3]).reshape(-1, 3)
    wanted = project(camera.model, corners)

    def place(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
        return Rotation.from_rotvec(motion[:3]).apply(points) + motion[3:]

    fit = least_squares(
        lambda m: (project(other, place(m, corners)) - wanted).ravel(),
        np.zeros(6),
        x_scale=1e-3,
        xtol=1e-15,
        ftol=1e-15,
    )
    far = 1e9 if range_m is None else range_m
    return project(other, place(fit.x, far * np.array(camera.model.unproject(PIXELS))))


@pytest.mark.parametrize("range_m", [None, 0.5])
@pytest.mark.parametrize("kind", LENSES)
def test_one_change_of_the_lens_moves_projections_as_stated(kind: str, range_m: float | None) -> None:
    """A covariance of rank one is a single change: the stated covariance is the square of what it does."""
    lens = LENSES[kind]
    rng = np.random.default_rng(1)
    size = np.append([0.3, 0.3, 0.3, 0.3], np.full(lens.num_parameters - 4, 3e-4))
    change = 1e-2 * size * rng.standard_normal(lens.num_parameters)
    calibration = calibration_with(lens, np.outer(change, change))
    moved = moved_pixels(calibration, lens.with_parameters(lens.parameters + change), range_m) - PIXELS
    stated = projection_covariance(calibration, "cam0", PIXELS, range_m)
    expected = np.einsum("ki,kj->kij", moved, moved)
    np.testing.assert_allclose(stated, expected, atol=5e-3 * np.max(expected))


def spread(lens: CameraModel, seed: int) -> np.ndarray:
    """A covariance of the lens that is positive definite."""
    root = np.random.default_rng(seed).standard_normal((lens.num_parameters, lens.num_parameters))
    scale = np.append(np.full(4, 0.3), np.full(lens.num_parameters - 4, 1e-3))
    return (root @ root.T / lens.num_parameters) * np.outer(scale, scale)


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 1000), factor=st.floats(0.1, 10.0), range_m=st.floats(0.1, 50.0))
def test_covariances_are_positive_and_scale(seed: int, factor: float, range_m: float) -> None:
    lens = LENSES["radtan"]
    calibration = calibration_with(lens, spread(lens, seed))
    stated = projection_covariance(calibration, 0, PIXELS, range_m)
    np.testing.assert_allclose(stated, stated.swapaxes(1, 2), rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(stated).min() > 0
    larger = dataclasses.replace(calibration, covariance=factor**2 * calibration.covariance)
    np.testing.assert_allclose(projection_covariance(larger, 0, PIXELS, range_m), factor**2 * stated, rtol=1e-9)


def test_far_points_are_at_infinity_and_near_ones_are_worse() -> None:
    calibration = calibration_with(LENSES["radtan"], spread(LENSES["radtan"], 0))
    at_infinity = projection_covariance(calibration, 0, PIXELS)
    np.testing.assert_allclose(projection_covariance(calibration, 0, PIXELS, 1e7), at_infinity, rtol=1e-4)
    near = projection_uncertainty(calibration, 0, range_m=0.05)
    usual = projection_uncertainty(calibration, 0, range_m=0.5)
    assert near.centre_px > 2.0 * usual.centre_px


def test_parameters_without_variance_do_nothing() -> None:
    lens = LENSES["splined"]
    covariance = np.zeros((lens.num_parameters, lens.num_parameters))
    assert np.all(projection_covariance(calibration_with(lens, covariance), 0, PIXELS) == 0.0)


def test_the_grid_the_region_and_the_summary() -> None:
    lens = LENSES["radtan"]
    calibration = calibration_with(lens, spread(lens, 2))
    found = projection_uncertainty(calibration, "cam0")
    assert found.pixels.shape == (40, 60, 2)
    np.testing.assert_array_equal(found.pixels[[0, -1], [0, -1]], [[0.0, 0.0], [639.0, 479.0]])
    expected = projection_covariance(calibration, "cam0", found.pixels[7, 11][None])[0]
    np.testing.assert_allclose(found.covariance[7, 11], expected, rtol=1e-9)
    assert found.sigma_px[7, 11] == pytest.approx(np.sqrt(np.linalg.eigvalsh(expected)[1]))
    low, high = (
        calibration.cameras[0].detections.pixels.min(axis=0),
        calibration.cameras[0].detections.pixels.max(axis=0),
    )
    inside = found.pixels[found.observed]
    cell = np.array([640 / 60, 480 / 40])
    assert np.all(inside > low - cell)
    assert np.all(inside < high + cell)
    assert found.worst_px == found.sigma_px[found.observed].max()
    rim = found.observed & ~binary_erosion(found.observed)
    assert found.rim_px == np.median(found.sigma_px[rim])
    assert "at infinity" in found.sentence
    assert f"{found.worst_px:.2g} px at worst" in found.sentence


def test_pixels_that_no_ray_reaches_are_nan() -> None:
    """A strongly distorted polynomial folds over before the image's corners; where corners were seen it does not."""
    lens = PinholeRadtan.create([300.0, 300.0, 319.5, 239.5], [-0.25, 0.0, 0.0, 0.0])
    found = projection_uncertainty(calibration_with(lens, spread(lens, 4)), 0)
    assert np.isnan(found.sigma_px[[0, 0, -1, -1], [0, -1, 0, -1]]).all()
    assert np.isfinite(found.sigma_px[found.observed]).all()
    assert np.isfinite([found.centre_px, found.rim_px, found.worst_px]).all()


def test_precise_corners_hold_the_camera_faster() -> None:
    """With one view far more precise than the others, the camera moves so that the lens's change is undone there: that
    leaves a good deal less of it in this place."""
    lens = LENSES["radtan"]
    calibration = calibration_with(lens, spread(lens, 6))
    (camera,) = calibration.cameras
    one = camera.detections.frame == 3
    precise = dataclasses.replace(camera.detections, precision=np.where(one, 1e4, 1.0))
    weighted = dataclasses.replace(calibration, cameras=(dataclasses.replace(camera, detections=precise),))
    assert camera.T_cam_target is not None
    T = camera.T_cam_target[3]
    places = BOARD.points @ T[:3, :3].T + T[:3, 3]
    range_m = float(np.linalg.norm(places, axis=1).mean())
    there = project(lens, places)
    size = [
        np.sqrt(np.trace(projection_covariance(c, 0, there, range_m), axis1=1, axis2=2)).mean()
        for c in (calibration, weighted)
    ]
    assert size[1] < 0.7 * size[0]


def test_a_saved_calibration_gives_the_same(tmp_path: Path) -> None:
    calibration = calibration_with(LENSES["equidistant"], spread(LENSES["equidistant"], 7))
    calibration.save(tmp_path)
    again = projection_uncertainty(load_calibration(tmp_path), "cam0", range_m=2.0)
    np.testing.assert_array_equal(again.covariance, projection_uncertainty(calibration, 0, range_m=2.0).covariance)


def test_what_cannot_be_told_is_refused() -> None:
    calibration = calibration_with(LENSES["radtan"], spread(LENSES["radtan"], 0))
    (camera,) = calibration.cameras
    assert can_be_told(calibration, camera)
    with pytest.raises(CalibrationError, match=r"no camera is called 'left'\. This calibration has: cam0"):
        projection_uncertainty(calibration, "left")
    with pytest.raises(CalibrationError, match="range -1"):
        projection_uncertainty(calibration, 0, range_m=-1.0)
    with pytest.raises(CalibrationError, match="grid of 1 x 5"):
        projection_uncertainty(calibration, 0, grid=(1, 5))
    bare = dataclasses.replace(camera, T_cam_target=None)
    old = dataclasses.replace(calibration, cameras=(bare,))
    assert not can_be_told(old, bare)
    with pytest.raises(CalibrationError, match="cam0: 0 corners with a known pose"):
        projection_uncertainty(old, 0)
    unknown = dataclasses.replace(calibration, blocks=(), covariance=np.zeros((0, 0)))
    assert not can_be_told(unknown, camera)
    with pytest.raises(CalibrationError, match="no covariance of the lens"):
        projection_uncertainty(unknown, 0)
