"""ChArUco: a checkerboard with a marker in each white square."""

from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.targets.base import Target, check_fields, check_id, grid_points

# OpenCV's dictionaries: name -> (bits along a marker's side, number of markers).
DICTIONARIES: dict[str, tuple[int, int]] = {
    **{f"DICT_{bits}X{bits}_{count}": (bits, count) for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": (5, 1024),
    "DICT_APRILTAG_16h5": (4, 30),
    "DICT_APRILTAG_25h9": (5, 35),
    "DICT_APRILTAG_36h10": (6, 2320),
    "DICT_APRILTAG_36h11": (6, 587),
}


@dataclass(frozen=True)
class Charuco(Target):
    """A ChArUco board of `rows` x `cols` SQUARES; points are the (rows - 1) x (cols - 1) inner corners.

    `square_size` and `marker_size` are edges in metres; `dictionary` is a name of OpenCV's, such as DICT_5X5_100.
    Markers fill the white squares row by row from the TOP left (as OpenCV's CharucoBoard), with ids from `first_id`.
    The top left square is black; with `legacy` and an even number of rows it is white, as OpenCV before 4.6 drew it.
    """

    rows: int
    cols: int
    square_size: float
    marker_size: float
    dictionary: str
    legacy: bool = False
    first_id: int = 0

    def __post_init__(self) -> None:
        lengths = {"square_size": self.square_size, "marker_size": self.marker_size}
        check_fields("Charuco", {"rows": self.rows, "cols": self.cols}, lengths)
        check_id("Charuco", "first_id", self.first_id)
        if not isinstance(self.legacy, bool | np.bool_):
            raise CalibrationError(f"Charuco: legacy is {self.legacy!r}; expected true or false.")
        if min(self.rows, self.cols) < 3:
            raise CalibrationError("Charuco: at least 3 x 3 squares are needed; count the squares, not the corners.")
        if self.marker_size >= self.square_size:
            raise CalibrationError(
                f"Charuco: a marker of {self.marker_size} m does not fit into a square of {self.square_size} m."
            )
        if self.dictionary not in DICTIONARIES:
            raise CalibrationError(
                f"Charuco: dictionary is {self.dictionary!r}; known: {', '.join(sorted(DICTIONARIES))}."
            )
        capacity = DICTIONARIES[self.dictionary][1]
        if self.ids[-1] >= capacity:
            raise CalibrationError(
                f"Charuco: {len(self.ids)} markers, ids {self.ids[0]} to {self.ids[-1]}; {self.dictionary} has "
                f"{capacity} markers. Use a larger dictionary, fewer squares or a smaller first_id."
            )

    @property
    def ids(self) -> range:
        """The ids of its markers."""
        return range(self.first_id, self.first_id + self.rows * self.cols // 2)

    @property
    def white_squares(self) -> np.ndarray:
        """(rows, cols) bool, row 0 at the TOP: where the markers are."""
        row, col = np.mgrid[: self.rows, : self.cols]
        shifted = self.legacy and self.rows % 2 == 0
        return (row + col + shifted) % 2 == 1

    @property
    def grid_shape(self) -> tuple[int, int]:
        return self.rows - 1, self.cols - 1

    @property
    def points(self) -> np.ndarray:
        return grid_points(self.rows - 1, self.cols - 1, self.square_size, self.square_size)

    def to_yaml(self) -> dict[str, object]:
        return {
            "target_type": "charuco",
            "squareCols": self.cols,
            "squareRows": self.rows,
            "squareSize": self.square_size,
            "markerSize": self.marker_size,
            "dictionary": self.dictionary,
            "legacyPattern": bool(self.legacy),
            "firstMarkerId": self.first_id,
        }
