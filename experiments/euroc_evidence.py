"""What the EuRoC recording says of its rig: against the published figures, and its two halves against each other.

    JAXCAL_DATA=../shared/data python experiments/euroc_evidence.py

Calibrates `euroc_imu_april` (stereo and IMU, corners given) with lenses free, with the published lenses held, and each
half by itself, IMU noise re-estimated: with lenses of its own, and with those of the cameras alone held, as Kalibr
does it. Rotations and translations are those of T_imu_cam; the published ones come from
other recordings of the rig, and from a pinhole-radtan lens, whose principal point they belong to.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import AprilGrid, Calibration, Detections, ImuNoise, ImuRecording, calibrate_camera_imu
from jaxcal.recording.tables import load_detections
from jaxcal.results.interchange.bare import calibration_of_file

TARGET = AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
PUBLISHED_CAMCHAIN = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187e-05]
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [-0.28368365, 0.07451284, -0.00010473, -3.5559e-05]
  intrinsics: [457.587, 456.134, 379.999, 255.238]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
  T_cn_cnm1: [[1, 0, 0, -0.11007], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""
PUBLISHED_T_IMU_CAM0 = np.array(
    [
        [0.0148655, -0.9998809, 0.0041403, -0.0216401],
        [0.9995572, 0.0149672, 0.0257155, -0.0646770],
        [-0.0257744, 0.0037562, 0.9996607, 0.0098107],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


@dataclass(frozen=True)
class Material:
    """What was recorded."""

    detections: list[Detections]
    imu: ImuRecording

    def half(self, second: bool) -> "Material":
        """Frames of the first or of the second half of the time; the IMU's samples are all there."""
        times = np.concatenate([d.timestamps_ns for d in self.detections])
        middle = (times.min() + times.max()) // 2
        kept = [d.of_frames((d.timestamps_ns >= middle) == second) for d in self.detections]
        return Material(kept, self.imu)


def read(folder: Path) -> Material:
    """The recording in the folder of all recordings."""
    path = folder / "euroc_imu_april" / "observations.npz"
    detections = [load_detections(path, TARGET, (752, 480), name) for name in ("cam0", "cam1")]
    with np.load(path) as table:
        noise = ImuNoise(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3)
        return Material(detections, ImuRecording(table["imu_ns"], table["gyro_rad_s"], table["acc_m_s2"], noise))


def calibrate(material: Material, model: str, **options: object) -> Calibration:
    """Both cameras with one model, the IMU's noise re-estimated; `options` of `calibrate_camera_imu`."""
    return calibrate_camera_imu(
        material.detections,
        material.imu,
        TARGET,
        models=[model] * 2,
        imu_noise="estimated",
        **options,  # pyright: ignore
    )


def difference(calibration: Calibration, T_imu_cam0: np.ndarray) -> tuple[float, float]:
    """Degrees and mm by which T_imu_cam0 differs."""
    T_cam_imu = calibration.cameras[0].T_cam_imu
    assert T_cam_imu is not None
    own = np.linalg.inv(T_cam_imu)
    turn = Rotation.from_matrix(own[:3, :3] @ T_imu_cam0[:3, :3].T).magnitude()
    return float(np.degrees(turn)), float(1e3 * np.linalg.norm(own[:3, 3] - T_imu_cam0[:3, 3]))


def in_combined_sigmas(one: Calibration, other: Calibration, block: str, error: np.ndarray) -> float:
    """The largest entry of a difference of both in their combined sigmas."""
    return float(np.max(np.abs(error) / np.hypot(one.std(block), other.std(block))))


def row_of(name: str, calibration: Calibration) -> str:
    """One calibration beside the published figures."""
    degrees, mm = difference(calibration, PUBLISHED_T_IMU_CAM0)
    first = calibration.cameras[0]
    numbers = ", ".join(f"{v:.2f}" for v in np.asarray(first.model.intrinsics))
    assert first.timeshift_cam_imu is not None
    rms = " / ".join(f"{camera.reprojection_rms_px:.3f}" for camera in calibration.cameras)
    return f"| {name} | {numbers} | {rms} | {degrees:.3f} | {mm:.2f} | {1e3 * first.timeshift_cam_imu:.3f} |"


def rows_of_halves(model: str, halves: Sequence[Calibration]) -> list[str]:
    """Per camera: rotation, translation, time offset of the second half less the first, and the largest in sigmas."""
    rows, (one, other) = [], halves
    for c, name in enumerate(("cam0", "cam1")):
        a, b = one.cameras[c], other.cameras[c]
        assert a.T_cam_imu is not None
        assert b.T_cam_imu is not None
        assert a.timeshift_cam_imu is not None
        assert b.timeshift_cam_imu is not None
        turn = Rotation.from_matrix(b.T_cam_imu[:3, :3] @ a.T_cam_imu[:3, :3].T).as_rotvec()
        moved = np.linalg.inv(b.T_cam_imu)[:3, 3] - np.linalg.inv(a.T_cam_imu)[:3, 3]
        shift = b.timeshift_cam_imu - a.timeshift_cam_imu
        pose = np.concatenate([turn, b.T_cam_imu[:3, 3] - a.T_cam_imu[:3, 3]])
        sigmas = max(
            in_combined_sigmas(one, other, f"{name}.T_cam_imu", pose),
            in_combined_sigmas(one, other, f"{name}.timeshift_cam_imu", np.array([shift])),
        )
        rows.append(
            f"| {model} | {name} | {np.degrees(np.linalg.norm(turn)):.3f} | {1e3 * np.linalg.norm(moved):.2f} "
            f"| {1e3 * abs(shift):.3f} | {sigmas:.2f} |"
        )
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=os.environ.get("JAXCAL_DATA"), help="folder of the recordings")
    parser.add_argument("--work", type=Path, default=Path("out/euroc"), help="for the published camchain (%(default)s)")
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("say where the recordings are: --data, or the environment variable JAXCAL_DATA")
    arguments.work.mkdir(parents=True, exist_ok=True)
    camchain = arguments.work / "published-camchain.yaml"
    camchain.write_text(PUBLISHED_CAMCHAIN)
    try:
        whole = read(arguments.data)
        held = {"cameras": calibration_of_file(camchain, TARGET), "intrinsics": "held"}
        print("| lenses | fx, fy, cx, cy of cam0 (px) | rms (px) | from published (deg) | (mm) | offset (ms) |")
        print("|---|---|---|---|---|---|")
        print(row_of("published, held", calibrate(whole, "pinhole-radtan", board_warp=True, **held)), flush=True)
        print(row_of("pinhole-radtan", calibrate(whole, "pinhole-radtan")), flush=True)
        print(row_of("pinhole-radtan5, board warp", calibrate(whole, "pinhole-radtan5", board_warp=True)), flush=True)
        print("\n| lenses of the halves | camera | deg apart | mm | ms | largest in combined sigmas |")
        print("|---|---|---|---|---|---|")
        richer = "pinhole-radtan5"
        alone = jaxcal.calibrate_cameras(whole.detections, TARGET, [richer] * 2, board_warp=True)
        for name, model, options in (
            ("pinhole-radtan", "pinhole-radtan", {}),
            (f"{richer}, board warp", richer, {"board_warp": True}),
            (f"{richer}, board warp, held", richer, {"board_warp": True, "cameras": alone, "intrinsics": "held"}),
        ):
            halves = [calibrate(whole.half(second), model, **options) for second in (False, True)]
            print("\n".join(rows_of_halves(name, halves)), flush=True)
    except jaxcal.CalibrationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
