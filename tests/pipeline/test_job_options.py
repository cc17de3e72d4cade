"""The `calibration:` section of a rig.yaml: it takes what the jobs take, and says what is wrong with the rest."""

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jaxcal import CalibrationError, Checkerboard, calibrate_camera_imu, calibrate_cameras
from jaxcal.job_options import job_options, option_kinds

BOARD = Checkerboard(5, 8, 0.05)
SAID_ELSEWHERE = {"names", "models", "imu_models", "rolling_shutter", "progress"}


def options(job: Any, content: Any, folder: Path = Path()) -> dict[str, Any]:
    return job_options(job, content, "rig.yaml: calibration", folder, BOARD)


@pytest.mark.parametrize("job", [calibrate_cameras, calibrate_camera_imu])
def test_all_that_python_can_say_can_be_said(job: Any) -> None:
    named = {p.name for p in inspect.signature(job).parameters.values() if p.kind is p.KEYWORD_ONLY}
    assert set(option_kinds(job)) == named - SAID_ELSEWHERE
    defaults = {p.name: p.default for p in inspect.signature(job).parameters.values()}
    given = {name: defaults[name] for name in option_kinds(job)}
    assert options(job, given) == given


@pytest.mark.parametrize(
    ("job", "content", "message"),
    [
        (calibrate_cameras, {"vews": 20}, "calibration: unknown key 'vews'. Did you mean 'views'"),
        (calibrate_cameras, {"views": "twenty"}, "calibration.views: expected a whole number, found 'twenty'"),
        (calibrate_cameras, {"views": 20.5}, "calibration.views: expected a whole number"),
        (calibrate_cameras, {"board_warp": 1}, "calibration.board_warp: expected true or false, found 1"),
        (calibrate_cameras, {"sync_tolerance_s": "soon"}, "calibration.sync_tolerance_s: expected a number"),
        (calibrate_cameras, {"sync_tolerance_s": True}, "calibration.sync_tolerance_s: expected a number"),
        (calibrate_cameras, {"loss": "hubert"}, "calibration.loss: 'hubert' is not known. Did you mean 'huber'"),
        (calibrate_cameras, {"spline_order": 6}, "'spline_order' is for cameras with an IMU"),
        (calibrate_camera_imu, {"views": 20}, "'views' is for cameras without an IMU"),
        (calibrate_camera_imu, {"knot_rate_hz": ".inf"}, "calibration.knot_rate_hz: expected a number"),
        (calibrate_camera_imu, {"stamp_sigma_s": "late"}, "calibration.stamp_sigma_s: expected a number, found 'late'"),
        (calibrate_camera_imu, {"stamp_sigma_s": [0, None]}, r"stamp_sigma_s\[1\]: expected a number, found None"),
        (calibrate_camera_imu, {"imu_noise": "estimate"}, "Did you mean 'estimated'"),
        (calibrate_camera_imu, {"rolling_shutter": True}, "'rolling_shutter' is not said here, but by"),
        (calibrate_camera_imu, {"models": ["ds-none"]}, "'models' is not said here, but by 'model' of each camera"),
        (calibrate_camera_imu, {"cameras": "absent.yaml"}, "absent.yaml: no such file or folder"),
    ],
)
def test_mistakes_are_named(job: Any, content: Any, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        options(job, content)


def test_numbers_that_yaml_reads_as_text() -> None:
    assert options(calibrate_cameras, yaml.safe_load("{point_offset_sigma_m: 1e-4}")) == {"point_offset_sigma_m": 1e-4}
    assert options(calibrate_cameras, yaml.safe_load("{stamp_sigma_s: 5e-4}")) == {"stamp_sigma_s": 5e-4}
    assert options(calibrate_cameras, yaml.safe_load("{stamp_sigma_s: [0, 5e-4]}")) == {"stamp_sigma_s": [0.0, 5e-4]}


def test_an_earlier_calibration_is_read_from_a_camchain(tmp_path: Path) -> None:
    entry = {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "intrinsics": [458.0, 457.0, 367.0, 248.0],
        "distortion_coeffs": [-0.28, 0.07, 0.0, 0.0],
        "resolution": [752, 480],
    }
    (tmp_path / "chain.yaml").write_text(yaml.safe_dump({"cam0": entry}))
    found = options(calibrate_camera_imu, {"cameras": "chain.yaml", "intrinsics": "held"}, tmp_path)
    assert found["intrinsics"] == "held"
    (camera,) = found["cameras"].cameras
    np.testing.assert_array_equal(np.asarray(camera.model.intrinsics), entry["intrinsics"])
    assert len(camera.detections) == 0
