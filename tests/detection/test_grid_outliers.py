"""Corners that contradict their neighbours are found; the others, distorted lens or not, are kept."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import AprilGrid
from jaxcal.detection.homography import apply_homography, fit_homography
from jaxcal.detection.outliers import agreeing_corners

SIZE = (640, 480)
BOARD = AprilGrid(6, 6, 0.088, 0.3).points[:, :2]


def distorted_view(seed: int, noise: float) -> np.ndarray:
    """Pixels of the board through a tilted view and strong radial distortion (k1 = -0.3 at focal length 450)."""
    rng = np.random.default_rng(seed)
    tilt_x, tilt_y, roll = rng.uniform(-0.4, 0.4, 3)
    homography = np.array(
        [[np.cos(roll), -np.sin(roll), -0.3], [np.sin(roll), np.cos(roll), -0.3], [tilt_x, tilt_y, 0.8]]
    )
    plane = apply_homography(homography, BOARD)
    radius = np.sum(plane**2, axis=1, keepdims=True)
    centre = np.array([310.0, 255.0])  # of distortion, off the image's
    return centre + 450.0 * plane * (1.0 - 0.3 * radius + 0.07 * radius**2) + rng.normal(0.0, noise, plane.shape)


@given(seed=st.integers(0, 10**6), noise=st.floats(0.0, 0.3))
@settings(deadline=None, max_examples=40)
def test_good_corners_are_kept(seed: int, noise: float) -> None:
    assert agreeing_corners(BOARD, distorted_view(seed, noise), SIZE).mean() > 0.97


@given(seed=st.integers(0, 10**6), share=st.floats(0.01, 0.16))
@settings(deadline=None, max_examples=40)
def test_corners_four_pixels_off_are_rejected(seed: int, share: float) -> None:
    pixels = distorted_view(seed, 0.1)
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(pixels)) < share
    angle = rng.uniform(0, 2 * np.pi, wrong.sum())
    pixels[wrong] += rng.uniform(4.0, 30.0, (wrong.sum(), 1)) * np.column_stack([np.cos(angle), np.sin(angle)])
    kept = agreeing_corners(BOARD, pixels, SIZE)
    assert not kept[wrong].any()
    assert kept[~wrong].mean() > 0.97


@given(seed=st.integers(0, 10**6), count=st.integers(4, 30))
@settings(deadline=None, max_examples=40)
def test_homographies_are_recovered(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    truth = np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))
    truth[:2, 2] += rng.uniform(-500, 500, 2)
    source = np.concatenate([[[0, 0], [1, 0], [1, 1], [0, 1]], rng.random((count - 4, 2))])
    destination = apply_homography(truth, source)
    found = fit_homography(source, destination)
    assert np.allclose(found / found[2, 2], truth / truth[2, 2], rtol=1e-5, atol=1e-5)
    mapped = apply_homography(found, source)
    assert np.abs(mapped - destination).max() < 1e-9 * np.abs(destination).max()
    stacked = fit_homography(np.stack([source, source[::-1]]), np.stack([destination, destination[::-1]]))
    assert np.allclose(apply_homography(stacked, source), destination, rtol=1e-9)
