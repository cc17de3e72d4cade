"""Grids of circles."""

from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.targets.base import Target, check_fields, grid_points, grid_turns

_DIAMETER = 0.5  # of the spacing, where nothing else is said; it leaves as much white as black along a row


@dataclass(frozen=True)
class CircleGrid(Target):
    """Black circles on white, `rows` x `cols` of them: Kalibr's `target_type: circlegrid`; points are the centres.

    Symmetric: centres `spacing` metres apart along rows and columns. Asymmetric, as Kalibr and OpenCV define it
    (aslam_cameras/GridCalibrationTargetCirclegrid.cpp): rows are `spacing` apart, circles in a row 2 `spacing`, and
    every second row, counted from the second lowest, is shifted by `spacing` to the right, so that the centre in row r,
    column c is at ((2 c + r mod 2) spacing, r spacing).

    `diameter` of the circles in metres is what is drawn (yaml key `circleDiameterMeters`, which Kalibr lacks; default
    half the spacing). Detection does not depend on it.
    """

    rows: int
    cols: int
    spacing: float
    asymmetric: bool = False
    diameter: float | None = None

    def __post_init__(self) -> None:
        check_fields("CircleGrid", {"rows": self.rows, "cols": self.cols}, {"spacing": self.spacing})
        if not isinstance(self.asymmetric, bool | np.bool_):
            raise CalibrationError(f"CircleGrid: asymmetric is {self.asymmetric!r}; expected true or false.")
        if self.diameter is None:
            object.__setattr__(self, "diameter", _DIAMETER * self.spacing)
        check_fields("CircleGrid", {}, {"diameter": self.circle_diameter})
        nearest = self.spacing * (np.sqrt(2.0) if self.asymmetric else 1.0)
        if self.circle_diameter >= nearest:
            raise CalibrationError(
                f"CircleGrid: circles of diameter {self.circle_diameter} m, {nearest:.4g} m apart, run into each "
                "other. Give a smaller diameter or a larger spacing."
            )
        if min(self.rows, self.cols) < 2:
            raise CalibrationError("CircleGrid: at least 2 x 2 circles are needed.")

    @property
    def circle_diameter(self) -> float:
        """Diameter of the circles, metres."""
        return _DIAMETER * self.spacing if self.diameter is None else self.diameter

    @property
    def grid_shape(self) -> tuple[int, int]:
        return self.rows, self.cols

    @property
    def points(self) -> np.ndarray:
        if not self.asymmetric:
            return grid_points(self.rows, self.cols, self.spacing, self.spacing)
        points = grid_points(self.rows, self.cols, self.spacing, 2.0 * self.spacing).reshape(self.rows, self.cols, 3)
        points[1::2, :, 0] += self.spacing
        return points.reshape(-1, 3)

    @property
    def turns(self) -> np.ndarray:
        # With an odd number of rows, the first and the last row of an asymmetric grid are shifted alike: upside down,
        # they are shifted the other way.
        half = not self.asymmetric or self.rows % 2 == 0
        return grid_turns(self.rows, self.cols, half, quarter=not self.asymmetric and self.rows == self.cols)

    def to_yaml(self) -> dict[str, object]:
        return {
            "target_type": "circlegrid",
            "targetCols": self.cols,
            "targetRows": self.rows,
            "spacingMeters": self.spacing,
            "asymmetricGrid": bool(self.asymmetric),
            "circleDiameterMeters": self.circle_diameter,
        }
