"""Poses of a planar board from rays are exact for exact rays, at any angle from the axis, and stand wrong corners."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxcal import Checkerboard
from jaxcal.calibration.initial_poses import mirrored_poses, planar_poses, rotations

BOARD = Checkerboard(5, 7, 0.1).points
SEEDS = st.integers(0, 2**32 - 1)


def random_poses(rng: np.random.Generator, count: int, off_axis_deg: float, distance: float) -> tuple:
    """Boards (R, t) tilted up to 50 degrees from facing the camera, in directions up to `off_axis_deg` off its axis."""
    direction = Rotation.from_rotvec(
        np.deg2rad(rng.uniform(0.0, off_axis_deg, count))[:, None] * unit(rng.standard_normal((count, 2)), pad=True)
    )
    tilt = Rotation.from_rotvec(np.deg2rad(rng.uniform(0, 50, count))[:, None] * unit(rng.standard_normal((count, 3))))
    rotation = (direction * tilt * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))).as_matrix()
    centre = direction.apply([0.0, 0.0, 1.0]) * distance
    return rotation, centre - rotation @ BOARD.mean(axis=0)


def unit(vectors: np.ndarray, pad: bool = False) -> np.ndarray:
    vectors = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([vectors, np.zeros((*vectors.shape[:-1], 1))], axis=-1) if pad else vectors


def rays_of(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    return unit(np.einsum("fij,nj->fni", rotation, BOARD) + translation[:, None])


def turn_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.rad2deg(Rotation.from_matrix(np.swapaxes(first, -1, -2) @ second).magnitude())


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS, off_axis_deg=st.sampled_from([5.0, 60.0, 120.0]), distance=st.sampled_from([0.5, 2.0, 20.0]))
def test_exact_rays_give_exact_poses(seed: int, off_axis_deg: float, distance: float) -> None:
    rng = np.random.default_rng(seed)
    rotation, translation = random_poses(rng, 6, off_axis_deg, distance)
    seen = np.ones((6, len(BOARD)))
    seen[:, rng.permutation(len(BOARD))[:15]] = 0.0
    found = planar_poses(BOARD, rays_of(rotation, translation), seen)
    # A board that is far away says little of its tilt; the normal equations then leave some digits of it.
    assert turn_deg(found[0], rotation).max() < 1e-6 * distance**2
    np.testing.assert_allclose(found[1], translation, atol=1e-8 * distance**2)


@settings(deadline=None, max_examples=10)
@given(seed=SEEDS)
def test_a_fifth_of_the_corners_may_be_wrong(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation, translation = random_poses(rng, 8, 60.0, 1.2)
    rays = rays_of(rotation, translation)
    wrong = rng.permuted(np.tile(np.arange(len(BOARD)) < len(BOARD) // 5, (8, 1)), axis=1)
    rays = unit(rays + 1e-4 * rng.standard_normal(rays.shape))
    rays[wrong] = unit(rays[wrong] + 0.1 * rng.standard_normal((wrong.sum(), 3)))
    found, _ = planar_poses(BOARD, rays, np.ones(wrong.shape))
    assert np.median(turn_deg(found, rotation)) < 0.2
    assert turn_deg(found, rotation).max() < 3.0


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS)
def test_the_mirrored_pose_looks_alike_from_afar_and_mirrors_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation, translation = random_poses(rng, 5, 100.0, 100.0)
    middle = BOARD.mean(axis=0)
    mirrored = mirrored_poses(rotation, translation, middle)
    np.testing.assert_allclose(np.linalg.det(mirrored[0]), 1.0, atol=1e-12)
    apart = np.linalg.norm(rays_of(*mirrored) - rays_of(rotation, translation), axis=-1)
    assert apart.max() < 1e-2 * np.ptp(BOARD[:, 0]) / 100.0
    back = mirrored_poses(*mirrored, middle)
    np.testing.assert_allclose(back[0], rotation, atol=1e-12)
    np.testing.assert_allclose(back[1], translation, atol=1e-10)


def test_corners_on_one_line_give_some_pose() -> None:
    rotation, translation = random_poses(np.random.default_rng(0), 4, 30.0, 1.0)
    seen = np.tile(np.arange(len(BOARD)) < 7, (4, 1)).astype(float)  # the lowest row
    found = planar_poses(BOARD, rays_of(rotation, translation), seen)
    np.testing.assert_allclose(np.swapaxes(found[0], 1, 2) @ found[0], np.tile(np.eye(3), (4, 1, 1)), atol=1e-9)
    assert np.isfinite(found[1]).all()


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.3, 3.0])
def test_rotation_vectors(angle: float) -> None:
    vectors = angle * unit(np.random.default_rng(1).standard_normal((5, 3)))
    np.testing.assert_allclose(rotations(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
