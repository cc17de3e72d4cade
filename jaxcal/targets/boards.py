"""Several boards at once, whose mutual poses are unknown."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.targets.base import Target
from jaxcal.targets.charuco import Charuco
from jaxcal.targets.circles import CircleGrid
from jaxcal.targets.grids import AprilGrid, Checkerboard

_TAG_FAMILY = "DICT_APRILTAG_36h11"  # an AprilGrid's, in the words of Charuco


@dataclass(frozen=True, init=False)
class BoardSet(Target):
    """Boards that stand fixed among each other, nobody knows how: a calibration finds their mutual poses.

    `points` are those of all boards one after the other, each board's in its OWN frame; `board_of_point` says whose
    a point is. A set has no grid: ask each of its `boards` for its `grid_shape`.

    Boards must be told apart in an image: AprilGrids and ChArUco boards by ids that do not overlap; of checkerboards
    and of circle grids there can be one each. Raises CalibrationError where they cannot be.
    """

    members: tuple[Target, ...]

    def __init__(self, boards: Iterable[Target]) -> None:
        object.__setattr__(self, "members", tuple(boards))
        if len(self.members) < 2:
            raise CalibrationError(f"BoardSet: {len(self.members)} boards; a set has at least 2.")
        if any(isinstance(board, BoardSet) for board in self.members):
            raise CalibrationError("BoardSet: a set of boards cannot hold another set; list all boards in one.")
        for (i, one), (j, other) in itertools.combinations(enumerate(self.members), 2):
            reason = _confused(one, other)
            if reason:
                raise CalibrationError(f"BoardSet: boards {i} and {j} cannot be told apart: {reason}")

    @property
    def boards(self) -> tuple[Target, ...]:
        return self.members

    @property
    def points(self) -> np.ndarray:
        return np.concatenate([board.points for board in self.members])

    @property
    def board_of_point(self) -> np.ndarray:
        return np.repeat(np.arange(len(self.members)), [len(board.points) for board in self.members])

    @property
    def grid_shape(self) -> tuple[int, int]:
        raise CalibrationError("a set of boards has no grid of its own; ask each of its `boards` for `grid_shape`.")

    def to_yaml(self) -> dict[str, object]:
        return {"target_type": "boards", "boards": [board.to_yaml() for board in self.members]}


def _confused(one: Target, other: Target) -> str:
    """Why two boards cannot be told apart in an image; empty where they can."""
    tagged = (AprilGrid, Charuco)
    if isinstance(one, tagged) and isinstance(other, tagged):
        if _family(one) == _family(other) and set(one.ids) & set(other.ids):
            common = sorted(set(one.ids) & set(other.ids))
            return (
                f"both have the {_family(one)} ids {common[0]} to {common[-1]}. Give one of them another first_id "
                "(and print it so)."
            )
        return ""
    if type(one) is type(other) and isinstance(one, Checkerboard | CircleGrid):
        return "a part of the larger one looks like the other. Use one of them, and boards with tags beside it."
    return ""


def _family(board: AprilGrid | Charuco) -> str:
    return board.dictionary if isinstance(board, Charuco) else _TAG_FAMILY
