"""How much less corners tell whose errors hang together: nothing for independent ones, what a simulation shows else."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.calibration.score_noise import STRETCHES, _jackknife, _scores, design_effect, score_noise
from jaxcal.cameras import CameraModel, PinholeRadtan
from jaxcal.targets import Checkerboard

LENS = PinholeRadtan.create([400.0, 402.0, 320.0, 240.0], [-0.2, 0.05, 0.001, -0.001])
POINTS = Checkerboard(6, 8, 0.05).points
VIEWS = 60
NOISE_PX = 0.2


def poses(rng: np.random.Generator, views: int = VIEWS) -> np.ndarray:
    """(F, 4, 4) a board before the camera, tilted."""
    from scipy.spatial.transform import Rotation

    T = np.tile(np.eye(4), (views, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (views, 3))).as_matrix()
    middle = POINTS.mean(axis=0)
    place = rng.uniform([-0.1, -0.1, 0.5], [0.1, 0.1, 0.9], (views, 3))
    T[:, :3, 3] = place - T[:, :3, :3] @ middle
    return T


def weights(views: int = VIEWS) -> np.ndarray:
    return np.full((views, len(POINTS)), 1.0 / NOISE_PX**2)


def effect(errors: np.ndarray, T: np.ndarray, of_corners: np.ndarray | None = None, lens: CameraModel = LENS) -> float:
    return design_effect(lens, POINTS, T, errors, weights(len(T)) if of_corners is None else of_corners)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_independent_corners_tell_in_full(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = poses(rng)
    assert effect(NOISE_PX * rng.standard_normal((VIEWS, len(POINTS), 2)), T) == 1.0


@pytest.mark.parametrize("kept", [0.5, 0.9])
def test_errors_that_last_from_view_to_view_tell_less(kept: float) -> None:
    # Errors that keep the share `kept` from one view to the next, in the same pose, are known exactly: a lag l adds
    # twice kept^l, as far as an eighth of the recording reaches.
    rng = np.random.default_rng(1)
    views = 400
    T = np.tile(poses(rng, 1), (views, 1, 1))
    fresh = rng.standard_normal((views, len(POINTS), 2))
    errors = [fresh[0]]
    for new in fresh[1:]:
        errors.append(kept * errors[-1] + np.sqrt(1 - kept**2) * new)
    stretch = views / STRETCHES
    lags = np.arange(1, int(stretch))
    expected = 1.0 + 2.0 * np.sum((1.0 - lags / stretch) * kept**lags)
    assert effect(NOISE_PX * np.array(errors), T) == pytest.approx(expected, rel=0.35)


@pytest.mark.parametrize("kept", [0.0, 0.6, 0.9])
def test_what_leaving_out_stretches_shows_is_how_far_the_optimum_is_off(kept: float) -> None:
    """Scores of views of very different weight, each last for a while, and a lens that has followed them."""
    rng = np.random.default_rng(6)
    views, size = 120, 4
    root = rng.standard_normal((views, 8, size)) * np.exp(0.7 * rng.standard_normal((views, 1, 1)))
    information = np.einsum("vki,vkj->vij", root, root)
    back = np.linalg.inv(np.linalg.cholesky(information.sum(axis=0))).T
    root, information = root @ back, back.T @ information @ back
    off, said = [], []
    for _ in range(150):
        noise = rng.standard_normal((views, 8))
        for v in range(1, views):
            noise[v] = kept * noise[v - 1] + np.sqrt(1 - kept**2) * noise[v]
        scores = np.einsum("vki,vk->vi", root, noise)
        # All residuals of a view change sign with its root, so that errors last in the noise and in the score.
        optimum = scores.sum(axis=0)
        off.append(optimum @ optimum)
        said.append(np.trace(_jackknife(scores - information @ optimum, information)))
    assert np.mean(said) == pytest.approx(np.mean(off), rel=0.3)


def test_a_direction_that_scatters_more_than_the_others_is_told() -> None:
    """The lens's k1 is another one in each view: how far that leads each parameter astray is known exactly."""
    change, told, true = 0.06, [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        T = poses(rng, 120)
        seen = np.einsum("fij,nj->fni", T[:, :3, :3], POINTS) + T[:, None, :3, 3]
        other = LENS.with_parameters(np.asarray(LENS.parameters) + 1e-3 * np.eye(8)[4])
        by_k1 = (np.asarray(other.project(seen)) - np.asarray(LENS.project(seen))) / 1e-3
        noise = NOISE_PX * rng.standard_normal(by_k1.shape)
        errors = noise + change * rng.standard_normal((len(T), 1, 1)) * by_k1
        found = score_noise(LENS, POINTS, T, errors, weights(len(T)))
        assert found is not None
        covariance = np.linalg.inv(found.directions @ found.directions.T)
        usual = np.diag(covariance)
        more = np.diag(covariance @ found.beyond(found.effect) @ covariance)
        told.append(found.effect + more / usual)
        _, information = _scores(LENS, np.arange(8), POINTS, T, errors, weights(len(T)))
        true.append(1.0 + np.sum((change * information[:, :, 4] @ covariance) ** 2, axis=0) / usual)
    said, is_so = np.mean(told, axis=0), np.mean(true, axis=0)
    assert (said > is_so).all()  # no direction is taken to be better known than is usual
    assert said.argmax() == is_so.argmax() == 5  # k2, which goes with k1
    assert said[5] > 1.5 * said[:4].max()
    assert said[5] < 4.0 * is_so[5]


def test_errors_that_a_view_shares_tell_less() -> None:
    """A displacement that bends with the place in the image, anew in each view, and no pose makes up for."""
    rng = np.random.default_rng(2)
    T = poses(rng)
    errors = NOISE_PX * rng.standard_normal((VIEWS, len(POINTS), 2))
    seen = np.einsum("fij,nj->fni", T[:, :3, :3], POINTS) + T[:, None, :3, 3]
    x, y = np.moveaxis(seen[..., :2] / seen[..., 2:], -1, 0)
    shared = rng.standard_normal((VIEWS, 1, 1)) * (20.0 * (x**2 + y**2)[..., None] * np.stack([x, y], axis=-1))
    assert effect(errors + shared, T) > 2.0


def test_corners_that_take_no_part_are_not_asked() -> None:
    rng = np.random.default_rng(3)
    T = poses(rng)
    errors = NOISE_PX * rng.standard_normal((VIEWS, len(POINTS), 2))
    out = rng.random(errors.shape[:2]) < 0.2
    of_corners = np.where(out, 0.0, weights())
    T[5] = np.nan  # a frame without a pose has no corners either
    of_corners[5] = 0.0
    assert effect(np.where(out[..., None], np.nan, errors), T, of_corners) == 1.0


def test_views_without_derivatives_are_left_out() -> None:
    rng = np.random.default_rng(5)
    T = poses(rng)
    errors = NOISE_PX * rng.standard_normal((VIEWS, len(POINTS), 2))
    lasting = errors[0] + 0.0 * errors
    whole = effect(lasting[1:], T[1:])
    T[0, 0, 3] = np.nan
    assert effect(lasting, T) == pytest.approx(whole, rel=0.1)
    assert whole > 1.2
    T[:, 0, 3] = np.nan
    assert effect(lasting, T) == 1.0


def test_too_few_views_say_nothing() -> None:
    rng = np.random.default_rng(4)
    T = poses(rng, 7)
    assert effect(np.ones((7, len(POINTS), 2)), T) == 1.0
