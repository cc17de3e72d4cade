"""Checkerboard and AprilGrid."""

import numbers
from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.targets.base import Target


def _check(name: str, counts: dict[str, int], lengths: dict[str, float]) -> None:
    for key, count in counts.items():
        if not isinstance(count, numbers.Integral) or count < 1:
            raise CalibrationError(f"{name}: {key} is {count}; expected a whole number, at least 1.")
    for key, length in lengths.items():
        if not isinstance(length, numbers.Real) or not np.isfinite(length) or length <= 0:
            raise CalibrationError(f"{name}: {key} is {length}; expected a positive length.")


@dataclass(frozen=True)
class Checkerboard(Target):
    """A checkerboard of `rows` x `cols` INNER corners, `spacing` metres apart (`col_spacing` too, unless given).

    Kalibr's `target_type: checkerboard`; its rowSpacingMeters is the distance between rows.
    """

    rows: int
    cols: int
    spacing: float
    col_spacing: float | None = None

    def __post_init__(self) -> None:
        _check("Checkerboard", {"rows": self.rows, "cols": self.cols}, {"spacing": self.spacing})
        if self.col_spacing is None:
            # One way to say it, so that a board equals itself after a round trip through yaml.
            object.__setattr__(self, "col_spacing", self.spacing)
        _check("Checkerboard", {}, {"col_spacing": self.col_spacing or 0.0})
        if min(self.rows, self.cols) < 2:
            raise CalibrationError("Checkerboard: at least 2 x 2 inner corners are needed; count the INNER corners.")

    @property
    def grid_shape(self) -> tuple[int, int]:
        return self.rows, self.cols

    @property
    def points(self) -> np.ndarray:
        y, x = np.mgrid[: self.rows, : self.cols].astype(np.float64)
        dx = self.col_spacing or self.spacing
        return np.stack([x * dx, y * self.spacing, np.zeros_like(x)], axis=-1).reshape(-1, 3)

    @property
    def is_half_turn_symmetric(self) -> bool:
        """Whether the board looks the same after half a turn, so that its orientation cannot be read off one image.

        With rows + cols odd the two ends differ in colour; otherwise half a turn maps black on black.
        """
        return (self.rows + self.cols) % 2 == 0

    def to_yaml(self) -> dict[str, object]:
        return {
            "target_type": "checkerboard",
            "targetCols": self.cols,
            "targetRows": self.rows,
            "rowSpacingMeters": self.spacing,
            "colSpacingMeters": self.col_spacing or self.spacing,
        }


@dataclass(frozen=True)
class AprilGrid(Target):
    """Kalibr's AprilGrid of `rows` x `cols` tags (36h11, two-bit black border).

    `tag_size` is a tag's edge in metres, `tag_spacing` the gap between tags as a fraction of the edge. Point index =
    row * 2 cols + column over the grid of tag corners, from the lower left, as Kalibr numbers them; tag k sits at
    tag row k // cols from below, tag column k % cols.
    """

    rows: int
    cols: int
    tag_size: float
    tag_spacing: float

    def __post_init__(self) -> None:
        _check(
            "AprilGrid",
            {"rows": self.rows, "cols": self.cols},
            {"tag_size": self.tag_size, "tag_spacing": self.tag_spacing},
        )
        if self.rows * self.cols > 587:
            raise CalibrationError(
                f"AprilGrid: {self.rows * self.cols} tags; the family 36h11 has 587. Use a smaller grid."
            )

    @property
    def grid_shape(self) -> tuple[int, int]:
        return 2 * self.rows, 2 * self.cols

    @property
    def points(self) -> np.ndarray:
        pitch = (1.0 + self.tag_spacing) * self.tag_size
        x = np.arange(2 * self.cols) // 2 * pitch + np.arange(2 * self.cols) % 2 * self.tag_size
        y = np.arange(2 * self.rows) // 2 * pitch + np.arange(2 * self.rows) % 2 * self.tag_size
        yy, xx = np.meshgrid(y, x, indexing="ij")
        return np.stack([xx, yy, np.zeros_like(xx)], axis=-1).reshape(-1, 3)

    def tag_points(self, tag_id: int) -> np.ndarray:
        """Point indices (4,) of one tag's corners, anticlockwise from the lower left as Kalibr orders them.

        Raises CalibrationError when the board has no such tag.
        """
        if not 0 <= tag_id < self.rows * self.cols:
            raise CalibrationError(f"AprilGrid: tag {tag_id} is not among its {self.rows * self.cols} tags, 0 onwards.")
        row, col = divmod(tag_id, self.cols)
        width = 2 * self.cols
        low = 2 * row * width + 2 * col
        return np.array([low, low + 1, low + width + 1, low + width])

    def to_yaml(self) -> dict[str, object]:
        return {
            "target_type": "aprilgrid",
            "tagCols": self.cols,
            "tagRows": self.rows,
            "tagSize": self.tag_size,
            "tagSpacing": self.tag_spacing,
        }
