"""The picture of a comparison: how far two calibrations of each camera are apart over the image, at each range."""

import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxcal.atomic import write_bytes
from jaxcal.results.difference import CameraDifference, RigDifference

_PANEL = (3.7, 3.1)  # inches
_ARROWS = 12  # across
_BRIGHTEST = 0.98  # share of the differences where both saw corners that the colours tell apart


def write_comparison_figure(difference: RigDifference, path: str | Path) -> None:
    """Write a .png (or .svg, .pdf) with one row per camera and one panel per range, atomically.

    Colour is the length of the difference in px, arrows its direction (each panel to its own scale), the dark line the
    outline of where both calibrations saw corners.
    """
    columns = max(len(camera.ranges_m) for camera in difference.cameras)
    rows = len(difference.cameras)
    figure = Figure(figsize=(_PANEL[0] * columns, _PANEL[1] * rows + 0.5), layout="constrained")
    figure.suptitle(difference.headline, fontsize=10.0)
    grid = figure.subplots(rows, columns, squeeze=False)
    for camera, line in zip(difference.cameras, grid, strict=True):
        finite = camera.size_px[:, camera.observed]
        top = float(np.nanquantile(finite, _BRIGHTEST)) if np.isfinite(finite).any() else 1.0
        for k, axes in enumerate(line):
            if k < len(camera.ranges_m):
                _draw(figure, axes, camera, k, max(top, 1e-6))
            else:
                axes.set_axis_off()
    content, path = io.BytesIO(), Path(path)
    figure.savefig(content, format=path.suffix.lstrip(".") or "png", dpi=130)
    write_bytes(path, content.getvalue())


def _draw(figure: Figure, axes: Axes, camera: CameraDifference, k: int, top: float) -> None:
    """Colours up to `top` px, and arrows where both saw corners: elsewhere lenses may do anything."""
    x, y = camera.pixels[0, :, 0], camera.pixels[:, 0, 1]
    size = np.ma.masked_invalid(camera.size_px[k])
    shown = axes.pcolormesh(x, y, size, cmap="viridis", vmin=0.0, vmax=top, shading="nearest", rasterized=True)
    step = max(1, len(x) // _ARROWS)
    shown_there = np.where(camera.observed[..., None], np.nan_to_num(camera.difference_px[k]), 0.0)
    u, v = shown_there[::step, ::step].transpose(2, 0, 1)
    if np.hypot(u, v).max() > 0:
        axes.quiver(x[::step], y[::step], u, v, color="white", angles="xy", width=0.004)
    if not camera.observed.all():
        axes.contour(x, y, camera.observed.astype(float), levels=[0.5], colors="black", linewidths=1.0)
    axes.set_aspect("equal")
    axes.set_ylim(y[-1], y[0])
    r = camera.ranges_m[k]
    axes.set_title(f"{camera.name}, {'at infinity' if np.isinf(r) else f'{r:g} m away'}", fontsize=9.0)
    axes.tick_params(labelsize=7.0)
    figure.colorbar(shown, ax=axes, shrink=0.8, extend="max").set_label("px", fontsize=8.0)
