"""Camchain and imu files: Kalibr's own are read to the last digit, ours have Kalibr's keys, nesting and order."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from synthetic_calibration import make_calibration

from jaxcal.cameras import PinholeRadtan
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections
from jaxcal.results import load_camchain
from jaxcal.results.kalibr import camchain, camera_overlaps, imu_entry, to_yaml

ENTRY: dict[str, Any] = {
    "cam_overlaps": [],
    "camera_model": "pinhole",
    "distortion_coeffs": [-0.28, 0.07, 2e-4, -3e-4],
    "distortion_model": "radtan",
    "intrinsics": [458.0, 457.0, 320.0, 240.0],
    "resolution": [640, 480],
    "rostopic": "/cam0/image_raw",
}


def write(folder: Path, content: Any) -> Path:
    path = folder / "camchain.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize("with_imu", [True, False])
@pytest.mark.parametrize("cameras", [1, 3])
def test_a_camchain_comes_back_to_the_last_bit(tmp_path: Path, cameras: int, with_imu: bool) -> None:
    made = make_calibration(cameras, with_imu, seed=3, frames=6)
    path = tmp_path / "chain.yaml"
    path.write_text(to_yaml(camchain(made)))
    read = load_camchain(path)
    assert [camera.name for camera in read] == [f"cam{k}" for k in range(cameras)]
    for camera, source in zip(read, made.cameras, strict=True):
        np.testing.assert_array_equal(np.asarray(camera.model.parameters), np.asarray(source.model.parameters))
        assert camera.image_size == source.image_size
        assert camera.timeshift_cam_imu == source.timeshift_cam_imu
        for name in ("T_cn_cnm1", "T_cam_imu"):
            ours, theirs = getattr(camera, name), getattr(source, name)
            assert (ours is None) == (theirs is None)
            if ours is not None:
                np.testing.assert_array_equal(ours, theirs)


def test_only_later_cameras_have_a_transform_to_the_one_before() -> None:
    chain = camchain(make_calibration(3, False, frames=6))
    assert ["T_cn_cnm1" in entry for entry in chain.values()] == [False, True, True]


def test_cameras_are_written_as_ten_are_counted(tmp_path: Path) -> None:
    path = write(tmp_path, {f"cam{k}": ENTRY | {"resolution": [640 + k, 480]} for k in range(11)})
    assert [camera.image_size[0] - 640 for camera in load_camchain(path)] == list(range(11))


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["kalibr_camchain.yaml", "kalibr_camchain-imucam.yaml"])
def test_kalibrs_camchain_is_written_again_byte_for_byte(data_folder: Path, name: str) -> None:
    path = data_folder / "kalibr_sim_mono_imu" / name
    (read,) = load_camchain(path)
    base = make_calibration(1, True, frames=6).cameras[0]
    camera = dataclasses.replace(
        base,
        model=read.model,
        image_size=read.image_size,
        T_cam_imu=read.T_cam_imu,
        timeshift_cam_imu=read.timeshift_cam_imu,
    )
    made = dataclasses.replace(make_calibration(1, False, frames=6), cameras=(camera,))
    assert to_yaml(camchain(made)) == path.read_text()


@pytest.mark.real_data
def test_kalibrs_imu_result_is_written_again_byte_for_byte(data_folder: Path) -> None:
    folder = data_folder / "kalibr_sim_mono_imu"
    imu = make_calibration(1, True, frames=6).imu
    assert imu is not None
    stated = yaml.safe_load((folder / "imu.yaml").read_text())
    noise = {name: value for name, value in stated.items() if name != "rostopic"}
    assert to_yaml(imu_entry(dataclasses.replace(imu, noise=noise))) == (folder / "kalibr_imu.yaml").read_text()


def test_the_imus_rate_is_measured_where_none_is_stated() -> None:
    imu = make_calibration(1, True, frames=6).imu
    assert imu is not None
    noise = {name: value for name, value in imu.noise.items() if name != "update_rate"}
    entry = imu_entry(dataclasses.replace(imu, noise=noise))
    assert entry["imu0"]["update_rate"] == pytest.approx(200.0)


def test_kalibrs_empty_distortion_is_read(tmp_path: Path) -> None:
    for coefficients in ([], [0.0, 0.0, 0.0, 0.0]):
        entry = ENTRY | {"distortion_model": "none", "distortion_coeffs": coefficients}
        (camera,) = load_camchain(write(tmp_path, {"cam0": entry}))
        np.testing.assert_array_equal(np.asarray(camera.model.parameters), ENTRY["intrinsics"])


# --- overlaps --------------------------------------------------------------------------------------------------------


def seen(times_s: list[float], points: list[list[int]], shift: float | None = None) -> Any:
    """A camera that saw `points[k]` at `times_s[k]` on its own clock."""
    frame = np.repeat(np.arange(len(points)), [len(p) for p in points])
    point = np.array([p for group in points for p in group], dtype=np.int64)
    detections = Detections(
        np.round(np.array(times_s) * 1e9).astype(np.int64), frame, point, np.ones((len(point), 2)), (640, 480)
    )
    base = make_calibration(1, False, frames=4).cameras[0]
    return dataclasses.replace(
        base, model=PinholeRadtan.from_focal(400.0, (640, 480)), detections=detections, timeshift_cam_imu=shift
    )


def test_cameras_overlap_when_they_see_a_point_at_once() -> None:
    first = seen([0.0, 0.1, 0.2], [[0, 1], [2], []])
    same = seen([0.01, 0.11, 0.21], [[], [2, 3], [5]])
    other_points = seen([0.0, 0.1, 0.2], [[7], [8], [9]])
    other_times = seen([10.0, 10.1, 10.2], [[0], [2], [5]])
    nothing = seen([0.0, 0.1], [[], []])
    assert camera_overlaps((first, same, other_points, other_times, nothing)) == [[1], [0], [], [], []]


def test_overlap_is_judged_on_a_common_clock() -> None:
    first = seen([0.0, 0.1, 0.2], [[0], [1], [2]], shift=0.0)
    late_clock = seen([5.0, 5.1, 5.2], [[0], [1], [2]], shift=-5.0)
    assert camera_overlaps((first, late_clock)) == [[1], [0]]


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "pinhol"}, "cam0.*Did you mean"),
        ({"intrinsics": [1.0, 2.0, 3.0]}, "cam0.*3 intrinsics"),
        ({"intrinsics": ["a", 2, 3, 4]}, "cam0: intrinsics.*expected numbers"),
        ({"intrinsics": [float("nan"), 2.0, 3.0, 4.0]}, "cam0: intrinsics.*finite"),
        ({"resolution": [640]}, "cam0: resolution"),
        ({"T_cam_imu": np.diag([2.0, 1.0, 1.0, 1.0]).tolist()}, "cam0: T_cam_imu is not a rigid transform"),
        ({"T_cam_imu": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "not a rigid transform"),
        ({"T_cn_cnm1": np.eye(3).tolist()}, "T_cn_cnm1.*4x4"),
        ({"timeshift_cam_imu": [0.1]}, "timeshift_cam_imu"),
        ({"intrinsic": [1.0]}, "unknown key 'intrinsic'.*Did you mean 'intrinsics'"),
    ],
)
def test_a_wrong_entry_is_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = write(tmp_path, {"cam0": ENTRY | change})
    with pytest.raises(CalibrationError, match=message):
        load_camchain(path)


@pytest.mark.parametrize("key", ["camera_model", "distortion_coeffs", "distortion_model", "intrinsics", "resolution"])
def test_a_missing_key_is_named(tmp_path: Path, key: str) -> None:
    path = write(tmp_path, {"cam0": {k: v for k, v in ENTRY.items() if k != key}})
    with pytest.raises(CalibrationError, match=f"cam0: '{key}' is missing"):
        load_camchain(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "expected a camchain"), ("- 1", "expected a camchain"), ("a: [", "not a yaml file"), ("imu0: {}", "imu0"),
     ("cam0: 3", "cam0: expected keys")],
)  # fmt: skip
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=message):
        load_camchain(path)


def test_a_missing_camchain_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="no such camchain"):
        load_camchain(tmp_path / "camchain.yaml")
