"""The figure of a camera's projection uncertainty: contours over the image, with the corners that it follows from."""

import numpy as np
from matplotlib.ticker import FuncFormatter

from jaxcal.results.calibration import CameraCalibration
from jaxcal.results.projection_uncertainty import ProjectionUncertainty
from jaxcal.results.report.drawing import ACCENT, INK, POINT, WARN, Picture, image_panel, nothing_to_show, to_svg

# Contours at 1, 2, 5 times powers of ten, px; so many of them at most, the lowest first.
_LEVELS = np.outer(10.0 ** np.arange(-4, 5), [1.0, 2.0, 5.0]).ravel()
_MOST_LEVELS = 8


def projection_picture(camera: CameraCalibration, found: ProjectionUncertainty | None, prefix: str) -> Picture:
    """Contours of the 1-sigma of a projected point at infinity (None: not known); `prefix` is unique in the page."""
    figure, axes = image_panel(camera.image_size)
    if found is not None:
        x, y = found.pixels[0, :, 0], found.pixels[:, 0, 1]
        if not found.observed.all():
            axes.contourf(x, y, ~found.observed, levels=[0.5, 1.5], colors=[WARN], alpha=0.22)
        corners = camera.detections.pixels[camera.used]
        faint = float(np.clip(4000.0 / max(len(corners), 1), 0.04, 0.4))
        axes.plot(*corners.T, ".", markersize=1.2, color=POINT, alpha=faint, rasterized=True)
        levels = contour_levels(found.sigma_px)
        if len(levels):
            lines = axes.contour(
                x, y, np.ma.masked_invalid(found.sigma_px), levels=levels, colors=[ACCENT], linewidths=1.2
            )
            axes.clabel(lines, fmt=FuncFormatter(lambda value, _: f"{value:g}"), fontsize=8.0, colors=[INK])
        shows = f"{found.sentence} Contours in px; tinted: no view of the board reached there."
    else:
        nothing_to_show(axes, "no poses or no covariance")
        shows = "This calibration holds no poses of the board or no covariance, so it cannot be told."
    return Picture(
        "Projection uncertainty",
        to_svg(figure, prefix),
        shows,
        "well under a pixel wherever the camera is used, and nearly level.",
        "record more views where the contours rise, tilted, at several distances. Errors of the lens model do not "
        "show here: see the mean residuals.",
    )


def contour_levels(sigma: np.ndarray) -> np.ndarray:
    """Contour levels between the smallest and the largest value (px)."""
    finite = sigma[np.isfinite(sigma)]
    if not len(finite):
        return finite
    return _LEVELS[(finite.min() < _LEVELS) & (finite.max() > _LEVELS)][:_MOST_LEVELS]
