"""The recipe: every number that decides what the trained network becomes."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class DataRecipe:
    """Simulated sequences: `sequences` of `windows` windows of a `size` x `size` crop.

    `checkerboards` is their share, `others` that of circle grids and ChArUco boards, `pictures` that of pictures of no
    board at all, the rest are AprilGrids with bits of `smallest_bit_px` pixels or more. Boards are tilted by up to
    `largest_tilt_deg`, windows last 10 ms to `longest_window_ms`. Scenes in which the board comes near to edge-on are
    kept only with `edge_on`. The fastest image motion of a sequence lies between `slowest_px` and `fastest_px` pixels
    per window; the share `swinging` of the sequences moves as a hand does, slowly where it turns back, and the share
    `lulls` all but rests for a while. `scaling` of the voxel grids and the moment of the window that its image is of,
    as `ReconstructionNetwork.scaling` and `shown_at`.
    """

    sequences: int = 300
    windows: int = 48
    size: int = 96
    checkerboards: float = 0.6
    others: float = 0.0
    smallest_bit_px: float = 2.3
    largest_tilt_deg: float = 50.0
    longest_window_ms: float = 50.0
    edge_on: bool = True
    pictures: float = 0.0
    slowest_px: float = 1.5
    fastest_px: float = 25.0
    swinging: float = 0.0
    lulls: float = 0.0
    scaling: str = "window"
    shown_at: float = 1.0
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
        """Optimiser steps."""
        return self.clips * self.segments


@dataclass(frozen=True)
class Recipe:
    """All of it, of a network of class `architecture`.

    `gradient_weight` multiplies the L1 error of the image's differences, and `displacement_weight` the displacement of
    corners in pixels, beside the L1 error of the image; `shared_weight` the displacement that the corners of an image
    share, and those of a clip. Places past which no edge has come since the clip's start count
    by `unseen_weight`. The learning rate is held, and falls to zero over the last
    `falling_share` of the steps. With a `parent`, training starts from the weights that the parent's recipe gives.
    """

    data: DataRecipe = DataRecipe()
    stages: tuple[Stage, ...] = (
        Stage(crop=64, windows=10, segments=1, batch=4, clips=2000),
        Stage(crop=96, windows=12, segments=4, batch=2, clips=450),
    )
    architecture: str = "FoldedFireNet"
    channels: int = 32
    detail: int = 16
    num_bins: int = 5
    learning_rate: float = 2e-3
    warm_up_steps: int = 50
    weight_decay: float = 1e-4
    gradient_weight: float = 0.5
    clip_norm: float = 1.0
    average_decay: float = 0.998
    displacement_weight: float = 0.0
    shared_weight: float = 0.0
    unseen_weight: float = 1.0
    falling_share: float = 1.0
    precision: str = "bfloat16"
    parent: "Recipe | None" = None
    seed: int = 1

    @property
    def steps(self) -> int:
        """Optimiser steps of all stages, without the parent's."""
        return sum(stage.steps for stage in self.stages)

    def describe(self) -> str:
        """All settings as JSON, keys sorted: equal recipes give equal text."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)


def fingerprint(recipe: DataRecipe | Recipe) -> str:
    """Twelve hexadecimal digits that change with any setting.

    Of what differs from the defaults: a setting that is added later, with what was done before as its default, leaves
    the fingerprints of older recipes as they are. So no default may ever be changed.
    """
    return hashlib.sha256(json.dumps(_chosen(recipe), sort_keys=True).encode()).hexdigest()[:12]


def _chosen(settings: Any) -> Any:
    """The settings that differ from their defaults; of the data and the parent likewise."""
    if not dataclasses.is_dataclass(settings):
        return [_chosen(item) for item in settings] if isinstance(settings, tuple) else settings
    values = {field.name: (getattr(settings, field.name), field.default) for field in dataclasses.fields(settings)}
    return {name: _chosen(value) for name, (value, default) in values.items() if value != default}


PATTERNS_V1 = Recipe()
_MIDDLE = DataRecipe(
    sequences=600,
    checkerboards=0.45,
    others=0.1,
    smallest_bit_px=1.8,
    longest_window_ms=100.0,
    edge_on=False,
    shown_at=0.5,
    seed=2028,
)
# Most of the work at a quarter of the resolution; images of the window's middle, with events on either side of it.
_TWO_SCALES = Recipe(
    data=_MIDDLE,
    stages=(
        Stage(crop=64, windows=10, segments=1, batch=4, clips=2000),
        Stage(crop=96, windows=12, segments=4, batch=4, clips=2000),
    ),
    architecture="TwoScaleNet",
    num_bins=8,
    falling_share=0.6,
    seed=2,
)
# Corners in the loss, and the scale of the voxel grid beside it.
_CORNERS = replace(
    _TWO_SCALES,
    data=replace(_MIDDLE, scaling="running+scale"),
    stages=(Stage(crop=96, windows=12, segments=4, batch=4, clips=1200),),
    learning_rate=1e-3,
    falling_share=0.8,
    displacement_weight=0.4,
    parent=_TWO_SCALES,
    seed=3,
)
# With a second memory, at first as it comes, then over longer spans of time.
_MEMORY = replace(
    _CORNERS,
    architecture="TwoScaleMemoryNet",
    stages=(Stage(crop=96, windows=12, segments=4, batch=4, clips=1500),),
    learning_rate=1.5e-3,
    parent=_CORNERS,
    seed=4,
)
PATTERNS_V3 = replace(
    _MEMORY,
    stages=(Stage(crop=96, windows=24, segments=2, batch=4, clips=1300),),
    learning_rate=1e-3,
    falling_share=0.9,
    parent=_MEMORY,
    seed=5,
)
# Many more scenes, of which many are slow or move as a hand does, and longer clips: made for a GPU. `--parent
# models/patterns_v3.safetensors` spares the parents.
PATTERNS_V4 = replace(
    PATTERNS_V3,
    data=replace(_CORNERS.data, sequences=2000, slowest_px=0.5, fastest_px=28.0, swinging=0.5, seed=2029),
    stages=(
        Stage(crop=96, windows=24, segments=2, batch=32, clips=2000),
        Stage(crop=96, windows=48, segments=1, batch=32, clips=900, warm_up=4),
    ),
    learning_rate=2e-3,
    falling_share=0.9,
    displacement_weight=1.0,
    parent=PATTERNS_V3,
    seed=6,
)
# What has passed is remembered while all but nothing moves: clips that rest for a while after they moved, and a loss
# that asks for no place before its edge has come. From patterns_v4, on two CPU cores.
PATTERNS_V5 = replace(
    PATTERNS_V4,
    data=replace(PATTERNS_V4.data, sequences=500, windows=80, slowest_px=1.0, lulls=0.5, seed=2031),
    stages=(Stage(crop=96, windows=40, segments=2, batch=4, clips=2000),),
    learning_rate=1e-3,
    falling_share=1.0,
    unseen_weight=0.05,
    parent=PATTERNS_V4,
    seed=9,
)
# Above all, nothing that all corners of an image share: no residual of a calibration shows it. Made on a GPU;
# `--parent models/patterns_v5.safetensors` spares the parents.
PATTERNS_V6 = replace(
    PATTERNS_V5,
    data=replace(
        PATTERNS_V5.data, sequences=1000, checkerboards=0.35, slowest_px=1.5, fastest_px=28.0, lulls=0.4, seed=2033
    ),
    stages=(Stage(crop=96, windows=40, segments=2, batch=32, clips=1900),),
    learning_rate=1.5e-3,
    shared_weight=2.0,
    parent=PATTERNS_V5,
    seed=10,
)
# FireNet (Scheerlinck et al. 2020) in the way it was meant: the world at large, images of the window's end.
FIRENET_PICTURES = Recipe(
    data=DataRecipe(
        sequences=600, checkerboards=0.0, pictures=1.0, longest_window_ms=100.0, edge_on=False, swinging=0.5, seed=2030
    ),
    stages=(Stage(crop=96, windows=24, segments=2, batch=16, clips=650),),
    architecture="FireNet",
    channels=16,
    seed=7,
)
RECIPES = {
    "patterns_v1": PATTERNS_V1,
    "patterns_v3": PATTERNS_V3,
    "patterns_v4": PATTERNS_V4,
    "patterns_v5": PATTERNS_V5,
    "patterns_v6": PATTERNS_V6,
    "firenet_pictures": FIRENET_PICTURES,
}
