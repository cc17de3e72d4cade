"""The optimisation: truncated back-propagation through time, weight averaging, and resuming after an interruption."""

import copy
import logging
import os
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float

from jaxcal.progress import Progress, no_progress
from reconstruction.networks import ARCHITECTURES, ReconstructionNetwork
from reconstruction.networks.base import State
from reconstruction.training.data import Dataset
from reconstruction.training.losses import displacement_loss, image_loss
from reconstruction.training.recipe import Recipe, Stage, fingerprint

HISTORY_STEPS = 50

logger = logging.getLogger(__name__)


@dataclass
class Run:
    """Everything that changes during training: what a checkpoint holds."""

    network: ReconstructionNetwork
    average: ReconstructionNetwork
    optimiser: torch.optim.Optimizer
    step: int = 0
    stage: int = 0
    clip: int = 0
    seconds: float = 0.0
    loss: float = float("nan")  # smoothed over some 50 steps
    history: list[float] = field(default_factory=list)  # `loss` after every HISTORY_STEPS steps


def train(
    recipe: Recipe,
    dataset: Dataset,
    checkpoint: Path,
    *,
    parent: ReconstructionNetwork | None = None,
    checkpoint_every_s: float = 120.0,
    progress: Progress = no_progress,
) -> Run:
    """The finished run: `average` is the network with averaged weights, in eval mode; `seconds` that it took in all.

    Starts with the weights of `parent`, or at random. Continues from `checkpoint` if one of the same recipe
    is there. Which clip comes when depends on the recipe's seed and the clip's number only, so that an interrupted run
    ends as an uninterrupted one does.
    """
    run = _start(recipe, parent)
    _resume(run, recipe, checkpoint)
    saved = begun = time.monotonic()
    before = run.seconds
    while run.stage < len(recipe.stages):
        stage = recipe.stages[run.stage]
        while run.clip < stage.clips:
            _train_on_clip(run, recipe, stage, dataset)
            run.clip += 1
            run.seconds = before + time.monotonic() - begun
            progress("train", run.step, recipe.steps)
            if time.monotonic() - saved > checkpoint_every_s:
                _save(run, recipe, checkpoint)
                saved = time.monotonic()
                logger.info("step %d of %d: loss %.4f, %.0f s", run.step, recipe.steps, run.loss, run.seconds)
        run.stage, run.clip = run.stage + 1, 0
    _save(run, recipe, checkpoint)
    run.average.eval()
    return run


def _start(recipe: Recipe, parent: ReconstructionNetwork | None = None) -> Run:
    torch.manual_seed(recipe.seed)
    network = ARCHITECTURES[recipe.architecture](
        num_bins=recipe.num_bins,
        channels=recipe.channels,
        scaling=recipe.data.scaling,
        shown_at=recipe.data.shown_at,
    )
    if parent is not None:
        network.load_state_dict(_widened(parent.state_dict(), network.state_dict()))
    if recipe.precision == "bfloat16":
        network = network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay, betas=(0.9, 0.99)
    )
    return Run(network, copy.deepcopy(network), optimiser)


def _widened(weights: dict[str, torch.Tensor], fresh: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A parent's weights; where a convolution reads more channels than the parent's did, it starts by ignoring them;
    what the parent has not starts afresh."""
    widened = dict(fresh)
    for name, values in weights.items():
        missing = fresh[name].shape[1] - values.shape[1] if values.ndim == 4 else 0
        widened[name] = F.pad(values, (0, 0, 0, 0, 0, missing)) if missing else values
    return widened


def _train_on_clip(run: Run, recipe: Recipe, stage: Stage, dataset: Dataset) -> None:
    rng = np.random.default_rng([recipe.seed, run.stage, run.clip])
    voxels, targets = dataset.clip(rng, stage)
    state: State | None = None
    for segment in range(stage.segments):
        part = slice(segment * stage.windows, (segment + 1) * stage.windows)
        loss, state = _segment_loss(
            run.network, voxels[part], targets[part], state, stage.warm_up if segment == 0 else 0, recipe
        )
        _optimise(run, recipe, loss)
        state = [tensor.detach() for tensor in state]


def _segment_loss(
    network: ReconstructionNetwork,
    voxels: Float[torch.Tensor, "t b c h w"],
    targets: Float[torch.Tensor, "t b 1 h w"],
    state: State | None,
    warm_up: int,
    recipe: Recipe,
) -> tuple[Float[torch.Tensor, ""], State]:
    """Mean loss over the windows after `warm_up`, and the state at the segment's end."""
    images = []
    reduced = recipe.precision == "bfloat16"
    precision: AbstractContextManager = torch.autocast("cpu", torch.bfloat16) if reduced else nullcontext()
    layout = torch.channels_last if reduced else torch.contiguous_format
    with precision:
        for grid in voxels:
            image, state = network(grid.contiguous(memory_format=layout), state)
            images.append(image)
    assert state is not None
    predicted = torch.stack(images[warm_up:]).float()
    loss = image_loss(predicted, targets[warm_up:], recipe.gradient_weight)
    if recipe.displacement_weight > 0:
        loss = loss + recipe.displacement_weight * displacement_loss(predicted, targets[warm_up:])
    return loss, state


def _optimise(run: Run, recipe: Recipe, loss: Float[torch.Tensor, ""]) -> None:
    rise = min(1.0, (run.step + 1) / recipe.warm_up_steps)
    fall = min(1.0, (1.0 - run.step / recipe.steps) / recipe.falling_share)
    for group in run.optimiser.param_groups:
        group["lr"] = recipe.learning_rate * rise * fall
    run.optimiser.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(run.network.parameters(), recipe.clip_norm)
    run.optimiser.step()
    # A young average follows quickly: the first weights are noise.
    decay = min(recipe.average_decay, (run.step + 1) / (run.step + 10))
    with torch.no_grad():
        for averaged, current in zip(run.average.parameters(), run.network.parameters(), strict=True):
            averaged.lerp_(current, 1.0 - decay)
    run.step += 1
    value = loss.item()
    run.loss = value if np.isnan(run.loss) else 0.98 * run.loss + 0.02 * value
    if run.step % HISTORY_STEPS == 0:
        run.history.append(run.loss)


def _save(run: Run, recipe: Recipe, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".part")
    torch.save(
        {
            "recipe": fingerprint(recipe),
            "network": run.network.state_dict(),
            "average": run.average.state_dict(),
            "optimiser": run.optimiser.state_dict(),
            "counters": {name: getattr(run, name) for name in ("step", "stage", "clip", "seconds", "loss", "history")},
        },
        partial,
    )
    os.replace(partial, path)


def _resume(run: Run, recipe: Recipe, path: Path) -> None:
    if not path.exists():
        return
    saved = torch.load(path, weights_only=True)
    if saved["recipe"] != fingerprint(recipe):
        logger.info("%s belongs to another recipe: training starts anew", path)
        return
    run.network.load_state_dict(saved["network"])
    run.average.load_state_dict(saved["average"])
    run.optimiser.load_state_dict(saved["optimiser"])
    for name, value in saved["counters"].items():
        setattr(run, name, value)
    logger.info("training continues at step %d", run.step)
