"""Stated sigmas against the scatter of simulated calibrations: a smaller `experiments/validate_uncertainty.py`."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.stats import chi2

from jaxcal import Checkerboard, Detections
from jaxcal.calibration import outliers
from jaxcal.calibration.assemble import camera_frames
from jaxcal.calibration.redundancy import measure_redundancy

SCRIPT = Path(__file__).resolve().parents[2] / "experiments" / "validate_uncertainty.py"
RUNS, NOISE_PX = 80, 0.2


def load_experiment() -> ModuleType:
    spec = importlib.util.spec_from_file_location("validate_uncertainty", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


experiment = load_experiment()


@pytest.mark.slow
def test_sigmas_projections_and_noise_are_as_stated() -> None:
    truth = experiment.make_truth([1, 2], views=32, seed=0)
    scatter = experiment.known_noise(truth, RUNS, NOISE_PX)
    # Each parameter's mean square error over its variance is a chi-square of RUNS degrees of freedom; 22 are looked at.
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], RUNS) / RUNS
    assert len(scatter.labels) == 22
    assert np.all((scatter.ratio**2 > low) & (scatter.ratio**2 < high)), dict(
        zip(scatter.labels, scatter.ratio, strict=True)
    )
    freedom = RUNS * len(scatter.labels)
    low, high = chi2.ppf([1e-3, 1.0 - 1e-3], freedom) / freedom
    assert low < scatter.nees.mean() < high
    np.testing.assert_allclose(scatter.noise.mean(axis=0), NOISE_PX, rtol=0.01)
    for camera in range(2):
        pixels = experiment.grid_over(truth.frames[camera])
        observed, stated = experiment.projection_scatter(truth, scatter, camera, pixels, None)
        ratio = np.trace(observed, axis1=1, axis2=2) / np.trace(stated, axis1=1, axis2=2)
        # Neighbours agree with each other, so that the mean scatters almost as one of them does.
        assert 0.8 < np.sqrt(ratio.mean()) < 1.2
        assert np.all((np.sqrt(ratio) > 0.7) & (np.sqrt(ratio) < 1.35))


@pytest.mark.slow
def test_corner_noise_from_few_small_views_has_its_degrees_of_freedom() -> None:
    """Six views of twelve points: 144 numbers for 44 parameters; not allowing for these would make it 17 % too low."""
    truth = experiment.make_truth([1], views=6, seed=1, target=Checkerboard(rows=3, cols=4, spacing=0.15))
    scatter = experiment.known_noise(truth, 300, NOISE_PX)
    # The mean square is unbiased; its root, over 100 degrees of freedom, by a quarter of a percent too small.
    found = float(np.sqrt(np.mean(scatter.noise**2)))
    assert found == pytest.approx(NOISE_PX, rel=0.015)
    freedom = 300 * len(scatter.labels)
    low, high = chi2.ppf([1e-3, 1.0 - 1e-3], freedom) / freedom
    assert low < scatter.nees.mean() < high


def test_rejection_hardly_touches_clean_corners() -> None:
    """4.5 sigma: a loss of a few in a hundred thousand corners, and no bias of the noise that could be seen."""
    rng = np.random.default_rng(0)
    errors = 0.3 * rng.standard_normal((400, 100, 2))
    seen = np.ones(errors.shape[:2], dtype=bool)
    assert outliers.robust_sigma(errors, seen) == pytest.approx(0.3, rel=0.01)
    kept = outliers.inliers(errors, seen, 0.3)
    assert kept.mean() > 1.0 - 2e-4
    assert outliers.rms_sigma(errors, kept, 0.0) == pytest.approx(0.3, rel=0.005)


@pytest.mark.parametrize("seed", range(5))
def test_views_that_look_alike_count_in_full_where_errors_are_noise(seed: int) -> None:
    board = Checkerboard(rows=6, cols=9, spacing=0.05)
    rng = np.random.default_rng(seed)
    count = 300
    # A slow drift: each view looks like its neighbours.
    middle = 300.0 + 40.0 * np.cumsum(rng.standard_normal((count, 2)), axis=0) / np.sqrt(count)
    pixels = np.clip(middle[:, None] + 800.0 * board.points[None, :, :2], 0.0, 900.0)
    detections = Detections(
        1000 * np.arange(count),
        np.repeat(np.arange(count), len(board.points)),
        np.tile(np.arange(len(board.points)), count),
        pixels.reshape(-1, 2),
        (1280, 960),
    )
    frames = camera_frames(detections, board, "cam0")
    noise = 0.2 * rng.standard_normal(frames.pixels.shape)
    found = measure_redundancy(frames, noise, frames.seen, 0.2)
    assert abs(found.correlation) < 0.05
    assert found.inflation == 1.0
    assert np.all(found.weights == 1.0)
    same = measure_redundancy(frames, noise + noise[:1], frames.seen, 0.2)
    assert same.correlation > 0.3
    assert same.inflation > 1.0
