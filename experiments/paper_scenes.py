"""What the scripts of the paper's tables share: scenes, their frames, corners beside the truth, result files.

The paper is Muglikar, Gehrig, Gehrig, Scaramuzza: "How to calibrate your event camera", CVPR workshops 2021 (e2calib).
Everything is made once and kept in the working folder: recordings, reconstructed frames, corners.
"""

import argparse
import dataclasses
import hashlib
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import platformdirs

import jaxcal
from jaxcal.atomic import write_text
from jaxcal.cameras import CameraModel, Pinhole, PinholeEquidistant, PinholeRadtan
from jaxcal.detection import detect
from jaxcal.detection.cache import DetectionCache, detection_key
from jaxcal.observations import Detections, Frames
from jaxcal.progress import Progress, track
from jaxcal.recording import load_frames, load_rig
from jaxcal.recording.windows import TimedWindows, Window
from jaxcal.simulation import EventSensorConfig, Imaging, SimulatedCamera, SimulatedRig, paper_rig, write_recording
from jaxcal.simulation.measurements import T_cam_target, project_points
from jaxcal.simulation.recordings import fingerprint
from jaxcal.simulation.rig import swinging_motion
from jaxcal.targets import AprilGrid, Checkerboard, Target

README = Path(__file__).resolve().parent.parent / "README.md"

# Section 4.1 of the paper: 500 x 500 pixels, f = 200, c = 250, three kinds of distortion, 50 ms windows.
INTRINSICS = (200.0, 200.0, 250.0, 250.0)
SIZE = (500, 500)
WINDOW_S = 0.05
LENSES: dict[str, CameraModel] = {
    "none": Pinhole.create(INTRINSICS),
    "equidistant": PinholeEquidistant.create(INTRINSICS, (-0.051, 0.046, -0.083, 0.056)),
    "radtan": PinholeRadtan.create(INTRINSICS, (-0.383, 0.189, -0.001, -0.001)),
}
# Each board with the distance at which it fills somewhat more than half of the view, in metres.
BOARDS: dict[str, tuple[Target, float]] = {
    "checkerboard": (Checkerboard(rows=6, cols=9, spacing=0.1), 0.75),
    "AprilGrid": (AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3), 0.60),
}
# The first images of a recording show only what has moved so far; they do not count.
SETTLING_FRAMES = 4
_VELOCITY_STEP_S = 1e-4
# The built-in rig's motion, slowed down: near the wide lens and its edges most corners then move at 0 to 400 px/s.
_PACE = 0.5

# Windows of events, and the sensor's width and height, to images, as (time in ns, uint8 (H, W)).
FrameMaker = Callable[[Iterable[Window], int, int], Iterator[tuple[int, np.ndarray]]]


@dataclass(frozen=True)
class Recording:
    """A simulated recording on disk: one event camera `cam0`, and ideal frames of the same view `cam1`."""

    rig: SimulatedRig
    folder: Path

    @property
    def camera(self) -> SimulatedCamera:
        """The only camera of the scene."""
        return self.rig.cameras[0]

    @property
    def target(self) -> Target:
        """The board of the scene."""
        return self.rig.target

    def ideal_frames(self) -> Frames:
        """Sharp, noiseless images at the ends of the windows."""
        return load_frames(self.folder / "cam1")


def record(
    folder: Path,
    lens: CameraModel,
    size: tuple[int, int],
    board: tuple[Target, float],
    seed: int,
    duration_s: float,
    progress: Progress,
    *,
    sensor: EventSensorConfig | None = None,
    psf_sigma_px: float = 0.6,
) -> Recording:
    """Simulate one camera before one board, or take what is in `folder` already."""
    rig = scene(lens, size, board, seed, duration_s, sensor=sensor, psf_sigma_px=psf_sigma_px)
    folder = folder / f"{fingerprint(rig)[:16]}"
    write_recording(rig, folder, progress, workers=1)
    return Recording(rig, folder)


def scene(
    lens: CameraModel,
    size: tuple[int, int],
    board: tuple[Target, float],
    seed: int,
    duration_s: float,
    *,
    sensor: EventSensorConfig | None = None,
    psf_sigma_px: float = 0.6,
) -> SimulatedRig:
    """A rig of an event camera and a frame camera in one place, that looks at the board and swings around it.

    Images for the events are rendered every third of a pixel: the sensor takes log intensity as linear in between,
    which over a whole pixel misplaces events by up to a fifth of one.
    """
    target, distance_m = board
    base = paper_rig(duration_s=duration_s, seed=seed, target=target)
    events = SimulatedCamera(
        "cam0", "events", lens, size, np.eye(4), timeshift_cam_imu=0.0, rate_hz=1.0 / WINDOW_S, phase_s=WINDOW_S
    )
    cameras = (events, dataclasses.replace(events, name="cam1", kind="frames"))
    imaging = Imaging(
        psf_sigma_px=psf_sigma_px,
        exposure_s=0.0,
        exposure_samples=1,
        grey_noise=0.0,
        step_px=0.33,
        event_sensor=sensor or base.imaging.event_sensor,
    )
    swing = swinging_motion(target, distance_m, np.eye(4), seed)
    motion = dataclasses.replace(swing, frequency_hz=_PACE * swing.frequency_hz)
    return dataclasses.replace(base, cameras=cameras, motion=motion, imaging=imaging)


# --- frames and corners ----------------------------------------------------------------------------------------------


def made_frames(
    recording: Recording, method: str, key: str, maker: FrameMaker, progress: Progress, shown_at: float = 1.0
) -> Frames:
    """The frames that `maker` makes of the events, one per ideal frame; kept under the name `method` and `key`.

    `shown_at`: which moment of its window an image shows, as `WindowPlan.showing` takes it.
    """
    times = recording.ideal_frames().timestamps_ns
    path = recording.folder / f"frames-{method}-{hashlib.sha256(key.encode()).hexdigest()[:12]}.npz"
    if not path.exists():
        rig = load_rig(recording.folder / "rig.yaml")
        with rig.cameras[0].open_events() as events:
            plan = TimedWindows(times, np.full(len(times), True)).showing(shown_at)
            made = maker(plan.windows(events), events.width, events.height)
            images = [image for _, image in track(made, f"{method} frames", len(times), progress)]
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            np.savez_compressed(file, images=np.stack(images))
        part.replace(path)
    with np.load(path) as file:
        return Frames(times, list(file["images"]), recording.camera.image_size)


def network_frames(recording: Recording, network: str | None, progress: Progress) -> Frames:
    """The frames that a reconstruction network makes (None: the one that jaxcal ships)."""
    import reconstruction

    loaded = reconstruction.load_network(network)
    weights = hashlib.sha256()
    for value in loaded.state_dict().values():
        weights.update(value.numpy().tobytes())
    key = json.dumps([weights.hexdigest(), loaded.settings])

    def maker(windows: Iterable[Window], width: int, height: int) -> Iterator[tuple[int, np.ndarray]]:
        return reconstruction.reconstruct(windows, loaded, width=width, height=height)

    return made_frames(recording, "network", key, maker, progress, loaded.shown_at)


def corners(recording: Recording, frames: Frames, name: str, progress: Progress) -> Detections:
    """Corners found in the frames that count; none at all where no frame shows the board."""
    images = [frames.images[number] for number in range(SETTLING_FRAMES, len(frames))]
    counted = Frames(frames.timestamps_ns[SETTLING_FRAMES:], images, frames.image_size)
    folder = recording.folder / "corners"
    # `detect` would look anew for what is wrong where nothing was found, each time.
    kept = DetectionCache(folder, name, detection_key(counted, recording.target)).load()
    if kept is not None:
        return kept
    try:
        return detect(counted, recording.target, workers=1, cache=folder, progress=progress, name=name)
    except jaxcal.CalibrationError:
        nothing = np.empty(0, np.int64)
        return Detections(counted.timestamps_ns, nothing, nothing, np.empty((0, 2)), counted.image_size)


def boards_found(detections: Detections, target: Target) -> int:
    """Frames in which the board counts as found: a checkerboard's corners, or four tags of an AprilGrid."""
    least = 16 if isinstance(target, AprilGrid) else 1
    return int((np.bincount(detections.frame, minlength=1) >= least).sum())


@dataclass(frozen=True)
class CornerErrors:
    """Found minus true corners (N, 2), px, and the velocity (N, 2) of the true ones, px/s."""

    errors: np.ndarray
    velocity: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """How fast each corner moves (N,), px/s."""
        return np.linalg.norm(self.velocity, axis=1)

    @property
    def median_px(self) -> float:
        """Median length of the error."""
        return float(np.median(np.linalg.norm(self.errors, axis=1))) if len(self.errors) else math.nan

    @property
    def rms_px(self) -> float:
        """Root mean square length of the error."""
        return float(np.sqrt((self.errors**2).sum(axis=1).mean())) if len(self.errors) else math.nan

    @property
    def latency_ms(self) -> float:
        """Time by which corners trail their true places: least squares of -error = latency * velocity."""
        power = (self.velocity**2).sum()
        return float(-1e3 * (self.errors * self.velocity).sum() / power) if power > 0 else math.nan

    def bias_px(self, slowest: float, fastest: float) -> float:
        """Mean error along the motion of the corners that move at these speeds (px/s); negative where they trail."""
        chosen = (self.speed >= slowest) & (self.speed < fastest)
        if not chosen.any():
            return math.nan
        along = (self.errors[chosen] * self.velocity[chosen]).sum(axis=1) / self.speed[chosen]
        return float(along.mean())

    @staticmethod
    def together(parts: Iterable["CornerErrors"]) -> "CornerErrors":
        """All corners of several recordings."""
        parts = list(parts)
        return CornerErrors(np.concatenate([p.errors for p in parts]), np.concatenate([p.velocity for p in parts]))


def corner_errors(recording: Recording, detections: Detections) -> CornerErrors:
    """The corners against the simulation's truth."""
    rig, camera = recording.rig, recording.camera
    times = rig.motion_time(camera, detections.timestamps_ns)
    points = jnp.asarray(rig.target.points)

    def projected(times_s: np.ndarray) -> np.ndarray:
        pixels, _ = project_points(camera.model, jnp.asarray(T_cam_target(rig, camera, times_s)), points)
        return np.asarray(pixels)[detections.frame, detections.point]

    true = projected(times)
    velocity = (true - projected(times - _VELOCITY_STEP_S)) / _VELOCITY_STEP_S
    return CornerErrors(detections.pixels - true, velocity)


# --- the command line and result files -------------------------------------------------------------------------------


def parser(description: str | None, seeds: int, duration_s: float) -> argparse.ArgumentParser:
    """The options that the scripts share."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--seeds", type=int, default=seeds, help="motions per scene (default: %(default)s)")
    made.add_argument("--duration", type=float, default=duration_s, help="seconds per recording (default: %(default)s)")
    made.add_argument("--quick", action="store_true", help="one seed of 2.5 s: does it work at all?")
    made.add_argument("--network", help="weights to reconstruct with (default: the network that jaxcal ships)")
    made.add_argument(
        "--work",
        type=Path,
        default=Path(platformdirs.user_cache_dir("jaxcal")) / "paper",
        help="folder for recordings, frames and results; what is there is not made again (default: %(default)s)",
    )
    made.add_argument("--readme", action="store_true", help="write the table into the README as well")
    return made


def arguments_of(made: argparse.ArgumentParser, argv: list[str] | None = None) -> argparse.Namespace:
    """The parsed options, with what `--quick` means worked in."""
    options = made.parse_args(argv)
    if options.quick:
        options.seeds, options.duration = 1, min(options.duration, 2.5)
    return options


def publish(options: argparse.Namespace, name: str, table: str, numbers: Any) -> None:
    """Print the table; write it and its numbers into the working folder, and into the README where asked to."""
    settings = {"seeds": options.seeds, "duration_s": options.duration, "network": options.network}
    content = json.dumps({"settings": settings, "results": numbers}, indent=1, allow_nan=True)
    write_text(options.work / f"{name}.json", content)
    write_text(options.work / f"{name}.md", table + "\n")
    print(table)
    if options.readme:
        into_readme(name, table)


def into_readme(name: str, table: str) -> None:
    """Put a table into its place in the README, between the comments of that name."""
    text = README.read_text()
    if f"<!-- {name} -->" not in text:
        print(f"error: {README} has no place <!-- {name} --> for the table.", file=sys.stderr)
        return
    filled = f"<!-- {name} -->\n{table}\n<!-- /{name} -->"
    write_text(README, re.sub(rf"<!-- {name} -->.*<!-- /{name} -->", lambda _: filled, text, flags=re.S))


def markdown(header: list[str], rows: Iterable[Iterable[str]]) -> str:
    """A markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
