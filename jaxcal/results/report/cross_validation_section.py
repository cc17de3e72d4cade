"""The report's section about a cross-validation: what it found in words, what was tested, and the map of the halves."""

from dataclasses import dataclass

import numpy as np
from matplotlib.ticker import FuncFormatter

from jaxcal.results.cross_validation import CrossValidation, Halves
from jaxcal.results.difference import CameraDifference
from jaxcal.results.report.drawing import ACCENT, INK, MUTED, WARN, Picture, image_panel, nothing_to_show, to_svg
from jaxcal.results.report.projection_figure import contour_levels

_ARROWS = 14  # across


@dataclass(frozen=True)
class TestedRow:
    """One cause that was tested, as text; `found` marks those that are there."""

    name: str
    gain: str
    freedom: str
    held_back: str
    p_value: str
    found: bool


@dataclass(frozen=True)
class CrossValidationSection:
    """All that the template needs. `halves`: name and what was found; `flagged`: there is more than noise."""

    headline: str
    flagged: bool
    causes: tuple[str, ...]
    halves: tuple[tuple[str, str], ...]
    rows: tuple[TestedRow, ...]
    threshold: str
    notes: tuple[str, ...]
    pictures: tuple[Picture, ...]


def cross_validation_section(found: CrossValidation) -> CrossValidationSection:
    """The section's content. Maps are those of the halves that differ most, one per camera."""
    worst = min(found.halves, key=lambda half: half.p_value)
    return CrossValidationSection(
        headline=found.headline,
        flagged=found.flagged,
        causes=tuple(cause.sentence for cause in found.causes),
        halves=tuple((f"halves {half.split}", _told(half)) for half in found.halves),
        rows=tuple(
            TestedRow(
                f"{e.subject}: {e.cause}",
                f"{e.gain:.1f}",
                str(e.freedom),
                f"{e.held_back:.1f}",
                f"{e.p_value:.2g}",
                e.found,
            )
            for e in found.evidence
        ),
        threshold=f"{found.threshold:.2g}",
        notes=found.notes,
        pictures=tuple(
            halves_picture(worst, camera, f"halves{c}") for c, camera in enumerate(worst.difference.cameras)
        ),
    )


def _told(half: Halves) -> str:
    parts = [f"chi-squared {half.gain:.0f} of {half.freedom} (p {half.p_value:.2g})"]
    for camera in half.difference.cameras:
        noise = "" if camera.normalised is None else f", {camera.normalised:.1f} times the noise"
        parts.append(f"{camera.name} {camera.rms_px:.2g} px{noise}")
    return "; ".join(parts)


def halves_picture(half: Halves, camera: CameraDifference, prefix: str) -> Picture:
    """How far the two halves' projections are apart over the image of one camera, at the range of the corners."""
    width, height = (int(side) + 1 for side in camera.pixels[-1, -1].round())
    figure, axes = image_panel((width, height))
    place = int(np.argmax(camera.at_ranges)) if camera.at_ranges.any() else len(camera.ranges_m) - 1
    size = np.ma.masked_invalid(camera.size_px[place])
    x, y = camera.pixels[0, :, 0], camera.pixels[:, 0, 1]
    if not camera.observed.all():
        axes.contourf(x, y, ~camera.observed, levels=[0.5, 1.5], colors=[WARN], alpha=0.22)
    levels = contour_levels(size.compressed())
    if len(levels):
        lines = axes.contour(x, y, size, levels=levels, colors=[ACCENT], linewidths=1.2)
        axes.clabel(lines, fmt=FuncFormatter(lambda value, _: f"{value:g}"), fontsize=8.0, colors=[INK])
    step = max(1, len(x) // _ARROWS)
    there = np.where(camera.observed[..., None], np.nan_to_num(camera.difference_px[place]), 0.0)[::step, ::step]
    if np.linalg.norm(there, axis=-1).max() > 0:
        axes.quiver(x[::step], y[::step], there[..., 0], there[..., 1], color=MUTED, angles="xy", width=0.004)
    else:
        nothing_to_show(axes, "no difference")
    where = "at infinity" if np.isinf(camera.ranges_m[place]) else f"{camera.ranges_m[place]:.2g} m away"
    sigma = "" if camera.sigma_px is None else f" The noise of the corners explains {camera.sigma_px:.2g} px (1-sigma)."
    return Picture(
        f"{camera.name}: halves {half.split}",
        to_svg(figure, prefix),
        f"How far the projections of two halves are apart, points {where}, px; arrows: which way. Tinted: not seen by "
        f"both halves. {camera.rms_px:.2g} px rms where both saw corners.{sigma}",
        "differences no larger than the noise explains, in no order.",
        "arrows in a pattern are an error of the model; the list above names the likely one.",
    )
