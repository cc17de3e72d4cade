"""The generic lens and the small bundle adjustments in numpy that the initialisation is made of."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxcal import Checkerboard, camera_model
from jaxcal.calibration import generic_lens
from jaxcal.calibration.first_fit import Fit, compact_views, fit_lenses, fit_poses, squared_errors
from jaxcal.calibration.generic_lens import GenericLens
from jaxcal.calibration.initial_poses import rotations
from jaxcal.calibration.model_lens import ModelLens

SIZE = (640, 480)
SEEDS = st.integers(0, 2**32 - 1)
BOARD = Checkerboard(6, 8, 0.1)
LENSES = np.array(
    [
        [np.log(300.0), 0.01, 310.0, 245.0, 0.0, 0.0],
        [np.log(3000.0), -0.01, 330.0, 235.0, -0.4, 0.3],
        [np.log(180.0), 0.0, 320.0, 240.0, 0.8, 0.2],
        [np.log(150.0), 0.02, 325.0, 230.0, 1.3, -0.2],
    ]
)


def random_points(rng: np.random.Generator, lenses: np.ndarray, count: int) -> np.ndarray:
    """Points (B, 1, 3, N) in the camera frame that the image of each lens shows."""
    pixels = rng.uniform(0.0, 1.0, (1, count, 2)) * SIZE
    rays, valid = generic_lens.unproject(lenses, pixels)
    middle, _ = generic_lens.unproject(lenses, np.full((1, 1, 2), 240.0))
    rays = np.where(valid[..., None], rays, middle)
    return (rays * rng.uniform(0.5, 2.0, (*rays.shape[:-1], 1))).swapaxes(-1, -2)


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS)
def test_unprojection_undoes_projection(seed: int) -> None:
    points = random_points(np.random.default_rng(seed), LENSES, 30)
    seen = GenericLens().project(LENSES, points, False)
    assert seen.valid.all()
    for b in range(len(LENSES)):
        rays, valid = generic_lens.unproject(LENSES[b : b + 1], seen.pixels[b].swapaxes(-1, -2))
        assert valid.all()
        expected = points[b, 0].T / np.linalg.norm(points[b, 0].T, axis=1, keepdims=True)
        np.testing.assert_allclose(rays[0, 0], expected, atol=1e-9)


@settings(deadline=None, max_examples=10)
@given(seed=SEEDS)
def test_jacobians_are_those_of_finite_differences(seed: int) -> None:
    points = random_points(np.random.default_rng(seed), LENSES, 10)
    lens = GenericLens()
    seen = lens.project(LENSES, points, True)
    assert seen.by_lens is not None
    scale = np.abs(seen.by_point).max(axis=(1, 2, 3, 4), keepdims=True)[:, :, 0]
    for k in range(3):
        step = np.zeros((3, 1))
        step[k] = 1e-6
        there = lens.project(LENSES, points + step, False).pixels - lens.project(LENSES, points - step, False).pixels
        np.testing.assert_array_less(np.abs(there / 2e-6 - seen.by_point[..., k, :]) / scale, 1e-6)
    for k in range(generic_lens.SIZE):
        step = np.zeros(generic_lens.SIZE)
        step[k] = 1e-6
        there = lens.project(LENSES + step, points, False).pixels - lens.project(LENSES - step, points, False).pixels
        np.testing.assert_allclose(there / 2e-6, seen.by_lens[:, :, k], rtol=1e-5, atol=1e-3)


def test_a_compiled_model_and_the_generic_lens_agree_where_they_are_the_same() -> None:
    """EUCM as a camera model and as the generic lens; more points than one compiled call takes."""
    generic = LENSES[3:]
    points = random_points(np.random.default_rng(0), generic, 5000)
    alpha, beta = 1.0 - np.exp(-generic[0, 4]), np.exp(generic[0, 5])
    fx, fy = np.exp(generic[0, 0] + 0.5 * generic[0, 1]), np.exp(generic[0, 0] - 0.5 * generic[0, 1])
    model = camera_model("eucm-none").create([alpha, beta, fx, fy, generic[0, 2], generic[0, 3]])
    one = GenericLens().project(generic, points, True)
    other = ModelLens(model).project(np.asarray(model.parameters)[None], points, True)
    assert one.by_lens is not None
    assert other.by_lens is not None
    assert other.valid.all()
    np.testing.assert_allclose(other.pixels, one.pixels, atol=1e-9)
    np.testing.assert_allclose(other.by_point, one.by_point, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(other.by_lens[:, :, 4:], one.by_lens[:, :, 2:4], atol=1e-12)  # the centre
    by_beta = other.by_lens[:, :, 1] * beta
    np.testing.assert_allclose(by_beta, one.by_lens[:, :, 5], rtol=1e-8, atol=1e-8)


def test_no_view_has_gaps_after_compaction() -> None:
    rng = np.random.default_rng(2)
    count = len(BOARD.points)
    seen = rng.random((5, count)) < np.array([1.0, 0.5, 0.2, 0.9, 0.3])[:, None]
    pixels = np.stack(np.broadcast_arrays(np.arange(count, dtype=float), np.arange(5.0)[:, None]), axis=-1)
    for most in (None, 20, 4):
        views = compact_views(BOARD.points, pixels, seen, most)
        for f in range(5):
            taken = views.weight[f] > 0
            index = views.pixels[f, taken, 0].astype(int)
            assert len(index) == min(seen[f].sum(), most or count)
            assert seen[f, index].all()
            assert (np.diff(index) > 0).all()
            np.testing.assert_allclose(views.points[f, taken] * views.size + views.middle, BOARD.points[index])


def consistent_views(seed: int, lens: np.ndarray, count: int = 8) -> tuple:
    """Views of the board without noise through one generic lens (6,), and their poses (1, F, ...)."""
    rng = np.random.default_rng(seed)
    views = compact_views(BOARD.points, np.zeros((count, len(BOARD.points), 2)), np.ones((count, 48), bool))
    facing = np.diag([1.0, -1.0, -1.0])
    rotation = (rotations(0.5 * rng.standard_normal((count, 3))) @ facing)[None]
    translation = np.stack([*rng.uniform(-0.4, 0.4, (2, count)), rng.uniform(1.0, 1.6, count)], axis=-1)[None]
    truth = Fit(lens[None], rotation, translation, np.zeros(1))
    in_camera = rotation @ views.points.swapaxes(-1, -2) + translation[..., None]
    seen = GenericLens().project(lens[None], in_camera, False)
    pixels = seen.pixels[0].swapaxes(-1, -2)
    return compact_views(BOARD.points, pixels, seen.valid[0]), truth


@settings(deadline=None, max_examples=10)
@given(seed=SEEDS, which=st.sampled_from([0, 2, 3]))
@example(seed=191860716, which=0)
def test_lens_and_poses_are_found_from_nearby(seed: int, which: int) -> None:
    views, truth = consistent_views(seed, LENSES[which])
    rng = np.random.default_rng(seed)
    start = Fit(
        truth.parameters + np.array([0.05, 0.0, 3.0, -2.0, 0.05, 0.0]),
        rotations(0.05 * rng.standard_normal(truth.translation.shape)) @ truth.rotation,
        truth.translation + 0.02 * rng.standard_normal(truth.translation.shape),
        np.array([np.inf]),
    )
    nothing = (np.zeros(6), np.zeros(6))
    options = {"width": 1e3, "cap": 1e4}
    poses, _ = fit_poses(GenericLens(), start, views, steps=10, **options)
    before = fit_lenses(GenericLens(), poses, views, steps=0, prior=nothing, **options)
    held = fit_lenses(GenericLens(), poses, views, steps=10, prior=nothing, hold_poses=True, **options)
    np.testing.assert_array_equal(held.rotation, poses.rotation)
    fit = fit_lenses(GenericLens(), held, views, steps=100, prior=nothing, rtol=0.0, **options)
    assert fit.cost[0] <= held.cost[0] <= before.cost[0]
    # A start is what is wanted: focal length and shape of a narrow lens are one valley, along which steps creep.
    assert np.sqrt(squared_errors(GenericLens(), fit, views, 1e6).max()) < 0.3


def test_hypotheses_side_by_side_do_not_touch_each_other() -> None:
    views, truth = consistent_views(0, LENSES[2])
    starts = truth.parameters + np.array([[0.0] * 6, [0.2, 0, 5, 5, -0.2, 0.1], [-0.3, 0, 0, 0, 0.3, 0]])
    prior = generic_lens.weak_prior(SIZE, 0.1)

    def run(parameters: np.ndarray) -> Fit:
        count = len(parameters)
        start = Fit(
            parameters,
            np.repeat(truth.rotation, count, axis=0),
            np.repeat(truth.translation, count, axis=0),
            np.full(count, np.inf),
        )
        return fit_lenses(GenericLens(), start, views, steps=6, width=5.0, cap=500.0, prior=prior, rtol=0.0)

    together = run(starts)
    for b in range(3):
        alone = run(starts[b : b + 1])
        np.testing.assert_allclose(together.parameters[b], alone.parameters[0], rtol=1e-9, atol=1e-9)
