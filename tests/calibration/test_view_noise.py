"""The noise of single views: told from the model's errors, and taken as equal where it is."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import Detections
from jaxcal.calibration.assemble import CameraFrames, camera_frames
from jaxcal.calibration.redundancy import Redundancy
from jaxcal.calibration.view_noise import share_of_place, view_noise, weigh_views
from jaxcal.targets import Checkerboard

BOARD = Checkerboard(rows=8, cols=9, spacing=0.1)
PLACES = BOARD.points[:, :2]


def _seen(rng: np.random.Generator, views: int, share: float = 0.8) -> np.ndarray:
    return rng.random((views, len(PLACES))) < share


@given(seed=st.integers(0, 10_000), views=st.integers(12, 80))
@settings(max_examples=40, deadline=None)
def test_views_that_are_alike_all_get_exactly_one(seed: int, views: int) -> None:
    rng = np.random.default_rng(seed)
    errors = rng.standard_normal((views, len(PLACES), 2))
    assert (view_noise(errors, _seen(rng, views), PLACES) == 1.0).all()


@given(seed=st.integers(0, 10_000), factor=st.floats(2.5, 4.0))
@settings(max_examples=40, deadline=None)
def test_blurred_views_are_told_whatever_smooth_error_all_views_have(seed: int, factor: float) -> None:
    """A smooth displacement over the board is the model's error; it changes nothing."""
    rng = np.random.default_rng(seed)
    views = 60
    blurred = np.arange(views) % 3 == 0
    errors = rng.standard_normal((views, len(PLACES), 2)) * np.where(blurred, factor, 1.0)[:, None, None]
    x, y = (PLACES - PLACES.mean(axis=0)).T / 0.4
    bend = np.stack([1.0 + x * y, x - y**2], axis=1)
    bent = errors + 5.0 * rng.standard_normal((views, 1, 1)) * bend
    seen = _seen(rng, views)
    noise = view_noise(bent, seen, PLACES)
    assert np.allclose(noise, view_noise(errors, seen, PLACES), rtol=1e-9)
    assert np.allclose(noise[blurred] / np.median(noise[~blurred]), factor, rtol=0.35)
    assert abs(np.median(noise[~blurred]) - 1.0) < 0.15


def test_views_with_few_corners_say_nothing_of_their_noise() -> None:
    rng = np.random.default_rng(0)
    errors = rng.standard_normal((40, len(PLACES), 2)) * np.where(np.arange(40) < 20, 1.0, 4.0)[:, None, None]
    seen = _seen(rng, 40)
    seen[5] = False
    seen[5, :7] = True
    noise = view_noise(errors, seen, PLACES)
    assert noise[5] == 1.0
    assert (noise[np.arange(40) != 5] != 1.0).any()


def _frames(rng: np.random.Generator, views: int) -> CameraFrames:
    """Boards of 80 x 70 px anywhere in a 640 x 480 image."""
    count = len(PLACES)
    corner = rng.uniform([10, 10], [540, 400], (views, 1, 2))
    pixels = (corner + 100.0 * PLACES).reshape(-1, 2)
    frame = np.repeat(np.arange(views), count)
    return camera_frames(
        Detections(1000 * np.arange(views), frame, np.tile(np.arange(count), views), pixels, (640, 480)), BOARD, "cam0"
    )


@given(seed=st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_only_what_goes_by_the_place_in_the_image_counts_as_a_lean_lens(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = _frames(rng, 120)
    kept = frames.seen
    noise = rng.standard_normal((*kept.shape, 2))
    of_points = 3.0 * rng.standard_normal((1, kept.shape[1], 2))  # a detector's bias, or a misprint
    assert abs(share_of_place(frames, noise, kept)) < 0.02
    assert abs(share_of_place(frames, noise + of_points, kept)) < 0.02
    waves = np.sin(frames.pixels / 40.0)  # mean square one half in each coordinate
    assert abs(share_of_place(frames, noise + waves, kept) - 1.0 / 3.0) < 0.12


def test_a_lean_lens_keeps_its_rim() -> None:
    """Noisy views count less outright where the lens is right; beside their look-alikes alone where it is not."""
    rng = np.random.default_rng(1)
    frames = _frames(rng, 200)
    noisy = frames.pixels[:, :, 0].mean(axis=1) > 320.0
    errors = rng.standard_normal((*frames.seen.shape, 2)) * np.where(noisy, 4.0, 1.0)[:, None, None]
    alike = Redundancy(np.ones(200), 1.0, 0.5)
    weights, noise = weigh_views(frames, errors, frames.seen, PLACES, alike)
    assert weights is alike
    assert np.median(noise[noisy]) > 3.0 * np.median(noise[~noisy])
    lean = errors + 4.0 * np.sin(frames.pixels / 40.0)
    weights, noise = weigh_views(frames, lean, frames.seen, PLACES, alike)
    assert (noise == 1.0).all()
    assert np.median(weights.weights[noisy]) > 0.5 * np.median(weights.weights[~noisy])
