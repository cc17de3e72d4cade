"""Targets as printable pages: PDF and SVG, vector graphics true to size."""

import dataclasses
import io
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxcal.atomic import write_bytes
from jaxcal.errors import CalibrationError
from jaxcal.targets.artwork import Artwork, artwork_of
from jaxcal.targets.base import Target
from jaxcal.targets.charuco import Charuco
from jaxcal.targets.circles import CircleGrid
from jaxcal.targets.grids import AprilGrid, Checkerboard
from jaxcal.targets.outline import outlines

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Width and height in millimetres, upright; the smallest first.
PAGES = {
    "letter": (215.9, 279.4),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
}
_CHOSEN_FROM = ("A4", "A3", "A2", "A1", "A0")
_RIM_MM = 6.0  # printers leave the edge of a page white
_CAPTION_MM = 16.0  # at the lower edge
_RULER_MM = 100.0
_MM_PER_INCH = 25.4


@dataclasses.dataclass(frozen=True)
class Sheet:
    """A drawn page: its name ('A3', or 'custom'), its size in mm, and where the target frame's origin is on it.

    `origin_mm` runs from the page's lower left corner to the right and upwards.
    """

    page: str
    width_mm: float
    height_mm: float
    origin_mm: tuple[float, float]


def draw_target(target: Target, path: str | Path, page: str = "auto") -> Sheet:
    """Draw a board for printing at 100 %, with a caption and a ruler of 100 mm to check the print by.

    `path` ends in .pdf or .svg. `page` is 'letter', 'A4' to 'A0', a size such as '600x400' in millimetres, or 'auto'
    for the smallest of A4 to A0 that holds the board; named pages are turned as it fits. Raises CalibrationError when
    the board does not fit, saying which page would, and for several boards, which are drawn one by one.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("pdf", "svg"):
        raise CalibrationError(f"{path}: the drawing's name must end in .pdf or .svg.")
    artwork = artwork_of(target)
    low, high = (1000.0 * corner for corner in _ink(artwork))
    sheet = _sheet(low, high, page)
    write_bytes(path, _rendered(_figure(artwork, sheet, _caption(target)), kind))
    return sheet


def _ink(artwork: Artwork) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right (2,) of all that is black, metres."""
    rows, cols = np.nonzero(artwork.black)
    low, high = [], []
    if len(rows):
        low.append([artwork.x_lines[cols.min()], artwork.y_lines[rows.min()]])
        high.append([artwork.x_lines[cols.max() + 1], artwork.y_lines[rows.max() + 1]])
    for discs in artwork.discs:
        low.append((discs.centres - discs.radius).min(axis=0))
        high.append((discs.centres + discs.radius).max(axis=0))
    return np.min(low, axis=0), np.max(high, axis=0)


# --- the page --------------------------------------------------------------------------------------------------------


def _sheet(low: np.ndarray, high: np.ndarray, page: str) -> Sheet:
    """The page for ink from `low` to `high` (mm, target frame)."""
    width, height = _needed(high - low)
    fitting = next((name for name in _CHOSEN_FROM if _turned(PAGES[name], width, height)), None)
    own = f"a page of at least {np.ceil(width):.0f}x{np.ceil(height):.0f} mm"
    if page == "auto":
        if fitting is None:
            raise CalibrationError(
                f"the target needs {width:.0f} x {height:.0f} mm with its caption and does not fit on A0; give {own}."
            )
        page = fitting
    size = _page_size(page)
    chosen = _turned(size, width, height)
    if chosen is None:
        remedy = f"{fitting} would hold it" if fitting else f"give {own}"
        raise CalibrationError(
            f"the target needs {width:.0f} x {height:.0f} mm with its caption and does not fit on {page} "
            f"({size[0]:g} x {size[1]:g} mm); {remedy}, or make it smaller."
        )
    # In the middle of what the caption leaves free.
    origin = 0.5 * (np.array(chosen) - (high - low) + [0.0, _CAPTION_MM]) - low
    name = page if page in PAGES else "custom"
    return Sheet(name, *chosen, (float(origin[0]), float(origin[1])))


def _needed(ink: np.ndarray) -> tuple[float, float]:
    """Width and height of a page (mm) that holds the ink and the caption."""
    width = max(float(ink[0]), _RULER_MM + 4.0) + 2.0 * _RIM_MM
    return width, float(ink[1]) + 2.0 * _RIM_MM + _CAPTION_MM


def _turned(size: tuple[float, float], width: float, height: float) -> tuple[float, float] | None:
    """The page, upright or lying, that holds width x height mm; None where neither does."""
    for across, up in (size, size[::-1]):
        if width <= across + 1e-6 and height <= up + 1e-6:
            return across, up
    return None


def _page_size(page: str) -> tuple[float, float]:
    for name, size in PAGES.items():
        if page.lower() == name.lower():
            return size
    custom = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page)
    if custom is None:
        raise CalibrationError(
            f"page '{page}' is unknown; give auto, {', '.join(PAGES)}, or a size in millimetres such as 600x400."
        )
    return float(custom[1]), float(custom[2])


def _caption(target: Target) -> str:
    """One line that says what the page shows, so that a board on a wall can be measured and used."""
    if isinstance(target, AprilGrid):
        return (
            f"aprilgrid: {target.rows} rows x {target.cols} columns of tags 36h11, ids {target.ids[0]} to "
            f"{target.ids[-1]}, tag {1e3 * target.tag_size:g} mm, gap {1e3 * target.tag_size * target.tag_spacing:g} mm"
        )
    if isinstance(target, Checkerboard):
        return (
            f"checkerboard: {target.rows} rows x {target.cols} columns of INNER corners, "
            f"{1e3 * target.spacing:g} mm between rows, {1e3 * (target.col_spacing or target.spacing):g} mm between "
            "columns"
        )
    if isinstance(target, CircleGrid):
        kind = "asymmetric" if target.asymmetric else "symmetric"
        return (
            f"circlegrid, {kind}: {target.rows} rows x {target.cols} columns, spacing {1e3 * target.spacing:g} mm, "
            f"diameter {1e3 * target.circle_diameter:g} mm"
        )
    if isinstance(target, Charuco):
        legacy = ", legacy pattern" if target.legacy else ""
        return (
            f"charuco: {target.rows} rows x {target.cols} columns of SQUARES, square {1e3 * target.square_size:g} mm, "
            f"marker {1e3 * target.marker_size:g} mm, {target.dictionary}, ids {target.ids[0]} to "
            f"{target.ids[-1]}{legacy}"
        )
    return type(target).__name__


# --- the drawing -----------------------------------------------------------------------------------------------------


def _figure(artwork: Artwork, sheet: Sheet, caption: str) -> "Figure":
    """The page as a figure whose data coordinates are millimetres from its lower left corner."""
    from matplotlib.figure import Figure  # slow to import, and only needed here
    from matplotlib.patches import Circle, PathPatch
    from matplotlib.path import Path as Outline

    figure = Figure(figsize=(sheet.width_mm / _MM_PER_INCH, sheet.height_mm / _MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, sheet.width_mm)
    axes.set_ylim(0.0, sheet.height_mm)
    origin = np.array(sheet.origin_mm)
    # One path for all rectangles: drawn one by one, they would show hairlines where they meet.
    loops = outlines(artwork.x_lines, artwork.y_lines, artwork.black)
    if loops:
        closed = [np.concatenate([loop, loop[:1]]) * 1000.0 + origin for loop in loops]
        codes = [[Outline.MOVETO, *[Outline.LINETO] * (len(loop) - 2), Outline.CLOSEPOLY] for loop in closed]
        axes.add_patch(PathPatch(Outline(np.concatenate(closed), np.concatenate(codes)), facecolor="black", lw=0.0))
    for discs in artwork.discs:
        for centre in discs.centres * 1000.0 + origin:
            axes.add_patch(Circle((centre[0], centre[1]), discs.radius * 1000.0, facecolor="black", lw=0.0))
    _add_caption(axes, sheet, caption)
    return figure


def _add_caption(axes: "Axes", sheet: Sheet, caption: str) -> None:
    """The caption and the ruler, below the board."""
    left, base = 0.5 * (sheet.width_mm - _RULER_MM), _RIM_MM + 4.0
    axes.plot([left, left + _RULER_MM], [base, base], color="black", lw=0.5, solid_capstyle="butt")
    for mark in np.arange(0.0, _RULER_MM + 1.0, 10.0):
        height = 3.0 if mark in (0.0, _RULER_MM) else 1.5
        axes.plot([left + mark] * 2, [base, base + height], color="black", lw=0.25, solid_capstyle="butt")
    # Text that fits the page: a letter is about half as wide as it is high.
    points = min(7.0, 2.0 * (sheet.width_mm - 2.0 * _RIM_MM) / len(caption) / _MM_PER_INCH * 72.0)
    middle = 0.5 * sheet.width_mm
    axes.text(middle, base + 4.0, caption, fontsize=points, ha="center", va="bottom")
    check = "Print at 100 % (no 'fit to page'). This line is 100 mm long; this edge is below."
    axes.text(middle, base - 1.0, check, fontsize=min(points, 6.0), ha="center", va="top")


def _rendered(figure: "Figure", kind: str) -> bytes:
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    content = io.BytesIO()
    # The same target gives the same file, and text looks the same everywhere.
    metadata = {"CreationDate": None} if kind == "pdf" else {"Date": None}
    with rc_context({"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "jaxcal", "path.simplify": False}):
        figure.savefig(content, format=kind, metadata=metadata)
    return content.getvalue()
