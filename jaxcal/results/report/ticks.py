"""Ticks, grid and tick labels of a small figure from a handful of artists, where matplotlib makes five for each."""

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter, NullLocator
from matplotlib.transforms import ScaledTranslation

_LENGTH = 3.0  # of a tick, points
_GAP = 5.5  # from the axes to the labels' near edge, points
_POINTS = 72.0  # in an inch


def draw_ticks(figure: Figure, colour: str, grid_colour: str, font_size: float) -> None:
    """Replace the ticks of a finished figure (limits, locators and formatters as they will be drawn) by few artists.

    Ticks stand where the axes' own would, with their labels; the grid is drawn where the axes had one. A quarter of
    the time that a page of many small figures takes goes into matplotlib's own ticks.
    """
    for axes in figure.axes:
        axes.apply_aspect()
        for axis, below in ((axes.xaxis, True), (axes.yaxis, False)):
            shown, grid, labelled = _shown(axis)
            if labelled:
                _labels(axes, shown, below, colour, font_size, axis.get_major_formatter().get_offset())
            places = [place for place, _ in shown]
            _marks(axes, places, below, colour)
            if grid:
                _grid(axes, places, below, grid_colour)
    # Only now: axes that share x share its locator.
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(NullLocator())
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(NullFormatter())


def _shown(axis: Axis) -> tuple[list[tuple[float, str]], bool, bool]:
    """Places and labels of the ticks in view; whether the axis has a grid; and labels (upper ones of shared x have
    none)."""
    low, high = sorted(axis.get_view_interval())
    slack = 1e-9 * (high - low)
    places = [float(place) for place in axis.get_majorticklocs()]
    labels = axis.get_major_formatter().format_ticks(places)
    told = axis.get_tick_params(which="major")
    return (
        [(at, text) for at, text in zip(places, labels, strict=True) if low - slack <= at <= high + slack],
        bool(told.get("gridOn", False)),
        any(told.get(f"label{side}", False) for side in ("bottom", "left")),
    )


def _labels(
    axes: Axes, shown: list[tuple[float, str]], below: bool, colour: str, font_size: float, offset: str
) -> None:
    scale = axes.figure.dpi_scale_trans
    if below:
        place = axes.get_xaxis_transform() + ScaledTranslation(0.0, -_GAP / _POINTS, scale)
        for at, text in shown:
            axes.text(at, 0.0, text, transform=place, ha="center", va="top", color=colour, fontsize=font_size)
    else:
        place = axes.get_yaxis_transform() + ScaledTranslation(-_GAP / _POINTS, 0.0, scale)
        for at, text in shown:
            axes.text(
                0.0, at, text, transform=place, ha="right", va="center_baseline", color=colour, fontsize=font_size
            )
    if offset:
        x, y, across, down = (1.0, 0.02, "right", "bottom") if below else (0.0, 1.0, "left", "bottom")
        axes.text(x, y, offset, transform=axes.transAxes, ha=across, va=down, color=colour, fontsize=font_size)


def _marks(axes: Axes, places: list[float], below: bool, colour: str) -> None:
    """Short lines outside the axes, as one line of markers."""
    zeros = [0.0] * len(places)
    axes.add_artist(
        Line2D(
            places if below else zeros,
            zeros if below else places,
            transform=axes.get_xaxis_transform() if below else axes.get_yaxis_transform(),
            linestyle="none",
            marker=3 if below else 0,  # a tick down, to the left
            markersize=_LENGTH,
            color=colour,
            markeredgewidth=0.8,
            clip_on=False,
        )
    )


def _grid(axes: Axes, places: list[float], below: bool, colour: str) -> None:
    """All lines of one direction as one broken line, below everything."""
    along, across = [], []
    for at in places:
        along += [at, at, float("nan")]
        across += [0.0, 1.0, float("nan")]
    axes.add_artist(
        Line2D(
            along if below else across,
            across if below else along,
            transform=axes.get_xaxis_transform() if below else axes.get_yaxis_transform(),
            color=colour,
            linewidth=0.6,
            alpha=0.6,
            zorder=0.5,
        )
    )
