"""The recording guide's drawings: where to hold the board, how to move the rig, which board. For docs_figures.py."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle
from scipy.spatial.transform import Rotation

from jaxcal.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Target, artwork_of

INK, MUTED, GOOD, BAD, ACCENT = "#23272e", "#6b7380", "#2f8f4e", "#c8402f", "#2e6fe4"
BOARD = AprilGrid(rows=4, cols=4, tag_size=0.04, tag_spacing=0.3)
# The image that the drawings show: a camera of 70 degrees.
WIDTH, HEIGHT, FOCAL = 640.0, 480.0, 457.0
_PER_MM = 1e-3


def drawings() -> dict[str, Callable[[], Figure]]:
    """Every drawing by the name of its file."""
    return {"guide-views": views, "guide-motion": motion, "guide-boards": boards, "guide-mistakes": mistakes}


def views() -> Figure:
    """Eight views that a good recording has, as the camera sees them."""
    cases = [
        ("head-on, large", (0, 0, 0), (0.0, 0.0, 0.30)),
        ("into every corner", (0, 0, 0), (-0.165, -0.115, 0.40)),
        ("... also this one", (0, 0, 0), (0.165, 0.115, 0.40)),
        ("cut by the rim (AprilGrid)", (0, 0, 0), (0.26, -0.02, 0.38)),
        ("tilted left, right: 30 to 45°", (0, 42, 0), (0.0, 0.0, 0.33)),
        ("tilted up, down: 30 to 45°", (42, 0, 0), (0.0, 0.0, 0.33)),
        ("turned in the plane", (0, 0, 40), (-0.03, 0.0, 0.38)),
        ("far: a quarter of the width", (15, -15, 0), (0.05, 0.03, 0.75)),
    ]
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    for axes, (title, turn, place) in zip(figure.subplots(2, 4).ravel(), cases, strict=True):
        image_frame(axes, title)
        draw_board(axes, BOARD, turn, place)
    return figure


def mistakes() -> Figure:
    """Four recordings that do not work."""
    figure = Figure(figsize=(10.0, 2.5), layout="constrained")
    small, same, bent, blurred = figure.subplots(1, 4)
    image_frame(small, "small, always in the middle", BAD)
    draw_board(small, BOARD, (0, 0, 0), (0.0, 0.0, 1.1))
    image_frame(same, "always parallel: no tilt", BAD)
    for place in ((-0.15, -0.1, 0.62), (0.0, 0.02, 0.62), (0.16, 0.12, 0.62)):
        draw_board(same, BOARD, (0, 0, 0), place)
    image_frame(bent, "paper that bends", BAD)
    draw_board(bent, BOARD, (12, 25, 0), (0.0, 0.0, 0.34), bend=0.05)
    image_frame(blurred, "blur: too fast, too dark", BAD)
    for shift in np.linspace(-0.022, 0.022, 12):
        draw_board(blurred, BOARD, (5, 10, 0), (shift, 0.4 * shift, 0.38), alpha=0.1)
    return figure


def motion() -> Figure:
    """The rig with the three turns and the three pushes, and a minute's plan."""
    figure = Figure(figsize=(10.0, 4.4))
    left = figure.add_axes((0.0, 0.27, 0.5, 0.7))
    right = figure.add_axes((0.5, 0.27, 0.5, 0.7))
    plan = figure.add_axes((0.05, 0.02, 0.9, 0.21))
    _rig(left, "turn about each axis, there and back", turns=True)
    _rig(right, "push along each axis, briskly", turns=False)
    _plan(plan)
    return figure


def boards() -> Figure:
    """The four kinds of boards."""
    kinds: list[tuple[str, str, Target]] = [
        ("aprilgrid", "part of it is enough", AprilGrid(rows=5, cols=5, tag_size=0.03, tag_spacing=0.3)),
        (
            "charuco",
            "part of it is enough",
            Charuco(rows=6, cols=6, square_size=0.03, marker_size=0.022, dictionary="DICT_5X5_100"),
        ),
        ("checkerboard", "all of it must be seen", Checkerboard(rows=6, cols=7, spacing=0.025)),
        ("circlegrid", "all of it must be seen", CircleGrid(rows=7, cols=7, spacing=0.025)),
    ]
    figure = Figure(figsize=(10.0, 3.1), layout="constrained")
    for axes, (name, remark, target) in zip(figure.subplots(1, 4), kinds, strict=True):
        cells = flat_cells(target)
        axes.add_collection(
            PolyCollection([cell[:, :2] for cell in cells], facecolors=INK, edgecolors=INK, linewidths=0.3)
        )
        for lattice in artwork_of(target).discs:
            for centre in lattice.centres:
                axes.add_patch(Circle((centre[0], centre[1]), lattice.radius, color=INK))
        art = artwork_of(target)
        low, high = (art.x_lines[0], art.y_lines[0]), (art.x_lines[-1], art.y_lines[-1])
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_axis_off()
        axes.set_title(f"{name}\n", fontsize=11, color=INK, fontweight="bold")
        axes.text(0.5, 1.02, remark, transform=axes.transAxes, ha="center", va="bottom", fontsize=9, color=MUTED)
    return figure


# --- parts -----------------------------------------------------------------------------------------------------------


def image_frame(axes: Axes, title: str, colour: str = GOOD) -> None:
    """Empty axes that stand for a camera's image."""
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0), aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor("#eef0f3")
    for spine in axes.spines.values():
        spine.set(color=colour, linewidth=1.6)
    axes.set_title(title, fontsize=9, color=INK)


def flat_cells(target: Target) -> list[np.ndarray]:
    """Corners (4, 3) of the black rectangles of a board, m."""
    art = artwork_of(target)
    x, y = art.x_lines, art.y_lines
    return [
        np.array([[x[j], y[i], 0.0], [x[j + 1], y[i], 0.0], [x[j + 1], y[i + 1], 0.0], [x[j], y[i + 1], 0.0]])
        for i, j in zip(*np.nonzero(art.black), strict=True)
    ]


def draw_board(
    axes: Axes,
    target: Target,
    turn_deg: tuple[float, float, float],
    place: tuple[float, float, float],
    *,
    alpha: float = 1.0,
    bend: float = 0.0,
) -> None:
    """A board whose middle is at `place` (m, camera frame: x right, y down, z forward), turned by xyz angles.

    `bend` raises its middle by so much, m, as paper that curls.
    """
    cells = flat_cells(target)
    art = artwork_of(target)
    x0, x1, y0, y1 = art.x_lines[0], art.x_lines[-1], art.y_lines[0], art.y_lines[-1]
    side = np.linspace(0.0, 1.0, 24)
    rim = np.concatenate(
        [
            np.column_stack([x0 + (x1 - x0) * side, np.full_like(side, y0)]),
            np.column_stack([np.full_like(side, x1), y0 + (y1 - y0) * side]),
            np.column_stack([x1 - (x1 - x0) * side, np.full_like(side, y1)]),
            np.column_stack([np.full_like(side, x0), y1 - (y1 - y0) * side]),
        ]
    )
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
    # The board's z comes towards the camera, and its y is up.
    rotation = Rotation.from_euler("xyz", turn_deg, degrees=True) * Rotation.from_euler("x", 180.0, degrees=True)

    def image(points: np.ndarray) -> np.ndarray:
        raised = points - middle
        raised[:, 2] += bend * (1.0 - (2.0 * raised[:, 0] / (x1 - x0)) ** 2)
        seen = rotation.apply(raised) + place
        return FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]

    outline = image(np.column_stack([rim, np.zeros(len(rim))]))
    axes.add_patch(Polygon(outline, facecolor="white", edgecolor=MUTED, linewidth=0.6, alpha=alpha))
    axes.add_collection(
        PolyCollection([image(cell) for cell in cells], facecolors=INK, edgecolors=INK, linewidths=0.3, alpha=alpha)
    )


def _rig(axes: Axes, title: str, *, turns: bool) -> None:
    """A box with a lens, its axes, and arrows around or along them."""
    axes.set(xlim=(-2.1, 2.1), ylim=(-1.5, 1.75), aspect="equal")
    axes.set_axis_off()
    axes.text(0.0, 1.62, title, ha="center", va="center", fontsize=11, color=INK)
    axes.add_patch(Rectangle((-0.55, -0.32), 1.1, 0.64, facecolor="#d9dee6", edgecolor=INK, linewidth=1.2))
    axes.add_patch(Circle((-0.18, 0.0), 0.22, facecolor="#5a6270", edgecolor=INK, linewidth=1.2))
    axes.add_patch(Circle((-0.18, 0.0), 0.1, facecolor="#23272e"))
    axes.text(0.3, 0.0, "IMU", ha="center", va="center", fontsize=8, color=INK)
    for colour, direction in (("#c8402f", (1.0, 0.0)), ("#2f8f4e", (0.0, 1.0)), ("#2e6fe4", (-0.62, -0.62))):
        d = np.array(direction)
        if turns:
            axes.plot(*np.array([0.62 * d, 1.35 * d]).T, color=colour, linewidth=1.4)
            across = np.array([-d[1], d[0]]) * 0.42 / np.linalg.norm(d)
            start, end = 1.2 * d - across, 1.2 * d + across
            axes.add_patch(_arrow(start, end, colour, "arc3,rad=0.75"))
            axes.add_patch(_arrow(end - 0.06 * d, start - 0.06 * d, colour, "arc3,rad=0.75"))
        else:
            axes.add_patch(_arrow(0.7 * d, 1.45 * d, colour, "arc3,rad=0"))
            axes.add_patch(_arrow(-0.7 * d, -1.45 * d if direction != (0.0, 1.0) else -1.3 * d, colour, "arc3,rad=0"))


def _arrow(start: np.ndarray, end: np.ndarray, colour: str, path: str) -> FancyArrowPatch:
    return FancyArrowPatch(
        (float(start[0]), float(start[1])), (float(end[0]), float(end[1])), arrowstyle="-|>", mutation_scale=13.0,
        color=colour, linewidth=1.6, connectionstyle=path,
    )  # fmt: skip


def _plan(axes: Axes) -> None:
    """A minute of recording, in four parts."""
    parts = [
        (0, 5, "start, slowly", "#d9dee6"),
        (5, 25, "through the whole image, near and far", "#cfe3d6"),
        (25, 40, "tilts, 30 to 45°, all sides", "#d3e0f7"),
        (40, 60, "turn and push about all axes, board in view", "#f7dcc8"),
    ]
    axes.set(xlim=(0, 60), ylim=(-0.9, 1.15))
    axes.set_axis_off()
    for start, end, text, colour in parts:
        axes.add_patch(Rectangle((start, 0), end - start, 1, facecolor=colour, edgecolor="white"))
        axes.text((start + end) / 2, 0.5, text if start else "start,\nslowly", ha="center", va="center", fontsize=9)
    for second in (0, 5, 25, 40, 60):
        axes.text(second, -0.45, f"{second} s", ha="center", va="center", fontsize=9, color=MUTED)
