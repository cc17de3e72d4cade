"""The recipe: every number that decides what the trained network becomes."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass


@dataclass(frozen=True)
class DataRecipe:
    """Simulated sequences: `sequences` of `windows` windows of a `size` x `size` crop, `checkerboards` their share."""

    sequences: int = 300
    windows: int = 48
    size: int = 96
    checkerboards: float = 0.6
    seed: int = 2026


@dataclass(frozen=True)
class Stage:
    """A part of the training.

    `clips` clips are drawn one after the other, each `batch` sequences cropped to `crop` x `crop`; a clip has
    `segments` segments of `windows` windows. Each segment is one optimiser step; the network's state is carried into
    the next segment, gradients are not. The first `warm_up` windows of a clip do not count in the loss: what has not
    moved yet cannot be known.
    """

    crop: int
    windows: int
    segments: int
    batch: int
    clips: int
    warm_up: int = 2

    @property
    def steps(self) -> int:
        return self.clips * self.segments


@dataclass(frozen=True)
class Recipe:
    """All of it. `gradient_weight` multiplies the L1 error of the image's differences, beside that of the image."""

    data: DataRecipe = DataRecipe()
    stages: tuple[Stage, ...] = (
        Stage(crop=64, windows=10, segments=1, batch=4, clips=2000),
        Stage(crop=96, windows=12, segments=4, batch=2, clips=450),
    )
    channels: int = 32
    num_bins: int = 5
    learning_rate: float = 2e-3
    warm_up_steps: int = 50
    weight_decay: float = 1e-4
    gradient_weight: float = 0.5
    clip_norm: float = 1.0
    average_decay: float = 0.998
    seed: int = 1

    @property
    def steps(self) -> int:
        return sum(stage.steps for stage in self.stages)

    def describe(self) -> str:
        """All settings as JSON, keys sorted: equal recipes give equal text."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)


def fingerprint(recipe: DataRecipe | Recipe) -> str:
    """Twelve hexadecimal digits that change with any setting."""
    return hashlib.sha256(json.dumps(dataclasses.asdict(recipe), sort_keys=True).encode()).hexdigest()[:12]
