"""What every calibration target offers: its points in the target frame."""

import abc
import numbers
from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError


@dataclass(frozen=True)
class Target(abc.ABC):
    """A planar calibration target, or several of them.

    Target frame: x along the columns to the right, y along the rows upwards, z out of the board towards the viewer.
    Points are numbered row by row from the lower left.
    """

    @property
    @abc.abstractmethod
    def points(self) -> np.ndarray:
        """Corner points (N, 3), metres, target frame."""

    @property
    @abc.abstractmethod
    def grid_shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid of points: point index = row * columns + column."""

    @abc.abstractmethod
    def to_yaml(self) -> dict[str, object]:
        """The target as a mapping in Kalibr's `target.yaml` format."""

    @property
    def boards(self) -> tuple["Target", ...]:
        """The rigid boards of which this target consists: itself, unless it is a set of boards."""
        return (self,)

    @property
    def board_of_point(self) -> np.ndarray:
        """Index (N,) into `boards` of the board that each point is on."""
        return np.zeros(len(self.points), np.int64)

    @property
    def turns(self) -> np.ndarray:
        """Renumberings (S, N) of the points that one image cannot tell apart, the one that changes nothing first.

        A board that looks the same after a turn about its normal has one row per such turn: the turn takes
        `points[i]` to `points[turns[s, i]]`.
        """
        return np.arange(len(self.points))[None]

    @property
    def is_half_turn_symmetric(self) -> bool:
        """Whether the board looks the same after half a turn, so that its orientation cannot be read off one image."""
        return len(self.turns) > 1


def check_fields(name: str, counts: dict[str, int], lengths: dict[str, float]) -> None:
    """Raise CalibrationError unless all counts are whole and at least 1, and all lengths finite and positive."""
    for key, count in counts.items():
        if not isinstance(count, numbers.Integral) or count < 1:
            raise CalibrationError(f"{name}: {key} is {count}; expected a whole number, at least 1.")
    for key, length in lengths.items():
        if not isinstance(length, numbers.Real) or not np.isfinite(length) or length <= 0:
            raise CalibrationError(f"{name}: {key} is {length}; expected a positive length.")


def check_id(name: str, key: str, value: int) -> None:
    """Raise CalibrationError unless the id of a board's first tag or marker is a whole number, at least 0."""
    if not isinstance(value, numbers.Integral) or value < 0:
        raise CalibrationError(f"{name}: {key} is {value}; expected a whole number, at least 0.")


def grid_points(rows: int, cols: int, row_spacing: float, col_spacing: float) -> np.ndarray:
    """Points (rows * cols, 3) of a regular grid in the target frame, row by row from the lower left."""
    y, x = np.mgrid[:rows, :cols].astype(np.float64)
    return np.stack([x * col_spacing, y * row_spacing, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def grid_turns(rows: int, cols: int, half: bool, quarter: bool) -> np.ndarray:
    """`Target.turns` of a grid that half a turn, and each quarter turn (rows = cols), takes to itself."""
    number = np.arange(rows * cols)
    if quarter:
        square = number.reshape(rows, cols)
        # Turning anticlockwise takes row r, column c to row c, column n - 1 - r.
        once = square[:, ::-1].T.ravel()
        return np.stack([number, once, number[::-1], once[::-1]])
    return np.stack([number, number[::-1]]) if half else number[None]
