"""The optimisation: truncated back-propagation through time, weight averaging, and resuming after an interruption."""

import copy
import logging
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float

from jaxcal.progress import Progress, no_progress
from reconstruction.networks import ARCHITECTURES, ReconstructionNetwork
from reconstruction.networks.base import State
from reconstruction.training.data import Dataset
from reconstruction.training.losses import displacement_losses, image_loss, weights_of_places
from reconstruction.training.recipe import Recipe, Stage, fingerprint

HISTORY_STEPS = 50
_COUNTERS = ("step", "stage", "clip", "seconds", "machine", "loss", "history")

# One segment of a clip, its gradients left in the network: voxels, targets, weights of places, the state before it
# (None at a clip's start) and how many windows do not count, to the loss and the state after it.
Voxels = Float[torch.Tensor, "t b c h w"]
Targets = Float[torch.Tensor, "t b 1 h w"]
Segment = Callable[[Voxels, Targets, Targets, State | None, int], tuple[Float[torch.Tensor, ""], State]]

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
    machine: str = ""  # what it was trained on
    loss: float = float("nan")  # smoothed over some 50 steps
    history: list[float] = field(default_factory=list)  # `loss` after every HISTORY_STEPS steps


def train(
    recipe: Recipe,
    dataset: Dataset,
    checkpoint: Path,
    *,
    parent: ReconstructionNetwork | None = None,
    device: torch.device | str = "cpu",
    checkpoint_every_s: float = 120.0,
    progress: Progress = no_progress,
) -> Run:
    """The finished run: `average` is the network with averaged weights, in eval mode; `seconds` that it took in all.

    Starts with the weights of `parent`, or at random. Continues from `checkpoint` if one of the same recipe
    is there. Which clip comes when depends on the recipe's seed and the clip's number only, so that an interrupted run
    ends as an uninterrupted one does. On a GPU the steps are replayed as CUDA graphs; rounding differs from a CPU's.
    """
    device = torch.device(device)
    run = _start(recipe, parent, device)
    _resume(run, recipe, checkpoint)
    run.machine = run.machine or _name(device)
    dataset = dataset.near(device)
    segment = _Replayed(run.network, recipe) if device.type == "cuda" else _eager(run.network, recipe)
    saved = begun = time.monotonic()
    before = run.seconds
    while run.stage < len(recipe.stages):
        stage = recipe.stages[run.stage]
        while run.clip < stage.clips:
            _train_on_clip(run, recipe, stage, dataset, segment)
            run.clip += 1
            run.seconds = before + time.monotonic() - begun
            progress("train", run.step, recipe.steps)
            if time.monotonic() - saved > checkpoint_every_s:
                _save(run, recipe, checkpoint)
                saved = time.monotonic()
                logger.info("step %d of %d: loss %.4f, %.0f s", run.step, recipe.steps, run.loss, run.seconds)
        run.stage, run.clip = run.stage + 1, 0
    _save(run, recipe, checkpoint)
    run.average.cpu().eval()
    return run


def finished(recipe: Recipe, checkpoint: Path) -> Run | None:
    """The run that has ended in `checkpoint`, as `train` gave it; None if none of this recipe has."""
    run = _start(recipe)
    _resume(run, recipe, checkpoint)
    run.average.eval()
    return run if run.stage == len(recipe.stages) else None


def _name(device: torch.device) -> str:
    if device.type == "cuda":
        return f"one {torch.cuda.get_device_name(device)}"
    return f"{torch.get_num_threads()} CPU thread{'s' if torch.get_num_threads() > 1 else ''}"


def _start(recipe: Recipe, parent: ReconstructionNetwork | None = None, device: torch.device | str = "cpu") -> Run:
    torch.manual_seed(recipe.seed)
    network = ARCHITECTURES[recipe.architecture](
        num_bins=recipe.num_bins,
        channels=recipe.channels,
        base_num_channels=recipe.channels,  # FireNet's name of it
        detail=recipe.detail,
        scaling=recipe.data.scaling,
        shown_at=recipe.data.shown_at,
    )
    if parent is not None:
        network.load_state_dict(_widened(parent.state_dict(), network.state_dict()))
    if recipe.precision == "bfloat16":
        network = network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    network = network.to(device)
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


def _train_on_clip(run: Run, recipe: Recipe, stage: Stage, dataset: Dataset, segment: Segment) -> None:
    rng = np.random.default_rng([recipe.seed, run.stage, run.clip])
    voxels, targets = dataset.clip(rng, stage)
    weights = weights_of_places(voxels, recipe.num_bins, recipe.unseen_weight)
    state: State | None = None
    for index in range(stage.segments):
        part = slice(index * stage.windows, (index + 1) * stage.windows)
        warm_up = stage.warm_up if index == 0 else 0
        loss, state = segment(voxels[part], targets[part], weights[part], state, warm_up)
        _optimise(run, recipe, loss)


def _eager(network: ReconstructionNetwork, recipe: Recipe) -> Segment:
    """Step by step, as it is written."""

    def segment(voxels: Voxels, targets: Targets, weights: Targets, state: State | None, warm_up: int):
        network.zero_grad(set_to_none=True)
        loss, after = _segment_loss(network, voxels, targets, weights, state, warm_up, recipe)
        loss.backward()
        return loss.detach(), [tensor.detach() for tensor in after]

    return segment


class _Replayed:
    """The same as CUDA graphs, one for each shape: a small network's thousand small kernels start without Python.

    Gradients stay in one place, where every graph adds to them after setting them to zero.
    """

    def __init__(self, network: ReconstructionNetwork, recipe: Recipe):
        self._network, self._recipe = network, recipe
        self._graphs: dict[tuple[int, ...], tuple[torch.cuda.CUDAGraph, dict[str, Any]]] = {}
        for parameter in network.parameters():
            parameter.grad = torch.zeros_like(parameter)

    def __call__(
        self, voxels: Voxels, targets: Targets, weights: Targets, state: State | None, warm_up: int
    ) -> tuple[Float[torch.Tensor, ""], State]:
        inputs = {"voxels": voxels, "targets": targets, "weights": weights}
        key = (*voxels.shape, warm_up)
        if key not in self._graphs:
            self._graphs[key] = self._captured(inputs, warm_up)
        graph, tensors = self._graphs[key]
        for name, given in inputs.items():
            tensors[name].copy_(given)
        for index, kept in enumerate(tensors["before"]):  # nothing remembered is zeros
            kept.zero_() if state is None else kept.copy_(state[index])
        graph.replay()
        return tensors["loss"], [tensor.clone() for tensor in tensors["after"]]

    def _captured(self, given: dict[str, torch.Tensor], warm_up: int) -> tuple[torch.cuda.CUDAGraph, dict[str, Any]]:
        tensors: dict[str, Any] = {name: tensor.clone() for name, tensor in given.items()}

        def run() -> None:
            # Nothing may outlive this that holds autograd's nodes: they belong to the stream on which they were made.
            self._network.zero_grad(set_to_none=False)
            parts = (tensors["voxels"], tensors["targets"], tensors["weights"])
            loss, after = _segment_loss(self._network, *parts, tensors.get("before"), warm_up, self._recipe)
            loss.backward()
            tensors["loss"], tensors["after"] = loss.detach(), [tensor.detach() for tensor in after]

        with torch.backends.cudnn.flags(enabled=True, benchmark=True, allow_tf32=False):
            # Beside the default stream, as capturing asks for; the first time tells what is remembered.
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(3):
                    run()
                    tensors.setdefault("before", [torch.zeros_like(tensor) for tensor in tensors["after"]])
            torch.cuda.current_stream().wait_stream(stream)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                run()
        return graph, tensors


def _segment_loss(
    network: ReconstructionNetwork,
    voxels: Float[torch.Tensor, "t b c h w"],
    targets: Float[torch.Tensor, "t b 1 h w"],
    weights: Float[torch.Tensor, "t b 1 h w"],
    state: State | None,
    warm_up: int,
    recipe: Recipe,
) -> tuple[Float[torch.Tensor, ""], State]:
    """Mean loss over the windows after `warm_up`, and the state at the segment's end."""
    images = []
    reduced = recipe.precision == "bfloat16"
    precision: AbstractContextManager = torch.autocast(voxels.device.type, torch.bfloat16) if reduced else nullcontext()
    layout = torch.channels_last if reduced else torch.contiguous_format
    with precision:
        for grid in voxels:
            image, state = network(grid.contiguous(memory_format=layout), state)
            images.append(image)
    assert state is not None
    predicted = torch.stack(images[warm_up:]).float()
    targets, weights = targets[warm_up:], weights[warm_up:]
    loss = image_loss(predicted, targets, weights, recipe.gradient_weight)
    if recipe.displacement_weight > 0:
        each, shared = displacement_losses(predicted, targets, weights)
        loss = loss + recipe.displacement_weight * each + recipe.shared_weight * shared
    return loss, state


def _optimise(run: Run, recipe: Recipe, loss: Float[torch.Tensor, ""]) -> None:
    rise = min(1.0, (run.step + 1) / recipe.warm_up_steps)
    fall = min(1.0, (1.0 - run.step / recipe.steps) / recipe.falling_share)
    for group in run.optimiser.param_groups:
        group["lr"] = recipe.learning_rate * rise * fall
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
            "counters": {name: getattr(run, name) for name in _COUNTERS},
        },
        partial,
    )
    os.replace(partial, path)


def _resume(run: Run, recipe: Recipe, path: Path) -> None:
    if not path.exists():
        return
    saved = torch.load(path, weights_only=True, map_location="cpu")
    if saved["recipe"] != fingerprint(recipe):
        logger.info("%s belongs to another recipe: training starts anew", path)
        return
    run.network.load_state_dict(saved["network"])
    run.average.load_state_dict(saved["average"])
    run.optimiser.load_state_dict(saved["optimiser"])
    for name, value in saved["counters"].items():
        setattr(run, name, value)
    logger.info("training continues at step %d", run.step)
