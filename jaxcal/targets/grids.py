"""Checkerboard and AprilGrid."""

from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.targets.base import Target, check_fields, check_id, grid_points, grid_turns

TAGS_IN_FAMILY = 587  # of 36h11


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
        check_fields("Checkerboard", {"rows": self.rows, "cols": self.cols}, {"spacing": self.spacing})
        if self.col_spacing is None:
            # One way to say it, so that a board equals itself after a round trip through yaml.
            object.__setattr__(self, "col_spacing", self.spacing)
        check_fields("Checkerboard", {}, {"col_spacing": self.col_spacing or 0.0})
        if min(self.rows, self.cols) < 2:
            raise CalibrationError("Checkerboard: at least 2 x 2 inner corners are needed; count the INNER corners.")

    @property
    def grid_shape(self) -> tuple[int, int]:
        return self.rows, self.cols

    @property
    def points(self) -> np.ndarray:
        return grid_points(self.rows, self.cols, self.spacing, self.col_spacing or self.spacing)

    @property
    def turns(self) -> np.ndarray:
        # With rows + cols odd the two ends differ in colour; otherwise half a turn maps black on black. A square
        # board with an odd number of squares along its side has the same colour at all four ends.
        half = (self.rows + self.cols) % 2 == 0
        square = self.rows == self.cols and self.spacing == self.col_spacing
        return grid_turns(self.rows, self.cols, half, quarter=square and self.rows % 2 == 0)

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
    tag row k // cols from below, tag column k % cols. Its printed id is `first_id` + k: boards that are seen together
    need different ids (0 in Kalibr, which knows no other; yaml key `firstTagId`).
    """

    rows: int
    cols: int
    tag_size: float
    tag_spacing: float
    first_id: int = 0

    def __post_init__(self) -> None:
        check_fields(
            "AprilGrid",
            {"rows": self.rows, "cols": self.cols},
            {"tag_size": self.tag_size, "tag_spacing": self.tag_spacing},
        )
        check_id("AprilGrid", "first_id", self.first_id)
        if self.rows * self.cols > TAGS_IN_FAMILY:
            raise CalibrationError(
                f"AprilGrid: {self.rows * self.cols} tags; the family 36h11 has {TAGS_IN_FAMILY}. Use a smaller grid."
            )
        if self.first_id + self.rows * self.cols > TAGS_IN_FAMILY:
            raise CalibrationError(
                f"AprilGrid: ids {self.first_id} to {self.ids[-1]}; the family 36h11 ends at {TAGS_IN_FAMILY - 1}. "
                "Use a smaller first_id."
            )

    @property
    def ids(self) -> range:
        """The printed ids of its tags."""
        return range(self.first_id, self.first_id + self.rows * self.cols)

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

        `tag_id` is the printed id. Raises CalibrationError when the board has no such tag.
        """
        if tag_id not in self.ids:
            raise CalibrationError(
                f"AprilGrid: tag {tag_id} is not among its {len(self.ids)} tags, {self.first_id} onwards."
            )
        row, col = divmod(tag_id - self.first_id, self.cols)
        width = 2 * self.cols
        low = 2 * row * width + 2 * col
        return np.array([low, low + 1, low + width + 1, low + width])

    def to_yaml(self) -> dict[str, object]:
        kalibr: dict[str, object] = {
            "target_type": "aprilgrid",
            "tagCols": self.cols,
            "tagRows": self.rows,
            "tagSize": self.tag_size,
            "tagSpacing": self.tag_spacing,
        }
        return kalibr | ({"firstTagId": self.first_id} if self.first_id else {})
