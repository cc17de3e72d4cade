"""Calibration targets: where their points are, what is printed on them, and target.yaml."""

from jaxcal.targets.artwork import Artwork, DiscLattice, artwork_of
from jaxcal.targets.base import Target
from jaxcal.targets.boards import BoardSet
from jaxcal.targets.charuco import Charuco
from jaxcal.targets.circles import CircleGrid
from jaxcal.targets.grids import AprilGrid, Checkerboard
from jaxcal.targets.yaml import load_target, target_from_yaml

__all__ = [
    "AprilGrid",
    "Artwork",
    "BoardSet",
    "Charuco",
    "Checkerboard",
    "CircleGrid",
    "DiscLattice",
    "Target",
    "artwork_of",
    "load_target",
    "target_from_yaml",
]
