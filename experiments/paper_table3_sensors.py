"""Table 3 of the paper: sensors of four kinds, and four ways to make frames of their events.

    python experiments/paper_table3_sensors.py --seeds 3
    python experiments/paper_table3_sensors.py --quick          # one short recording per sensor

The paper used recordings of real sensors; here they are simulated, with the resolution, a lens and the noise of each.
For every way of making frames: the boards found over those in ideal frames, and the reprojection error of a calibration
from them (root mean square length, px). E2VID's weights are not at hand: its column is the paper's own; the network
trained in its way is FireNet, on pictures of no board (models/firenet_pictures.md).
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from paper_baselines import event_count, leaky_integration
from paper_scenes import (
    Recording,
    arguments_of,
    boards_found,
    corner_errors,
    corners,
    made_frames,
    markdown,
    network_frames,
    parser,
    publish,
    record,
)

import jaxcal
from jaxcal.cameras import CameraModel, PinholeRadtan, model_name
from jaxcal.cli.progress_bars import ProgressBars
from jaxcal.observations import Detections, Frames
from jaxcal.progress import Progress
from jaxcal.simulation import EventSensorConfig
from jaxcal.targets import Checkerboard


@dataclass(frozen=True)
class Sensor:
    """One kind of event camera: lens, size, distance to the board (m), blur (px), noise, and E2VID's error (px)."""

    lens: CameraModel
    size: tuple[int, int]
    distance_m: float
    psf_sigma_px: float
    noise: EventSensorConfig
    paper_rms_px: float


def _lens(focal: float, size: tuple[int, int], *distortion: float) -> CameraModel:
    return PinholeRadtan.create((focal, focal, size[0] / 2 - 0.5, size[1] / 2 - 0.5), distortion)


# Thresholds and noise rates as usual for these sensors' default biases; refractory times of the right order.
SENSORS = {
    "DAVIS346": Sensor(
        _lens(255.0, (346, 260), -0.36, 0.14, 0.0005, -0.0003), (346, 260), 1.15, 0.6,
        EventSensorConfig(0.20, 0.24, 0.03, 100_000, 0.3, 1.0, 2e-4), 0.29,
    ),
    "Samsung Gen3": Sensor(
        _lens(480.0, (640, 480), -0.10, 0.05, 0.0003, 0.0004), (640, 480), 1.1, 0.7,
        EventSensorConfig(0.30, 0.30, 0.05, 300_000, 0.1, 0.5, 1e-4), 0.21,
    ),
    "Prophesee Gen3 ATIS": Sensor(
        _lens(360.0, (480, 360), -0.25, 0.08, -0.0004, 0.0002), (480, 360), 1.1, 0.6,
        EventSensorConfig(0.28, 0.35, 0.06, 200_000, 0.05, 1.5, 3e-4), 0.24,
    ),
    "Prophesee Gen4": Sensor(
        _lens(1050.0, (1280, 720), -0.12, 0.06, 0.0002, -0.0002), (1280, 720), 1.45, 0.8,
        EventSensorConfig(0.25, 0.30, 0.05, 50_000, 0.02, 0.3, 5e-5), 0.45,
    ),
}  # fmt: skip
BOARD = Checkerboard(rows=6, cols=9, spacing=0.1)
NETWORKS: dict[str, str | None] = {"ours": None, "FireNet, general training": "firenet_pictures"}  # None: `--network`
METHODS: dict[str, Callable] = {"leaky integration": leaky_integration, "event count": event_count}


def main(argv: list[str] | None = None) -> int:
    options = arguments_of(parser(__doc__, seeds=3, duration_s=8.0), argv)
    numbers = []
    try:
        with ProgressBars() as bars:
            for name in SENSORS:
                numbers.append({"sensor": name, **sensor_figures(options, name, bars)})
                print(f"{name}: done", file=sys.stderr, flush=True)
    except jaxcal.CalibrationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    publish(options, "paper_table3", table(numbers), numbers)
    return 0


def sensor_figures(options: Any, name: str, progress: Progress) -> dict[str, Any]:
    """Ratios, reprojection errors and corner errors of all methods, over all seeds."""
    sensor = SENSORS[name]
    found: dict[str, list[tuple[int, float, float]]] = {}
    for seed in range(options.seeds):
        recording = record(
            options.work, sensor.lens, sensor.size, (BOARD, sensor.distance_m), seed, options.duration, progress,
            sensor=sensor.noise, psf_sigma_px=sensor.psf_sigma_px,
        )  # fmt: skip
        frames: dict[str, Frames] = {"ideal": recording.ideal_frames()}
        for method, network in NETWORKS.items():
            frames[method] = network_frames(recording, network or options.network, progress)
        for method, maker in METHODS.items():
            frames[method] = made_frames(recording, method.replace(" ", "_"), "1", maker, progress)
        for method, images in frames.items():
            detections = corners(recording, images, method.replace(" ", "_"), progress)
            found.setdefault(method, []).append(
                (
                    boards_found(detections, BOARD),
                    reprojection_rms_px(recording, detections),
                    corner_errors(recording, detections).rms_px,
                )
            )
    boards = sum(count for count, _, _ in found["ideal"])
    return {
        method: {
            "ratio": sum(count for count, _, _ in outcomes) / max(boards, 1),
            "reprojection_rms_px": float(np.mean([rms for _, rms, _ in outcomes])),
            "corner_rms_px": float(np.mean([rms for _, _, rms in outcomes])),
        }
        for method, outcomes in found.items()
    }


def reprojection_rms_px(recording: Recording, detections: Detections) -> float:
    """Of the camera calibrated from these corners; nan where they do not determine it."""
    try:
        calibration = jaxcal.calibrate_cameras([detections], BOARD, [model_name(recording.camera.model)])
    except jaxcal.CalibrationError:
        return float("nan")
    return calibration.cameras[0].reprojection_rms_px


def table(numbers: list[dict[str, Any]]) -> str:
    """Boards found and reprojection errors as markdown, a row per sensor."""
    methods = (*NETWORKS, *METHODS, "ideal")
    header = ["sensor", "paper, E2VID: rms (px)"]
    for method in methods:
        header += [f"{method}: found", "rms (px)"]
    rows = []
    for row in numbers:
        cells = [row["sensor"], f"{SENSORS[row['sensor']].paper_rms_px:.2f}"]
        for method in methods:
            rms = row[method]["reprojection_rms_px"]
            cells += [f"{row[method]['ratio']:.3f}", "-" if np.isnan(rms) else f"{rms:.3f}"]
        rows.append(cells)
    return markdown(header, rows)


if __name__ == "__main__":
    sys.exit(main())
