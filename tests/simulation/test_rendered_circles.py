"""Rendered circle grids: discs where they are printed, dark inside, and antialiased as brute force says."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.cameras import PinholeRadtan
from jaxcal.simulation.pattern import BLACK, WHITE, pattern_of
from jaxcal.simulation.render import blur_px, near_edges, pixel_rays, plane_from_camera, render, surface_of
from jaxcal.simulation.rig import _transform
from jaxcal.targets import CircleGrid

SIZE = (320, 240)
PSF = 0.6
MODEL = PinholeRadtan.create([210.0, 212.0, 161.3, 118.2], [-0.30, 0.09, 0.0007, -0.0004])
GRIDS = {
    "symmetric": CircleGrid(4, 5, 0.1),
    "asymmetric": CircleGrid(5, 3, 0.08, asymmetric=True, diameter=0.06),
    "asymmetric with even rows": CircleGrid(4, 3, 0.08, asymmetric=True),
}


@pytest.fixture(scope="module")
def rays():
    return pixel_rays(MODEL, SIZE)


def pose_of(grid: CircleGrid, tilt: list[float]) -> np.ndarray:
    shift = _transform([0.0, 0.0, 0.0], -grid.points.mean(axis=0))
    return _transform(tilt, [0.0, 0.0, 0.6]) @ _transform([np.pi, 0.0, 0.0], [0.0, 0.0, 0.0]) @ shift


def image_of(grid: CircleGrid, pose: np.ndarray, rays) -> np.ndarray:
    matrices = jnp.asarray(plane_from_camera(pose[None]))
    image = render(rays, matrices, surface_of(pattern_of(grid)), blur_px(PSF))
    return np.asarray(image[0]).reshape(SIZE[::-1])


def supersampled(grid: CircleGrid, pose: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Intensities by exact rays through a dense grid of samples, weighted by the pixel's box and the lens' Gaussian."""
    knots = np.linspace(-3.0, 3.0, 25) * PSF
    weights = np.exp(-0.5 * (knots / PSF) ** 2)
    offsets = (knots[:, None] + (np.arange(3) + 0.5) / 3.0 - 0.5).ravel()
    weights = np.repeat(weights / weights.sum(), 3) / 3.0
    around = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    rays = np.asarray(MODEL.unproject(jnp.asarray(pixels[:, None] + around)))
    on_plane = rays @ np.linalg.inv(pose[:3][:, [0, 1, 3]]).T
    place = on_plane[..., :2] / on_plane[..., 2:]
    nearest = np.min([np.linalg.norm(place - centre, axis=-1) for centre in grid.points[:, :2]], axis=0)
    values = np.where(nearest < grid.circle_diameter / 2, BLACK, WHITE)
    return values @ np.outer(weights, weights).ravel()


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
def test_closed_form_agrees_with_supersampling(grid: CircleGrid, rays) -> None:
    pose = pose_of(grid, [0.35, -0.45, 0.3])
    image = image_of(grid, pose, rays)
    centres = np.asarray(MODEL.project(jnp.asarray(grid.points @ pose[:3, :3].T + pose[:3, 3])))
    around = np.stack(np.meshgrid(np.arange(-12, 13, 4), np.arange(-12, 13, 4)), axis=-1).reshape(-1, 2)
    pixels = np.round(centres[len(centres) // 2 + 1]) + around
    expected = supersampled(grid, pose, pixels)
    assert np.ptp(expected) > 0.8  # dark, light and the rim are all there
    found = image[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    np.testing.assert_allclose(found, expected, atol=0.012)


def test_pixels_away_from_the_rims_keep_their_colour(rays) -> None:
    grid = GRIDS["asymmetric"]
    pose = pose_of(grid, [0.2, 0.3, 0.5])
    image = image_of(grid, pose, rays).ravel()
    matrix = jnp.asarray(plane_from_camera(pose[None])[0])
    close = np.asarray(near_edges(rays, matrix, surface_of(pattern_of(grid)), 3.5 * blur_px(PSF)))
    away = image[~close]
    assert 0.05 < close.mean() < 0.6
    assert np.mean(np.abs(away - BLACK) < 0.002) > 0.02
    distance = np.abs(away[:, None] - np.array([BLACK, WHITE, 0.25])).min(axis=1)
    assert distance.max() < 0.002
