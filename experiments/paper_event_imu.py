"""An event camera and an IMU, calibrated from events only, against the same from ideal frames.

    python experiments/paper_event_imu.py
    python experiments/paper_event_imu.py --quick

The paper's two translations are 7.4 mm apart. Both are set against the simulation's truth as well.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
from paper_scenes import (
    Recording,
    arguments_of,
    corners,
    markdown,
    network_frames,
    parser,
    publish,
)
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.cameras import model_name
from jaxcal.cli.progress_bars import ProgressBars
from jaxcal.observations import Detections
from jaxcal.progress import Progress
from jaxcal.recording import load_rig
from jaxcal.simulation import Imaging, SimulatedRig, paper_rig, write_recording
from jaxcal.simulation.recordings import fingerprint

RATE_HZ = 30.0


def main(argv: list[str] | None = None) -> int:
    options = arguments_of(parser(__doc__, seeds=1, duration_s=20.0), argv)
    numbers = []
    try:
        with ProgressBars() as bars:
            for seed in range(options.seeds):
                numbers.append({"seed": seed, **figures(options, seed, bars)})
    except jaxcal.CalibrationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    publish(options, "paper_event_imu", table(numbers), numbers)
    return 0


def event_imu_rig(seed: int, duration_s: float) -> SimulatedRig:
    """The built-in rig's first event camera and IMU, and a frame camera in the event camera's place."""
    base = paper_rig(duration_s=duration_s, seed=seed)
    camera = dataclasses.replace(base.cameras[0], rate_hz=RATE_HZ, phase_s=1.0 / RATE_HZ)
    ideal = dataclasses.replace(camera, name="cam1", kind="frames")
    imaging = Imaging(exposure_s=0.0, exposure_samples=1, grey_noise=0.0, step_px=0.33)
    return dataclasses.replace(base, cameras=(camera, ideal), imaging=imaging)


def figures(options: Any, seed: int, progress: Progress) -> dict[str, Any]:
    """A row: from events, from ideal frames, and the truth."""
    rig = event_imu_rig(seed, options.duration)
    folder = Path(options.work) / fingerprint(rig)[:16]
    write_recording(rig, folder, progress, workers=1)
    recording = Recording(rig, folder)
    events = corners(recording, network_frames(recording, options.network, progress), "network", progress)
    ideal = corners(recording, recording.ideal_frames(), "ideal", progress)
    T_events, shift_events, sigma = calibrated(recording, events, progress)
    T_ideal, shift_ideal, _ = calibrated(recording, ideal, progress)
    truth = rig.cameras[0]
    return {
        "apart_mm": 1e3 * float(np.linalg.norm(T_events[:3, 3] - T_ideal[:3, 3])),
        "apart_deg": angle_deg(T_events, T_ideal),
        "apart_ms": 1e3 * (shift_events - shift_ideal),
        "events_from_truth_mm": 1e3 * float(np.linalg.norm(T_events[:3, 3] - truth.T_cam_imu[:3, 3])),
        "ideal_from_truth_mm": 1e3 * float(np.linalg.norm(T_ideal[:3, 3] - truth.T_cam_imu[:3, 3])),
        "events_from_truth_ms": 1e3 * (shift_events - truth.timeshift_cam_imu),
        "sigma_mm": (1e3 * sigma[3:]).tolist(),
    }


def calibrated(
    recording: Recording, detections: Detections, progress: Progress
) -> tuple[np.ndarray, float, np.ndarray]:
    """T_cam_imu (4, 4), the time offset (s) and the transform's sigmas (6,) of one camera and the IMU."""
    imu = load_rig(recording.folder / "rig.yaml").imu
    assert imu is not None
    calibration = jaxcal.calibrate_camera_imu(
        [detections], imu.load(), recording.target, models=[model_name(recording.camera.model)], progress=progress
    )
    camera = calibration.cameras[0]
    assert camera.T_cam_imu is not None
    assert camera.timeshift_cam_imu is not None
    return np.asarray(camera.T_cam_imu), float(camera.timeshift_cam_imu), calibration.std("cam0.T_cam_imu")


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    """The angle between the rotations of two poses, degrees."""
    return float(np.rad2deg(Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).magnitude()))


def table(numbers: list[dict[str, Any]]) -> str:
    """The rows as markdown, below the paper's."""
    header = ["", "apart (mm)", "(deg)", "(ms)", "events from truth (mm)", "(ms)", "ideal frames from truth (mm)"]
    rows = [["paper", "7.4", "", "", "", "", ""]]
    for row in numbers:
        keys = ("apart_mm", "apart_deg", "apart_ms", "events_from_truth_mm", "events_from_truth_ms")
        values = [f"{row[key]:.3f}" for key in (*keys, "ideal_from_truth_mm")]
        rows.append([f"ours, seed {row['seed']}", *values])
    return markdown(header, rows)


if __name__ == "__main__":
    sys.exit(main())
