"""Real recordings, and a simulated one that Kalibr calibrated too: figures that others published are met."""

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from simulated_truth import perturbation

from jaxcal import (
    AprilGrid,
    Checkerboard,
    Frames,
    ImuNoise,
    ImuRecording,
    calibrate_camera_imu,
    calibrate_cameras,
    detect,
    load_imu,
    load_target,
)
from jaxcal.recording.tables import load_detections

pytestmark = [pytest.mark.real_data, pytest.mark.slow]

log = logging.getLogger(__name__)

# EuRoC's published calibration of the rig, from other recordings than the one used here.
EUROC_FOCALS = ((458.654, 457.296), (457.587, 456.134))
EUROC_T_IMU_CAM0 = np.array(
    [
        [0.0148655, -0.9998809, 0.0041403, -0.0216401],
        [0.9995572, 0.0149672, 0.0257155, -0.0646770],
        [-0.0257744, 0.0037562, 0.9996607, 0.0098107],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def test_opencv_left_camera(data_folder: Path) -> None:
    """OpenCV publishes an RMS of 0.393 px for these thirteen images; on our corners it finds the lens that we find."""
    paths = sorted((data_folder / "opencv_stereo").glob("left*.jpg"))
    images = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
    board = Checkerboard(rows=6, cols=9, spacing=1.0)
    detections = detect(Frames(np.arange(len(images)), images, (640, 480)), board, workers=1)
    calibration = calibrate_cameras([detections], board)
    (camera,) = calibration.cameras
    log.info("fx: %s", float(camera.model.intrinsics[0]))
    log.info("rms_px: %s", camera.reprojection_rms_px)
    assert camera.reprojection_rms_px <= 0.40
    assert camera.inlier.mean() > 0.95
    rows = [detections.frame == frame for frame in detections.seen_frames]
    points = [board.points[detections.point[row]].astype(np.float32) for row in rows]
    pixels = [detections.pixels[row].astype(np.float32) for row in rows]
    _, matrix, *_ = cv2.calibrateCamera(points, pixels, (640, 480), None, None, flags=cv2.CALIB_FIX_K3)  # pyright: ignore
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    assert np.all(np.abs(np.asarray(camera.model.intrinsics) - theirs) < calibration.std("cam0.intrinsics"))


def test_kalibrs_own_corners_give_at_most_kalibrs_errors(data_folder: Path) -> None:
    """Kalibr errs by 0.0109 deg, 0.195 mm and 6.9 us on these corners."""
    folder = data_folder / "kalibr_sim_mono_imu"
    target = load_target(folder / "target.yaml")
    truth = yaml.safe_load((folder / "ground_truth.yaml").read_text())["cam0"]
    detections = load_detections(folder / "kalibr_corners.npz", target, (640, 480), "cam0")
    calibration = calibrate_camera_imu([detections], load_imu(folder / "imu.yaml", folder / "imu.csv"), target)
    (camera,) = calibration.cameras
    assert camera.T_cam_imu is not None
    assert camera.timeshift_cam_imu is not None
    error = perturbation(camera.T_cam_imu, np.array(truth["T_cam_imu"]))
    shift = camera.timeshift_cam_imu - truth["timeshift_cam_imu"]
    log.info("%s: %s", "rotation_deg", float(np.degrees(np.linalg.norm(error[:3]))))
    log.info("%s: %s", "translation_mm", float(1e3 * np.linalg.norm(error[3:])))
    log.info("%s: %s", "shift_us", 1e6 * shift)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.0109
    assert np.linalg.norm(error[3:]) < 0.195e-3
    assert abs(shift) < 10e-6
    assert np.asarray(camera.model.intrinsics) == pytest.approx(np.array(truth["intrinsics"]), abs=0.1)
    assert calibration.converged


def test_euroc_stereo_and_imu(data_folder: Path) -> None:
    """Both cameras and the IMU at once, beside the figures published for the rig."""
    path = data_folder / "euroc_imu_april" / "observations.npz"
    target = AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
    detections = [load_detections(path, target, (752, 480), name) for name in ("cam0", "cam1")]
    with np.load(path) as table:
        noise = ImuNoise(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3)
        imu = ImuRecording(table["imu_ns"], table["gyro_rad_s"], table["acc_m_s2"], noise)
    calibration = calibrate_camera_imu(detections, imu, target)
    first, second = calibration.cameras
    assert first.T_cam_imu is not None
    assert second.T_cn_cnm1 is not None
    T_imu_cam0 = np.linalg.inv(first.T_cam_imu)
    turn = Rotation.from_matrix(T_imu_cam0[:3, :3] @ EUROC_T_IMU_CAM0[:3, :3].T).magnitude()
    baseline = float(np.linalg.norm(second.T_cn_cnm1[:3, 3]))
    log.info("%s: %s", "rotation_deg", float(np.degrees(turn)))
    log.info("%s: %s", "translation_mm", float(1e3 * np.linalg.norm(T_imu_cam0[:3, 3] - EUROC_T_IMU_CAM0[:3, 3])))
    log.info("%s: %s", "baseline_m", baseline)
    for camera in calibration.cameras:
        log.info("%s: %s", f"{camera.name}_focal", np.asarray(camera.model.intrinsics[:2]).tolist())
        log.info("%s: %s", f"{camera.name}_rms_px", camera.reprojection_rms_px)
        log.info("%s: %s", f"{camera.name}_shift_ms", 1e3 * (camera.timeshift_cam_imu or np.nan))
    for camera, focal in zip(calibration.cameras, EUROC_FOCALS, strict=True):
        assert np.asarray(camera.model.intrinsics[:2]) == pytest.approx(np.array(focal), rel=0.008)
        assert camera.timeshift_cam_imu is not None
        assert abs(camera.timeshift_cam_imu) < 3e-3
        assert camera.reprojection_rms_px <= 0.5
        assert camera.inlier.mean() > 0.9
    assert baseline == pytest.approx(0.11007, abs=1e-3)
    assert np.degrees(turn) < 0.5
    assert np.linalg.norm(T_imu_cam0[:3, 3] - EUROC_T_IMU_CAM0[:3, 3]) < 15e-3
    assert calibration.converged
