"""Comparison with the truth: exact where estimate and truth agree, in sigmas where they do not."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic_calibration import make_calibration

from jaxcal import Calibration, CalibrationError
from jaxcal.cameras import model_name
from jaxcal.results.ground_truth import Comparison, compare_with_ground_truth, comparison_table


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return make_calibration(seed=3, cameras=2, with_imu=True)


def truth_of(calibration: Calibration) -> dict[str, Any]:
    """The ground truth of which `calibration` is a perfect estimate."""
    assert calibration.gravity is not None
    truth: dict[str, Any] = {"gravity_in_target": calibration.gravity.tolist()}
    for camera in calibration.cameras:
        assert camera.T_cam_imu is not None
        projection, _, distortion = model_name(camera.model).partition("-")
        truth[camera.name] = {
            "camera_model": projection,
            "intrinsics": np.asarray(camera.model.intrinsics).tolist(),
            "distortion_model": distortion,
            "distortion_coeffs": np.asarray(camera.model.distortion).tolist(),
            "T_cam_imu": camera.T_cam_imu.tolist(),
            "timeshift_cam_imu": camera.timeshift_cam_imu,
        }
    return truth


def compare(calibration: Calibration, truth: Any, folder: Path) -> dict[tuple[str, str], Comparison]:
    path = folder / "ground_truth.yaml"
    path.write_text(yaml.safe_dump(truth))
    return {(row.group, row.name): row for row in compare_with_ground_truth(calibration, path)}


def with_transform(calibration: Calibration, T: np.ndarray) -> Calibration:
    return replace(calibration, cameras=(replace(calibration.cameras[0], T_cam_imu=T), *calibration.cameras[1:]))


def test_a_perfect_estimate_has_no_error(calibration: Calibration, tmp_path: Path) -> None:
    rows = compare(calibration, truth_of(calibration), tmp_path)
    own = {key: row for key, row in rows.items() if not key[0].endswith("T_cn_cnm1")}
    assert len(own) == 2 * (8 + 6 + 1) + 3
    assert len(rows) == len(own) + 6
    for row in own.values():
        assert row.error == pytest.approx(0.0, abs=1e-9)


@given(
    axis=st.integers(0, 2),
    degrees=st.floats(0.001, 2.0),
    turn=st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3),
    shift=st.floats(-5.0, 5.0),
)
@settings(deadline=None, max_examples=40)
def test_errors_are_perturbations_in_the_cameras_frame(
    calibration: Calibration,
    tmp_path_factory: pytest.TempPathFactory,
    axis: int,
    degrees: float,
    turn: list[float],
    shift: float,
) -> None:
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    estimate = base.copy()
    estimate[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix() @ base[:3, :3]
    estimate[axis, 3] += shift * 1e-3
    truth = truth_of(with_transform(calibration, base))
    rows = compare(with_transform(calibration, estimate), truth, tmp_path_factory.getbasetemp())
    sigma = np.degrees(calibration.std("cam0.T_cam_imu")[axis])
    for k, name in enumerate("xyz"):
        row = rows["cam0.T_cam_imu", f"rotation {name}"]
        assert row.error == pytest.approx(degrees if k == axis else 0.0, abs=1e-9)
        assert abs(row.estimate - row.truth) < 90.0  # one turn is not written the other way round
        assert rows["cam0.T_cam_imu", f"translation {name}"].error == pytest.approx(shift if k == axis else 0.0)
    assert rows["cam0.T_cam_imu", f"rotation {'xyz'[axis]}"].error_in_sigmas == pytest.approx(degrees / sigma)


def test_relative_poses_come_from_the_truths_of_both_cameras(calibration: Calibration, tmp_path: Path) -> None:
    truth = truth_of(calibration)
    first, second = (np.array(truth[name]["T_cam_imu"]) for name in ("cam0", "cam1"))
    exact = replace(calibration.cameras[1], T_cn_cnm1=second @ np.linalg.inv(first))
    rows = compare(replace(calibration, cameras=(calibration.cameras[0], exact)), truth, tmp_path)
    assert rows["cam1.T_cn_cnm1", "translation x"].error == pytest.approx(0.0, abs=1e-9)
    assert rows["cam1.T_cn_cnm1", "rotation z"].error == pytest.approx(0.0, abs=1e-9)


def test_units_and_the_table(calibration: Calibration, tmp_path: Path) -> None:
    truth = truth_of(calibration)
    truth["cam0"]["intrinsics"][0] -= 2.0
    truth["cam0"]["timeshift_cam_imu"] -= 0.001
    rows = compare(calibration, truth, tmp_path)
    assert rows["cam0", "fx"].error == pytest.approx(2.0)
    assert rows["cam0", "fx"].error_in_sigmas == pytest.approx(2.0 / calibration.std("cam0.intrinsics")[0])
    assert rows["cam0", "time offset"].error == pytest.approx(1.0)
    table = comparison_table(list(rows.values()))
    assert "fx [px]" in table
    assert "time offset [ms]" in table
    ratios = [row.error_in_sigmas for row in rows.values() if row.error_in_sigmas is not None]
    assert f"over {len(ratios)} numbers: rms {np.sqrt(np.mean(np.square(ratios))):.2f}" in table


def test_another_lens_is_not_compared(calibration: Calibration, tmp_path: Path) -> None:
    truth = truth_of(calibration)
    truth["cam0"]["distortion_model"] = "equi" if truth["cam0"]["distortion_model"] == "radtan" else "radtan"
    rows = compare(calibration, truth, tmp_path)
    assert ("cam0", "fx") not in rows
    assert ("cam1", "fx") in rows


def test_errors_name_file_and_camera(calibration: Calibration, tmp_path: Path) -> None:
    truth = truth_of(calibration)
    with pytest.raises(CalibrationError, match="no such ground truth file"):
        compare_with_ground_truth(calibration, tmp_path / "absent.yaml")
    with pytest.raises(CalibrationError, match="no camera 'cam1'; the file knows"):
        compare(calibration, {name: value for name, value in truth.items() if name != "cam1"}, tmp_path)
    del truth["cam1"]["T_cam_imu"]
    with pytest.raises(CalibrationError, match=r"'cam1' is malformed .*T_cam_imu"):
        compare(calibration, truth, tmp_path)
    with pytest.raises(CalibrationError, match="expected camera names"):
        compare(calibration, [1], tmp_path)


@pytest.mark.real_data
def test_the_published_layout_is_read(data_folder: Path) -> None:
    one = make_calibration(seed=1, cameras=1, with_imu=True)
    rows = compare_with_ground_truth(one, data_folder / "kalibr_sim_mono_imu" / "ground_truth.yaml")
    truths = {row.name: row.truth for row in rows}
    assert truths["fx"] == 458.6
    assert truths["time offset"] == pytest.approx(8.0)
    assert truths["gy"] == pytest.approx(-9.80281659749331)
