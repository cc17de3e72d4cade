"""What every calibration target offers: its points in the target frame."""

import abc
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Target(abc.ABC):
    """A planar calibration target.

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
