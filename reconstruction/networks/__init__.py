"""The reconstruction networks, by the name that checkpoints call them."""

from reconstruction.networks.base import ReconstructionNetwork
from reconstruction.networks.e2vid import E2VID, E2VIDRecurrent
from reconstruction.networks.firenet import FireNet
from reconstruction.networks.folded import FoldedFireNet
from reconstruction.networks.two_scale import TwoScaleNet
from reconstruction.networks.two_scale_memory import TwoScaleMemoryNet

# Architecture name in a checkpoint -> class, built from the checkpoint's settings.
ARCHITECTURES: dict[str, type[ReconstructionNetwork]] = {
    "E2VID": E2VID,
    "E2VIDRecurrent": E2VIDRecurrent,
    "FireNet": FireNet,
    "FoldedFireNet": FoldedFireNet,
    "TwoScaleMemoryNet": TwoScaleMemoryNet,
    "TwoScaleNet": TwoScaleNet,
}

__all__ = [
    "ARCHITECTURES",
    "E2VID",
    "E2VIDRecurrent",
    "FireNet",
    "FoldedFireNet",
    "ReconstructionNetwork",
    "TwoScaleMemoryNet",
    "TwoScaleNet",
]
