"""How much of a camera's image the target visited."""

import numpy as np

from jaxcal.results.calibration import CameraCalibration

# Cells of roughly equal sides on common sensors, small enough to show a missed corner of the image.
CELLS_ACROSS, CELLS_DOWN = 8, 6
_FEWEST_FOR_SHARE = 20


def corner_counts(camera: CameraCalibration) -> np.ndarray:
    """Used corners in each cell of a regular grid over the image: (CELLS_DOWN, CELLS_ACROSS) counts."""
    return _counts(camera, camera.used)


def coverage(camera: CameraCalibration) -> float:
    """Fraction of the cells that hold at least one used corner, 0 to 1."""
    return float(np.mean(corner_counts(camera) > 0))


def least_kept(camera: CameraCalibration) -> float:
    """The smallest share of corners that a cell kept from rejection, 0 to 1; NaN where every cell saw too few.

    Rejection that concentrates in one place of the image is no matter of chance: the lens model does not hold there.
    """
    seen = _counts(camera, np.asarray(np.isfinite(camera.residuals_px).all(axis=1)))
    enough = seen >= _FEWEST_FOR_SHARE
    return float(np.min(corner_counts(camera)[enough] / seen[enough], initial=1.0)) if enough.any() else float("nan")


def _counts(camera: CameraCalibration, which: np.ndarray) -> np.ndarray:
    width, height = camera.image_size
    x, y = camera.detections.pixels[which].T
    counts, _, _ = np.histogram2d(
        y, x, bins=(CELLS_DOWN, CELLS_ACROSS), range=((-0.5, height - 0.5), (-0.5, width - 0.5))
    )
    return counts
