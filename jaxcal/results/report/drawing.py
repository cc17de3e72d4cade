"""Drawing figures that take their colours from the page: matplotlib figures to SVG for use inside HTML."""

import base64
import io
import re
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation
from PIL import Image

from jaxcal.results.report.ticks import draw_ticks

# Colours that stand for a CSS variable of the page and are exchanged for it in the SVG, so that one figure serves the
# light and the dark page. Raster parts cannot do this: they use the fixed colours below, readable on either.
_CSS_VARIABLES = {
    "#010101": "--ink",
    "#020202": "--muted",
    "#030303": "--line",
    "#040404": "--bad",
    "#050505": "--axis-x",
    "#060606": "--axis-y",
    "#070707": "--axis-z",
    "#080808": "--accent",
    "#090909": "--usable",
    "#0a0a0a": "--paper",
}
INK, MUTED, LINE, BAD, X, Y, Z, ACCENT, WARN, PAPER = _CSS_VARIABLES
AXIS_COLOURS = (X, Y, Z)
POINT = "#4f8fd9"  # for raster points
REJECTED = "#e2574c"

PANEL = (4.4, 3.3)  # inches; three abreast on a desk, one on a phone
_FONT_SIZE = 9.0
_LABEL_BELOW = 0.235  # inches from the axes to the name of x
_TICKS = 4  # intervals along an axis, at most
_SETTINGS_LOCK = threading.Lock()  # matplotlib's SVG writer reads process-wide settings
_RASTER_DPI = 110
_RASTER_COLOURS = 48  # dots of two colours and their blends: a palette is a quarter of the bytes


@dataclass(frozen=True)
class Picture:
    """A figure of the report. `shows`, `good` and `otherwise` (what to do if it does not look so) form the caption."""

    title: str
    svg: str
    shows: str
    good: str
    otherwise: str


def panel(rows: int = 1, size: tuple[float, float] = PANEL) -> tuple[Figure, Sequence[Axes]]:
    """A figure with `rows` axes below each other that share x, dressed in the report's colours."""
    figure = Figure(figsize=size)
    grid = figure.subplots(rows, 1, sharex=True, squeeze=False, gridspec_kw={"hspace": 0.12})[:, 0]
    bottom = 0.145 * PANEL[1] / size[1]
    figure.subplots_adjust(left=0.185, right=0.975, top=0.97, bottom=bottom)
    for axes in grid:
        _dress(axes)
        axes.yaxis.set_label_coords(-0.19, 0.5)
        axes.xaxis.set_label_coords(
            0.5, 0.0, axes.transAxes + ScaledTranslation(0.0, -_LABEL_BELOW, figure.dpi_scale_trans)
        )
    return figure, list(grid)


def image_panel(image_size: tuple[int, int]) -> tuple[Figure, Axes]:
    """A figure whose axes are an image's pixels: square, y downwards."""
    figure, (axes,) = panel()
    width, height = image_size
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.yaxis.set_label_coords(-0.15, 0.5)
    for spine in axes.spines.values():
        spine.set_visible(True)
    label(axes, "u [px]", "v [px]")
    return figure, axes


def label(axes: Axes, x: str, y: str) -> None:
    """Names of both axes, in the page's ink."""
    axes.set_xlabel(x, color=INK, fontsize=_FONT_SIZE)
    axes.set_ylabel(y, color=INK, fontsize=_FONT_SIZE)


def note(axes: Axes, text: str, x: float = 0.98, y: float = 0.97) -> None:
    """A remark in a corner of the axes (position in fractions of the axes)."""
    axes.text(
        x,
        y,
        text,
        transform=axes.transAxes,
        ha="right" if x > 0.5 else "left",
        va="top" if y > 0.5 else "bottom",
        fontsize=_FONT_SIZE - 1.0,
        color=INK,
        bbox={"facecolor": PAPER, "edgecolor": "none", "alpha": 0.75, "pad": 1.5},
    )


def legend(axes: Axes, **options: object) -> None:
    """A legend in the page's colours; `options` as matplotlib's."""
    axes.legend(
        **{
            "fontsize": _FONT_SIZE - 1.0,
            "labelcolor": INK,
            "frameon": True,
            "facecolor": PAPER,
            "edgecolor": "none",
            "framealpha": 0.75,
            "borderpad": 0.2,
            "handlelength": 1.4,
            **options,
        }  # pyright: ignore[reportArgumentType]
    )


def nothing_to_show(axes: Axes, text: str) -> None:
    """Say in the middle of empty axes why they are empty."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=MUTED, fontsize=_FONT_SIZE)


def normal_density(x: np.ndarray) -> np.ndarray:
    """The density of N(0, 1) at x, any shape."""
    return np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)


def to_svg(figure: Figure, prefix: str) -> str:
    """The figure as an `<svg>` element that scales with the page; `prefix` keeps its ids apart from other figures'."""
    buffer = io.StringIO()
    draw_ticks(figure, MUTED, LINE, _FONT_SIZE - 1.0)
    # Text stays text (smaller, selectable); the salt makes ids, and so the page, the same in every run.
    with _SETTINGS_LOCK, mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxcal"}):
        figure.savefig(buffer, format="svg", transparent=True, dpi=_RASTER_DPI)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"data:image/png;base64,([^\"]+)", _smaller, svg)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'\bid="', f'id="{prefix}-', svg)
    svg = svg.replace("url(#", f"url(#{prefix}-").replace('href="#', f'href="#{prefix}-')
    return re.sub(r"#0[0-9a]0[0-9a]0[0-9a]\b", _variable, svg)


def _smaller(match: re.Match[str]) -> str:
    """A picture inside the SVG with a palette."""
    content = io.BytesIO()
    image = Image.open(io.BytesIO(base64.b64decode(match.group(1)))).convert("RGBA")
    image.quantize(_RASTER_COLOURS, method=Image.Quantize.FASTOCTREE).save(content, "png")
    return "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()


def _variable(match: re.Match[str]) -> str:
    name = _CSS_VARIABLES.get(match.group(0))
    return f"var({name})" if name else match.group(0)


def _dress(axes: Axes) -> None:
    axes.set_facecolor("none")
    for side, spine in axes.spines.items():
        spine.set_color(LINE)
        spine.set_linewidth(0.8)
        spine.set_visible(side in ("left", "bottom"))
    axes.locator_params(nbins=_TICKS)
    axes.grid(visible=True)
    axes.set_axisbelow(True)
