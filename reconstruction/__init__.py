"""Frames from events: voxel grids, the E2VID family of networks, and the reconstructor that runs them. Needs torch."""

from reconstruction.checkpoints import load_network
from reconstruction.reconstructor import Reconstructor
from reconstruction.stream import reconstruct
from reconstruction.voxel import voxel_grid

__all__ = ["Reconstructor", "load_network", "reconstruct", "voxel_grid"]
