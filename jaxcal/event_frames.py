"""Frames of an event camera: windows of events through the network, into a folder that any later stage can read."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.progress import Progress, no_progress
from jaxcal.recording import EventFile
from jaxcal.recording.event_facts import find_hot_pixels
from jaxcal.recording.frame_writers import write_frame_folder
from jaxcal.recording.windows import WindowPlan

AUTOMATIC = "auto"

# Corners in reconstructed frames trail behind the events, and no calibration can tell that lag from a time offset. With
# the shipped network it was 0 to 0.3 ms in simulated recordings (models/patterns_v6.md,
# experiments/paper_table1_detection.py, experiments/run_multicam.py); this is the 1-sigma that is allowed for it, s.
LAG_SIGMA_S = 3e-4

# Raised whenever the same events could give other frames than before, apart from the network and the options.
_FRAMES_VERSION = 1


def write_event_frames(
    folder: Path,
    events: EventFile,
    plan: WindowPlan,
    network: Any,
    options: Mapping[str, Any],
    *,
    notes: Mapping[str, str] | None = None,
    replace: bool = False,
    stage: str = "reconstruct",
    progress: Progress = no_progress,
) -> int:
    """Reconstruct the frames that `plan` wants into `folder` (see `write_frame_folder`), and return their number.

    `network` of `reconstruction.load_network`; `options` of `reconstruction.Reconstructor`, whose `hot_pixels` may be
    'auto': then the recording is read twice, first to find them. An interrupted run starts again: the network's state
    depends on all events before. `notes`: text files to lay beside the frames, by name.
    """
    frames = event_frames(events, plan, network, options, stage=stage, progress=progress)
    return write_frame_folder(folder, frames, notes=lambda: dict(notes or {}), replace=replace)


def event_frames(
    events: EventFile,
    plan: WindowPlan,
    network: Any,
    options: Mapping[str, Any],
    *,
    stage: str = "reconstruct",
    progress: Progress = no_progress,
) -> Iterator[tuple[int, np.ndarray]]:
    """The frames that `plan` wants, as they become ready: (t_ns, image), t_ns the moment that the image shows."""
    import reconstruction  # imports torch, which takes seconds: only where there are events

    plan = plan.showing(network.shown_at)
    options = dict(options)
    if isinstance(options.get("hot_pixels"), str) and options["hot_pixels"] == AUTOMATIC:
        hot = find_hot_pixels(events, progress)
        options["hot_pixels"] = np.array([(pixel.x, pixel.y) for pixel in hot], np.int64).reshape(-1, 2)
    total, done = plan.count(events), 0
    progress(stage, 0, total)

    def reported() -> Iterator[tuple[int, Any, bool, int]]:
        nonlocal done
        for window in plan.windows(events):
            yield window
            done += 1
            progress(stage, done, max(total, done))

    yield from reconstruction.reconstruct(reported(), network, width=events.width, height=events.height, **options)
    progress(stage, done, done)


def frames_key(events: EventFile, plan: WindowPlan, network: Any, options: Mapping[str, Any]) -> str:
    """A hash of all that the frames depend on: the event file, the windows, the network's weights and the options."""
    digest = hashlib.sha256()
    facts = [_FRAMES_VERSION, *events.fingerprint(), events.width, events.height]
    digest.update(json.dumps([*facts, type(network).__name__, network.shown_at, dict(options)], default=str).encode())
    hot_pixels = options.get("hot_pixels")
    if isinstance(hot_pixels, str | Path) and hot_pixels != AUTOMATIC and Path(hot_pixels).is_file():
        digest.update(Path(hot_pixels).read_bytes())
    digest.update(plan.key())
    for name, values in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(values.detach().cpu().numpy().tobytes())
    return digest.hexdigest()
