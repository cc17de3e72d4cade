"""Rendered images show the pattern where the camera model projects it, with the blur asked for."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.cameras import PinholeEquidistant, PinholeRadtan
from jaxcal.errors import CalibrationError
from jaxcal.simulation.measurements import project_points
from jaxcal.simulation.pattern import BACKGROUND, BLACK, WHITE, Pattern, pattern_of
from jaxcal.simulation.render import blur_px, near_edges, pixel_rays, plane_from_camera, render, render_some, surface_of
from jaxcal.simulation.rig import _transform
from jaxcal.targets import AprilGrid, Checkerboard
from jaxcal.targets.base import Target

SIZE = (320, 240)
PSF = 0.6
MODELS = {
    "pinhole-radtan": PinholeRadtan.create([210.0, 212.0, 161.3, 118.2], [-0.30, 0.09, 0.0007, -0.0004]),
    "pinhole-equi": PinholeEquidistant.create([150.0, 151.0, 158.8, 121.7], [0.02, -0.01, 0.004, -0.001]),
}
RAYS = {name: pixel_rays(model, SIZE) for name, model in MODELS.items()}
TARGETS = {"checkerboard": Checkerboard(5, 6, 0.1), "aprilgrid": AprilGrid(2, 2, 0.3, 0.3)}


def _pose(target, tilt, distance=1.0):
    """T_cam_target: the board's centre `distance` ahead, turned by the rotation vector `tilt`."""
    centre = target.points.mean(axis=0)
    return _transform(tilt, [0.0, 0.0, distance]) @ _transform([np.pi, 0.0, 0.0], [0.0, 0.0, 0.0]) @ _shift(-centre)


def _shift(by):
    return _transform([0.0, 0.0, 0.0], by)


def _image(model, target, pose):
    matrices = jnp.asarray(plane_from_camera(pose[None]))
    image = render(RAYS[model], matrices, surface_of(pattern_of(target)), blur_px(PSF))
    return np.asarray(image[0]).reshape(SIZE[::-1])


def _supersampled(model, pattern, pose, pixels):
    """Intensities at `pixels` (N, 2) by brute force: exact rays, the pixel's box and a Gaussian, densely sampled."""
    knots = np.linspace(-3.0, 3.0, 25) * PSF
    weights = np.exp(-0.5 * (knots / PSF) ** 2)
    offsets = (knots[:, None] + (np.arange(3) + 0.5) / 3.0 - 0.5).ravel()
    weights = np.repeat(weights / weights.sum(), 3) / 3.0
    grid = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    rays = np.asarray(MODELS[model].unproject(jnp.asarray(pixels[:, None] + grid)))
    on_plane = rays @ np.linalg.inv(pose[:3][:, [0, 1, 3]]).T
    x, y = on_plane[..., 0] / on_plane[..., 2], on_plane[..., 1] / on_plane[..., 2]
    padded = np.pad(pattern.reflectance, 1, constant_values=pattern.background)
    values = padded[np.searchsorted(pattern.y_lines, y), np.searchsorted(pattern.x_lines, x)]
    return values @ np.outer(weights, weights).ravel()


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("model", MODELS)
def test_closed_form_agrees_with_supersampling(model, target):
    target = TARGETS[target]
    pose = _pose(target, [0.35, -0.45, 0.3])
    image = _image(model, target, pose)
    corners = np.asarray(MODELS[model].project(jnp.asarray(target.points @ pose[:3, :3].T + pose[:3, 3])))
    around = np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), axis=-1).reshape(-1, 2)
    pixels = (np.round(corners[[len(corners) // 2]])[:, None] + around).reshape(-1, 2)
    expected = _supersampled(model, pattern_of(target), pose, pixels)
    found = image[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    # A Gaussian stands for the pixel's box: that is the difference that remains.
    np.testing.assert_allclose(found, expected, atol=0.01)


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("model", MODELS)
# The same examples in every run: at one in some hundred poses cornerSubPix itself errs by more than the bounds.
@settings(deadline=None, max_examples=10, derandomize=True)
# Further away, the next tag's corner comes within reach of cornerSubPix' window and the blur: 11 px.
@given(tilt=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(-3.0, 3.0)), distance=st.floats(0.6, 0.85))
def test_corners_found_in_the_image_are_the_projected_ones(model, target, tilt, distance):
    target = TARGETS[target]
    pose = _pose(target, tilt, distance)
    pixels, real = project_points(MODELS[model], jnp.asarray(pose[None]), jnp.asarray(target.points))
    pixels = np.asarray(pixels[0])
    inside = np.asarray(real[0]) & np.all((pixels > 10) & (pixels < np.array(SIZE) - 11), axis=1)
    image = _image(model, target, pose)
    expected = pixels[inside].astype(np.float32)
    # cornerSubPix itself errs by 0.02 px, depending on where in a pixel the corner lies; less in a softer image.
    soft = cv2.GaussianBlur((255.0 * image).astype(np.float32), (0, 0), 0.7)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    found = cv2.cornerSubPix(soft, expected.reshape(-1, 1, 2).copy(), (3, 3), (-1, -1), stop).reshape(-1, 2)
    error = found - expected
    assert len(error) >= 6
    # A shifted rendering shows in the mean; the scatter is that of cornerSubPix (up to 0.05 px at single corners).
    assert np.all(np.abs(error.mean(axis=0)) < 0.02)
    assert np.sqrt(np.mean(error**2)) < 0.04


def test_pixels_away_from_edges_keep_their_colour_and_the_others_are_named():
    target = TARGETS["checkerboard"]
    surface = surface_of(pattern_of(target))
    pose = _pose(target, [0.2, 0.3, 0.5])
    matrices = jnp.asarray(plane_from_camera(pose[None]))
    image = np.asarray(render(RAYS["pinhole-radtan"], matrices, surface, blur_px(PSF))[0])
    close = np.asarray(near_edges(RAYS["pinhole-radtan"], matrices[0], surface, 3.5 * blur_px(PSF)))
    assert 0.05 < close.mean() < 0.5
    away = image[~close]
    assert np.all(np.min(np.abs(away[:, None] - np.array([BLACK, WHITE, BACKGROUND])), axis=1) < 0.002)
    chosen = np.flatnonzero(close)[::7].astype(np.int32)
    some = render_some(RAYS["pinhole-radtan"], jnp.asarray(chosen), matrices, surface, blur_px(PSF))
    np.testing.assert_allclose(np.asarray(some)[0], image[chosen], atol=1e-5)


def test_rays_are_those_of_the_camera_model():
    for name, model in MODELS.items():
        pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).reshape(-1, 2)[::997]
        rays = np.asarray(RAYS[name].ray).T[::997]
        np.testing.assert_allclose(model.project(jnp.asarray(rays, dtype=jnp.float64)), pixels, atol=2e-3)
        nudged = rays + np.asarray(RAYS[name].per_pixel)[:, 0].T[::997] * 0.1
        moved = np.asarray(model.project(jnp.asarray(nudged, dtype=jnp.float64))) - pixels
        np.testing.assert_allclose(moved, np.broadcast_to([0.1, 0.0], moved.shape), atol=4e-3)


def test_nothing_of_the_board_appears_beyond_the_horizon():
    target = TARGETS["checkerboard"]
    pose = _pose(target, [1.35, 0.0, 0.0], 0.8)
    image = _image("pinhole-radtan", target, pose)
    in_camera = np.asarray(RAYS["pinhole-radtan"].ray).T @ plane_from_camera(pose[None])[0].T
    beyond = (in_camera[:, 2] <= 0).reshape(image.shape)
    assert beyond.mean() > 0.1
    np.testing.assert_allclose(image[beyond], BACKGROUND, atol=1e-6)
    # And far from the board on the near side of the horizon there is plain background, too.
    assert np.mean(np.abs(image - BACKGROUND) > 0.01) < 0.4


def test_the_back_of_the_board_is_plain():
    target = TARGETS["checkerboard"]
    front = _pose(target, [0.2, 0.1, 0.0])
    centre = target.points.mean(axis=0)
    behind = front @ _shift(centre) @ _transform([0.0, np.pi, 0.0], [0.0, 0.0, 0.0]) @ _shift(-centre)
    assert np.ptp(_image("pinhole-radtan", target, front)) > 0.8
    np.testing.assert_allclose(_image("pinhole-radtan", target, behind), BACKGROUND, atol=1e-6)
    # Measurements agree: nothing is seen from behind.
    _, real = project_points(MODELS["pinhole-radtan"], jnp.asarray(behind[None]), jnp.asarray(target.points))
    assert not np.any(real)


def test_pixels_that_no_ray_reaches_show_the_background():
    # With this distortion the image ends at a radius of 0.61 focal lengths; beyond it there are no rays.
    model = PinholeRadtan.create([100.0, 100.0, 79.5, 59.5], [-0.4, 0.0, 0.0, 0.0])
    rays = pixel_rays(model, (160, 120))
    dark = np.all(np.asarray(rays.ray) == 0.0, axis=0)
    assert 0.05 < dark.mean() < 0.5
    assert np.all(np.isfinite(np.asarray(rays.per_pixel)))
    target = TARGETS["checkerboard"]
    matrices = jnp.asarray(plane_from_camera(_pose(target, [0.1, 0.0, 0.0], 0.5)[None]))
    image = np.asarray(render(rays, matrices, surface_of(pattern_of(target)), blur_px(PSF))[0])
    np.testing.assert_allclose(image[dark], BACKGROUND, atol=1e-6)
    assert np.ptp(image[~dark]) > 0.8


def test_stock_detectors_know_the_patterns():
    board = Checkerboard(5, 6, 0.1)
    image = np.clip(255 * _image("pinhole-radtan", board, _pose(board, [0.1, 0.2, 0.05])), 0, 255).astype(np.uint8)
    found, corners = cv2.findChessboardCornersSB(image, (6, 5))
    assert found
    assert len(np.reshape(corners, (-1, 2))) == 30

    grid = AprilGrid(2, 3, 0.2, 0.3)
    pose = _pose(grid, [0.1, 0.2, 0.05])
    image = np.clip(255 * _image("pinhole-radtan", grid, pose), 0, 255).astype(np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    tags, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    assert sorted(np.ravel(ids).tolist()) == list(range(6))
    pixels = np.asarray(MODELS["pinhole-radtan"].project(jnp.asarray(grid.points @ pose[:3, :3].T + pose[:3, 3])))
    for corners, tag in zip(tags, np.ravel(ids), strict=True):
        # On a Kalibr board OpenCV's first corner is the lower right one, and it counts clockwise.
        expected = pixels[grid.tag_points(int(tag))[[1, 0, 3, 2]]]
        np.testing.assert_allclose(np.reshape(corners, (4, 2)), expected, atol=4.0)


def test_the_lower_left_square_is_black():
    pattern = pattern_of(Checkerboard(6, 9, 0.1))
    assert isinstance(pattern, Pattern)
    row, col = np.searchsorted(pattern.y_lines, -0.05) - 1, np.searchsorted(pattern.x_lines, -0.05) - 1
    assert pattern.reflectance[row, col] == BLACK
    assert np.all(pattern.reflectance[[0, -1]] == WHITE)
    assert np.all(pattern.reflectance[:, [0, -1]] == WHITE)


def test_an_unknown_target_is_refused():
    class Blank(Target):
        points = np.zeros((1, 3))
        grid_shape = (1, 1)

        def to_yaml(self):
            return {}

    with pytest.raises(CalibrationError, match="Blank"):
        pattern_of(Blank())
