"""The figures of one camera: where its corners were, and what its residuals look like."""

import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.patches import Circle, Rectangle

from jaxcal.results.calibration import CameraCalibration
from jaxcal.results.coverage import corner_counts, coverage
from jaxcal.results.projection_uncertainty import ProjectionUncertainty
from jaxcal.results.report.drawing import (
    ACCENT,
    BAD,
    INK,
    MUTED,
    POINT,
    REJECTED,
    WARN,
    Picture,
    image_panel,
    label,
    note,
    nothing_to_show,
    panel,
    to_svg,
)
from jaxcal.results.report.lens_figure import lens_picture
from jaxcal.results.report.projection_figure import projection_picture
from jaxcal.results.target_bias import target_bias
from jaxcal.targets import Target

_FIELD_CELLS = (16, 12)
_FEWEST_FOR_MEAN = 4
_RADIUS_BINS = 12


def camera_pictures(
    camera: CameraCalibration, projection: ProjectionUncertainty | None, residuals: list[Picture], prefix: str
) -> list[Picture]:
    """All figures of a camera, those of its residuals among them, in the order in which they are read; `prefix` is
    unique in the page."""
    coverage_first, *others = residuals
    return [
        coverage_first,
        lens_picture(camera, f"{prefix}-lens"),
        projection_picture(camera, projection, f"{prefix}-projection"),
        *others,
    ]


def residual_pictures(camera: CameraCalibration, target: Target, prefix: str) -> list[Picture]:
    """The figures of a camera that need its corners and residuals, and nothing of its lens; coverage comes first."""
    return [
        _coverage_picture(camera, f"{prefix}-coverage"),
        _scatter_picture(camera, f"{prefix}-scatter"),
        _field_picture(camera, f"{prefix}-field"),
        _target_picture(camera, target, f"{prefix}-target"),
        _radial_picture(camera, f"{prefix}-radial"),
        _frames_picture(camera, f"{prefix}-frames"),
    ]


def frame_rms(camera: CameraCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Frames (K,) with used corners and the root mean square 2-D error (K,) of those corners, px."""
    used = camera.used
    frames, place = np.unique(camera.detections.frame[used], return_inverse=True)
    squares = np.sum(camera.residuals_px[used] ** 2, axis=1)
    counts = np.bincount(place, minlength=len(frames))
    return frames, np.sqrt(np.bincount(place, weights=squares, minlength=len(frames)) / np.maximum(counts, 1))


def _corner_sigma(camera: CameraCalibration) -> float:
    """The corner noise, px; 0 where there were too few corners to estimate it."""
    return camera.corner_sigma_px if np.isfinite(camera.corner_sigma_px) else 0.0


def _faintness(count: int) -> float:
    """Opacity of one point among `count`, so that a dense cloud still shows where it is densest."""
    return float(np.clip(8000.0 / max(count, 1), 0.04, 0.6))


def _coverage_picture(camera: CameraCalibration, prefix: str) -> Picture:
    figure, axes = image_panel(camera.image_size)
    counts = corner_counts(camera)
    width, height = camera.image_size
    down, across = counts.shape
    empty = [
        Rectangle((col * width / across - 0.5, row * height / down - 0.5), width / across, height / down)
        for row, col in np.argwhere(counts == 0)
    ]
    axes.add_collection(PatchCollection(empty, facecolor=WARN, edgecolor="none", alpha=0.22))
    x, y = camera.detections.pixels[camera.used].T
    axes.plot(x, y, ".", markersize=1.6, color=POINT, alpha=_faintness(2 * len(x)), rasterized=True)
    rejected = camera.detections.pixels[~camera.inlier]
    axes.plot(*rejected.T, ".", markersize=2.0, color=REJECTED, alpha=_faintness(len(rejected)), rasterized=True)
    return Picture(
        "Coverage",
        to_svg(figure, prefix),
        f"Every corner used ({len(x)}), rejected ones in red. Tinted cells hold none: {100 * coverage(camera):.0f} % "
        "of the cells are covered.",
        "points all over the image, into its edges; red ones few and scattered.",
        "record the target in the tinted places, where distortion is extrapolated; red edges need a richer lens model.",
    )


def _scatter_picture(camera: CameraCalibration, prefix: str) -> Picture:
    figure, (axes,) = panel()
    sigma = _corner_sigma(camera)
    used, rejected = camera.residuals_px[camera.used], _rejected(camera)
    limit = 5.0 * sigma if sigma > 0 else 1.0
    axes.plot(*used.T, ".", markersize=1.8, color=POINT, alpha=_faintness(len(used)), rasterized=True)
    axes.plot(*rejected.T, "x", markersize=3.0, color=REJECTED, alpha=0.8, rasterized=True)
    for factor, style in ((1.0, "-"), (3.0, "--")):
        axes.add_patch(
            Circle((0.0, 0.0), factor * sigma, fill=False, edgecolor=INK, linewidth=1.0, linestyle=style, zorder=4)
        )
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.set_aspect("equal")
    label(axes, "error in u [px]", "error in v [px]")
    everything = np.concatenate([used, rejected])
    beyond = int(np.sum(np.abs(everything).max(axis=1) > limit)) if len(everything) else 0
    if beyond:
        note(axes, f"{beyond} outside")
    inside = float(np.mean(np.sum(used**2, axis=1) <= (3.0 * sigma) ** 2)) if len(used) else float("nan")
    return Picture(
        "Reprojection residuals",
        to_svg(figure, prefix),
        f"Projection minus measurement; circles at 1 and 3 sigma ({sigma:.3f} px), {100 * inside:.1f} % within 3 sigma "
        f"(98.9 % if Gaussian); {len(rejected)} rejected corners in red.",
        "one round cloud, centred on zero.",
        "a long tail points to wrong detections, a stretched cloud to motion blur, a cross to corners that are "
        "shifted along the target's lines.",
    )


def _target_picture(camera: CameraCalibration, target: Target, prefix: str) -> Picture:
    figure, (axes,) = panel()
    sigma = _corner_sigma(camera)
    bias = target_bias(camera, target)
    x, y = target.points[:, 0], target.points[:, 1]
    pitch = float(np.sqrt(np.ptp(x) * np.ptp(y) / len(x)))
    axes.plot(x, y, ".", color=MUTED, markersize=2.0)
    if len(bias.point) and sigma > 0:
        arrows = bias.mean_px / sigma * pitch
        axes.quiver(
            x[bias.point], y[bias.point], arrows[:, 0], arrows[:, 1],
            angles="xy", scale_units="xy", scale=1.0, color=ACCENT, width=0.0045,
        )  # fmt: skip
    else:
        nothing_to_show(axes, "too few corners for means")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.grid(visible=False)
    label(axes, "x of the target [m]", "y of the target [m]")
    return Picture(
        "Mean residual over the target",
        to_svg(figure, prefix),
        f"Mean residual of each point, turned into the target's directions; one corner sigma ({sigma:.3f} px) is drawn "
        f"one point spacing long. Systematic part: {bias.rms_px:.3f} px rms.",
        "arrows too short to see a pattern.",
        "a pattern that repeats from tag to tag is a biased detector or a wrong spacing; a smooth one, a bent board.",
    )


def _field_picture(camera: CameraCalibration, prefix: str) -> Picture:
    figure, axes = image_panel(camera.image_size)
    width, height = camera.image_size
    across, down = _FIELD_CELLS
    pixels, residuals = camera.detections.pixels[camera.used], camera.residuals_px[camera.used]
    column = np.clip(((pixels[:, 0] + 0.5) / width * across).astype(int), 0, across - 1)
    row = np.clip(((pixels[:, 1] + 0.5) / height * down).astype(int), 0, down - 1)
    cell = row * across + column
    counts = np.bincount(cell, minlength=across * down)
    means = (
        np.stack([np.bincount(cell, weights=residuals[:, k], minlength=across * down) for k in range(2)], axis=1)
        / np.maximum(counts, 1)[:, None]
    )
    shown = counts >= _FEWEST_FOR_MEAN
    if shown.any() and _corner_sigma(camera) > 0:
        # One corner sigma is drawn as long as a cell is wide: systematic errors are read against the noise.
        arrows = means[shown] / _corner_sigma(camera) * (width / across)
        x = (np.arange(across * down)[shown] % across + 0.5) * width / across - 0.5
        y = (np.arange(across * down)[shown] // across + 0.5) * height / down - 0.5
        axes.quiver(
            x, y, arrows[:, 0], arrows[:, 1], angles="xy", scale_units="xy", scale=1.0, color=ACCENT, width=0.0045
        )
    else:
        nothing_to_show(axes, "too few corners for means")
    largest = float(np.linalg.norm(means[shown], axis=1).max()) if shown.any() else float("nan")
    return Picture(
        "Mean residual over the image",
        to_svg(figure, prefix),
        f"Mean residual per cell; one corner sigma ({_corner_sigma(camera):.3f} px) is drawn one cell long. "
        f"The largest mean is {largest:.3f} px.",
        "short arrows without order.",
        "a pattern (a vortex, a ring, a shear) is error the lens model cannot express, or a board that is not flat.",
    )


def _radial_picture(camera: CameraCalibration, prefix: str) -> Picture:
    figure, (axes,) = panel()
    width, height = camera.image_size
    pixels, residuals = camera.detections.pixels[camera.used], camera.residuals_px[camera.used]
    arm = pixels - np.array([(width - 1) / 2.0, (height - 1) / 2.0])
    radius = np.linalg.norm(arm, axis=1)
    outward = np.sum(arm * residuals, axis=1) / np.maximum(radius, 1e-9)
    edge = float(np.hypot(width, height) / 2.0)
    place = np.clip((radius / edge * _RADIUS_BINS).astype(int), 0, _RADIUS_BINS - 1)
    counts = np.bincount(place, minlength=_RADIUS_BINS)
    shown = counts >= _FEWEST_FOR_MEAN
    mean = np.bincount(place, weights=outward, minlength=_RADIUS_BINS) / np.maximum(counts, 1)
    spread = np.bincount(place, weights=outward**2, minlength=_RADIUS_BINS) / np.maximum(counts, 1) - mean**2
    error = np.sqrt(np.maximum(spread, 0.0) / np.maximum(counts, 1))
    centre = (np.arange(_RADIUS_BINS) + 0.5) / _RADIUS_BINS * edge
    sigma = _corner_sigma(camera)
    axes.axhspan(-sigma, sigma, color=MUTED, alpha=0.15, linewidth=0.0)
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    if shown.any():
        axes.errorbar(
            centre[shown], mean[shown], 2.0 * error[shown], fmt="o-", color=ACCENT, markersize=3.0, linewidth=1.0
        )
    else:
        nothing_to_show(axes, "too few corners for means")
    limit = max(1.5 * sigma, 1.2 * float(np.abs(mean[shown]).max(initial=0.0)), 1e-6)
    axes.set_ylim(-limit, limit)
    axes.set_xlim(0.0, edge)
    label(axes, "distance from the image's centre [px]", "outward error [px]")
    return Picture(
        "Residual along the radius",
        to_svg(figure, prefix),
        "Mean outward residual by distance from the centre, bars at 2 sigma of the mean; the band is the corner noise.",
        "zero within the bars at every distance.",
        "a wave means that the distortion model has too few terms for this lens: choose a richer one.",
    )


def _frames_picture(camera: CameraCalibration, prefix: str) -> Picture:
    figure, (axes,) = panel()
    frames, rms = frame_rms(camera)
    times = camera.detections.timestamps_ns
    expected = np.sqrt(2.0) * _corner_sigma(camera)
    if len(frames):
        seconds = (times[frames] - times[0]) * 1e-9
        axes.plot(seconds, rms, "-", color=ACCENT, linewidth=0.7, alpha=0.5)
        axes.plot(seconds, rms, ".", color=ACCENT, markersize=3.5)
        worst = int(np.argmax(rms))
        axes.plot(seconds[worst], rms[worst], "o", markersize=7.0, markerfacecolor="none", markeredgecolor=BAD)
        axes.axhline(expected, color=INK, linestyle="--", linewidth=1.0)
        axes.set_ylim(0.0, 1.12 * max(float(rms.max()), 1.2 * expected))
        told = f"worst {rms[worst]:.2f} px at {seconds[worst]:.2f} s (ringed)"
    else:
        nothing_to_show(axes, "no corner used")
        told = "no frame was used"
    label(axes, "time [s]", "rms error of the frame [px]")
    return Picture(
        "Error over time",
        to_svg(figure, prefix),
        f"Root mean square error of each frame, {told}; dashed: what the corner noise explains ({expected:.3f} px).",
        "a level line near the dashed one.",
        "peaks that come with fast motion are blur or a wrong time offset; single frames are bad detections.",
    )


def _rejected(camera: CameraCalibration) -> np.ndarray:
    return camera.residuals_px[~camera.inlier & np.isfinite(camera.residuals_px).all(axis=1)]
