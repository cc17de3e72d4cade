"""How much of a camera's image the target visited."""

import numpy as np

from jaxcal.results.calibration import CameraCalibration

# Cells of roughly equal sides on common sensors, small enough to show a missed corner of the image.
CELLS_ACROSS, CELLS_DOWN = 8, 6


def corner_counts(camera: CameraCalibration) -> np.ndarray:
    """Used corners in each cell of a regular grid over the image: (CELLS_DOWN, CELLS_ACROSS) counts."""
    width, height = camera.image_size
    x, y = camera.detections.pixels[camera.used].T
    counts, _, _ = np.histogram2d(
        y, x, bins=(CELLS_DOWN, CELLS_ACROSS), range=((-0.5, height - 0.5), (-0.5, width - 0.5))
    )
    return counts


def coverage(camera: CameraCalibration) -> float:
    """Fraction of the cells that hold at least one used corner, 0 to 1."""
    return float(np.mean(corner_counts(camera) > 0))
