"""Files of other tools: what is written comes back, and the tools' own readers and projections understand it."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_examples import CORE, LENSES, lens, make_rig
from scipy.spatial.transform import Rotation
from synthetic_calibration import make_calibration

from jaxcal.cameras import model_name
from jaxcal.errors import CalibrationError
from jaxcal.results import load_camchain
from jaxcal.results.interchange import FORMATS, CalibratedRig, read_calibration, rig_of, write_calibration
from jaxcal.results.interchange.lenses import PLANAR, coefficients_of

HOLDS_POSES = ("kalibr", "openvins", "vins", "basalt", "opencv")
PAIRS = [(name, model) for name, format in FORMATS.items() for model in format.models]
POINTS = np.array([[0.1, 0.05, 1.0], [-0.4, 0.3, 1.2], [0.35, -0.5, 0.9], [0.0, 0.0, 2.0]])


def assert_same_lens(read: Any, written: Any) -> None:
    """Equal numbers: in one model, or, for models with OpenCV's coefficients, in the largest of these."""
    if model_name(read) == model_name(written):
        np.testing.assert_allclose(read.parameters, written.parameters, rtol=1e-12, atol=1e-15)
        return
    assert {model_name(read), model_name(written)} <= set(PLANAR)
    np.testing.assert_allclose(read.intrinsics, written.intrinsics, rtol=1e-12)
    np.testing.assert_allclose(coefficients_of(read, 14), coefficients_of(written, 14), rtol=1e-12, atol=0)


def assert_same_poses(read: CalibratedRig, written: CalibratedRig, with_imu: bool) -> None:
    for ours, theirs in zip(read.cameras[1:], written.cameras[1:], strict=True):
        assert ours.T_cn_cnm1 is not None
        np.testing.assert_allclose(np.asarray(ours.T_cn_cnm1), np.asarray(theirs.T_cn_cnm1), atol=1e-12)
    for ours, theirs in zip(read.cameras, written.cameras, strict=True):
        if with_imu:
            assert ours.T_cam_imu is not None
            np.testing.assert_allclose(np.asarray(ours.T_cam_imu), np.asarray(theirs.T_cam_imu), atol=1e-12)
            assert ours.timeshift_cam_imu == pytest.approx(theirs.timeshift_cam_imu, abs=1e-9)


def written_and_read(rig: CalibratedRig, format: str, folder: Path) -> CalibratedRig:
    write_calibration(rig, folder, format)
    read = read_calibration(folder)
    assert read.format == format
    return read


# --- there and back --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("format", "model"), PAIRS)
def test_every_lens_that_a_format_holds_comes_back(tmp_path: Path, format: str, model: str) -> None:
    rig = make_rig([model], with_imu=True, seed=1)
    read = written_and_read(rig, format, tmp_path)
    assert_same_lens(read.cameras[0].model, rig.cameras[0].model)
    assert read.cameras[0].image_size == rig.cameras[0].image_size


@pytest.mark.parametrize("format", HOLDS_POSES)
@settings(deadline=None, max_examples=5)
@given(data=st.data())
def test_rigs_come_back(format: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    most = 2 if format == "vins" else 4
    names = st.lists(st.sampled_from(FORMATS[format].models), min_size=1, max_size=most)
    shift = data.draw(st.floats(-0.1, 0.1))
    with_imu = format == "openvins" or data.draw(st.booleans())
    rig = make_rig(data.draw(names), with_imu, data.draw(st.integers(0, 2**30)), shift)
    read = written_and_read(rig, format, tmp_path_factory.mktemp(format))
    for ours, theirs in zip(read.cameras, rig.cameras, strict=True):
        assert_same_lens(ours.model, theirs.model)
        assert ours.name == theirs.name
        if format != "vins":  # has one size for all
            assert ours.image_size == theirs.image_size
    assert_same_poses(read, rig, with_imu)
    if with_imu and format != "opencv":
        assert read.imu is not None
        assert rig.imu is not None
        for name in ("gyro_noise_density", "gyro_random_walk", "accel_noise_density", "accel_random_walk"):
            assert getattr(read.imu.noise, name) == getattr(rig.imu.noise, name)


@pytest.mark.parametrize("format", ["ros", "colmap"])
def test_files_of_lenses_alone_keep_their_order_and_say_what_is_lost(tmp_path: Path, format: str) -> None:
    rig = make_rig(["pinhole-radtan"] * 11, with_imu=True, seed=3)
    done = write_calibration(rig, tmp_path, format)
    assert [camera.image_size for camera in read_calibration(tmp_path).cameras] == [c.image_size for c in rig.cameras]
    (note,) = done.notes
    assert "poses between cameras, poses to the IMU, time offsets, the IMU's noise" in note


def test_a_calibration_of_ours_is_written_and_its_folder_read(tmp_path: Path) -> None:
    made = make_calibration(2, True, frames=6)
    # Without poses of the board the text beside it is quickly written.
    bare = tuple(dataclasses.replace(camera, T_cam_target=None) for camera in made.cameras)
    made = dataclasses.replace(made, cameras=bare)
    made.save(tmp_path / "ours")
    rig = read_calibration(tmp_path / "ours")
    assert rig.format == "jaxcal"
    assert rig.imu is not None
    assert made.imu is not None
    np.testing.assert_allclose(np.asarray(rig.imu.gyro_bias), made.imu.gyro_bias.mean(axis=0))
    # Basalt has one time offset for all cameras: theirs are 8 and 5 ms.
    done = write_calibration(made, tmp_path / "basalt", "basalt")
    assert any("mean, 6.500 ms" in note and "3.000 ms apart" in note for note in done.notes)
    mean = tuple(dataclasses.replace(camera, timeshift_cam_imu=0.0065) for camera in rig_of(made).cameras)
    assert_same_poses(read_calibration(tmp_path / "basalt"), CalibratedRig(mean), with_imu=True)


# --- Kalibr ----------------------------------------------------------------------------------------------------------


@pytest.mark.real_data
def test_kalibrs_own_files_are_written_again_byte_for_byte(data_folder: Path, tmp_path: Path) -> None:
    folder = data_folder / "kalibr_sim_mono_imu"
    rig = CalibratedRig(
        read_calibration(folder / "kalibr_camchain-imucam.yaml").cameras,
        read_calibration(folder / "kalibr_imu.yaml").imu,
    )
    write_calibration(rig, tmp_path, "kalibr")
    for ours, theirs in (("camchain-imucam.yaml", "kalibr_camchain-imucam.yaml"), ("imu.yaml", "kalibr_imu.yaml")):
        assert (tmp_path / ours).read_text() == (folder / theirs).read_text()
    # Kalibr reads the noise with nothing above it.
    given, resulting = (yaml.safe_load((tmp_path / name).read_text()) for name in ("imu0.yaml", "imu.yaml"))
    assert len(given) == 6
    assert given.items() <= resulting["imu0"].items()


def test_a_fisheye_has_kalibrs_name_in_its_files(tmp_path: Path) -> None:
    write_calibration(make_rig(["pinhole-equi"], False, 0), tmp_path / "chain.yaml", "kalibr")
    assert yaml.safe_load((tmp_path / "chain.yaml").read_text())["cam0"]["distortion_model"] == "equidistant"
    (camera,) = load_camchain(tmp_path / "chain.yaml")
    assert model_name(camera.model) == "pinhole-equi"


def test_a_camchain_alone_says_that_the_noise_is_elsewhere(tmp_path: Path) -> None:
    done = write_calibration(make_rig(["pinhole-radtan"], True, 0), tmp_path / "chain.yaml", "kalibr")
    assert [path.name for path in done.paths] == ["chain.yaml"]
    assert done.notes == tuple(f"{name} is written where a folder is named" for name in ("imu.yaml", "imu0.yaml"))


# --- OpenCV's reader: OpenVINS, VINS-Fusion, OpenCV ------------------------------------------------------------------


def storage(path: Path) -> Any:
    opened = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert opened.isOpened()
    return opened


def nested(node: Any) -> np.ndarray:
    return np.array([[node.at(i).at(j).real() for j in range(node.at(i).size())] for i in range(node.size())])


def test_opencv_reads_what_openvins_gets(tmp_path: Path) -> None:
    rig = make_rig(["pinhole-equi", "pinhole-none"], True, 5)
    write_calibration(rig, tmp_path, "openvins")
    chain = storage(tmp_path / "kalibr_imucam_chain.yaml")
    for k, camera in enumerate(rig.cameras):
        node = chain.getNode(f"cam{k}")
        np.testing.assert_allclose(nested(node.getNode("T_imu_cam")) @ camera.T_cam_imu, np.eye(4), atol=1e-12)
        assert node.getNode("timeshift_cam_imu").real() == camera.timeshift_cam_imu
        assert node.getNode("distortion_model").string() == ("equidistant", "radtan")[k]
        assert [node.getNode("intrinsics").at(j).real() for j in range(4)] == np.asarray(
            camera.model.intrinsics
        ).tolist()
        assert [node.getNode("resolution").at(j).real() for j in range(2)] == list(camera.image_size)
    file = storage(tmp_path / "kalibr_imu_chain.yaml")
    imu = file.getNode("imu0")
    assert rig.imu is not None
    assert imu.getNode("accelerometer_noise_density").real() == rig.imu.noise.accel_noise_density
    np.testing.assert_array_equal(nested(imu.getNode("Tw")), np.eye(3))


def test_opencv_reads_what_vins_gets(tmp_path: Path) -> None:
    rig = make_rig(["omni-radtan", "pinhole-equi"], True, 6)
    write_calibration(rig, tmp_path, "vins")
    config = storage(tmp_path / "vins_config.yaml")
    assert config.getNode("num_of_cam").real() == 2
    assert config.getNode("td").real() == rig.cameras[0].timeshift_cam_imu
    assert config.getNode("g_norm").real() == 9.80665
    for k, camera in enumerate(rig.cameras):
        np.testing.assert_allclose(config.getNode(f"body_T_cam{k}").mat() @ camera.T_cam_imu, np.eye(4), atol=1e-12)
    mei = storage(tmp_path / config.getNode("cam0_calib").string())
    assert mei.getNode("model_type").string() == "MEI"
    assert mei.getNode("mirror_parameters").getNode("xi").real() == 0.9
    assert mei.getNode("projection_parameters").getNode("gamma2").real() == 605.0
    file = storage(tmp_path / "cam1.yaml")
    kannala = file.getNode("projection_parameters")
    assert [kannala.getNode(key).real() for key in ("k2", "k5", "mu", "v0")] == [0.00348, 0.0002, 190.978, 256.897]


@pytest.mark.parametrize("model", ["pinhole-none", "pinhole-radtan5", "pinhole-tilted14", "pinhole-equi"])
def test_opencv_projects_with_its_file_as_we_do(tmp_path: Path, model: str) -> None:
    write_calibration(make_rig([model], False, 0), tmp_path / "camera.yml", "opencv")
    file = storage(tmp_path / "camera.yml")
    matrix, distortion = file.getNode("camera_matrix").mat(), file.getNode("distortion_coefficients").mat()
    project = cv2.fisheye.projectPoints if file.getNode("fisheye_model").real() else cv2.projectPoints
    theirs, _ = project(POINTS.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, distortion)
    np.testing.assert_allclose(theirs.reshape(-1, 2), lens(model).project(jnp.asarray(POINTS)), atol=1e-9)


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_a_file_of_opencvs_own_sample_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out_camera_data{suffix}"
    out = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    matrix = np.array([[535.9, 0.0, 342.3], [0.0, 535.9, 235.6], [0.0, 0.0, 1.0]])
    distortion = np.array([[-0.266], [-0.0386], [1.78e-3], [-2.8e-4], [0.2384]])
    for key, value in (("image_width", 640), ("image_height", 480), ("fisheye_model", 0)):
        out.write(key, value)
    out.write("camera_matrix", matrix)
    out.write("distortion_coefficients", distortion)
    out.release()
    rig = read_calibration(path)
    assert rig.format == "opencv"
    (camera,) = rig.cameras
    assert model_name(camera.model) == "pinhole-radtan5"
    assert camera.image_size == (640, 480)
    theirs, _ = cv2.projectPoints(POINTS.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, distortion)
    np.testing.assert_allclose(theirs.reshape(-1, 2), camera.model.project(jnp.asarray(POINTS)), atol=1e-9)


# --- Basalt ----------------------------------------------------------------------------------------------------------


def test_basalts_json_has_basalts_keys_in_its_order(tmp_path: Path) -> None:
    rig = make_rig(["ds-none", "pinhole-equi"], True, 7)
    write_calibration(rig, tmp_path / "calib.json", "basalt")
    content = json.loads((tmp_path / "calib.json").read_text())["value0"]
    assert list(content) == [
        "T_imu_cam", "intrinsics", "resolution", "calib_accel_bias", "calib_gyro_bias", "imu_update_rate",
        "accel_noise_std", "gyro_noise_std", "accel_bias_std", "gyro_bias_std", "cam_time_offset_ns", "vignette",
    ]  # fmt: skip
    assert content["intrinsics"][0] == {
        "camera_type": "ds",
        "intrinsics": {"fx": 349.756, "fy": 348.7245, "cx": 365.8944, "cy": 249.33, "xi": -0.24095, "alpha": 0.56699},
    }
    assert list(content["intrinsics"][1]["intrinsics"]) == ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]
    assert content["cam_time_offset_ns"] == 12_300_000
    assert [len(content[key]) for key in ("calib_accel_bias", "calib_gyro_bias")] == [9, 12]
    pose = content["T_imu_cam"][1]
    rotation = Rotation.from_quat([pose["qx"], pose["qy"], pose["qz"], pose["qw"]])
    T_cam_imu = rig.cameras[1].T_cam_imu
    assert T_cam_imu is not None
    # The camera's origin in the IMU's frame, and the direction of its axis there.
    np.testing.assert_allclose([pose["px"], pose["py"], pose["pz"]], np.linalg.inv(T_cam_imu)[:3, 3], atol=1e-12)
    np.testing.assert_allclose(rotation.apply([0, 0, 1]), T_cam_imu[2, :3], atol=1e-12)


def test_basalts_unified_camera_is_an_omni_camera(tmp_path: Path) -> None:
    """u = fx x / (alpha |p| + (1 - alpha) z) + cx, Usenko et al. 2018, eq. 7."""
    write_calibration(make_rig(["omni-none"], True, 0), tmp_path / "calib.json", "basalt")
    text = json.loads((tmp_path / "calib.json").read_text())["value0"]["intrinsics"][0]
    assert text["camera_type"] == "ucm"
    fx, fy, cx, cy, alpha = (text["intrinsics"][key] for key in ("fx", "fy", "cx", "cy", "alpha"))
    below = alpha * np.linalg.norm(POINTS, axis=1) + (1 - alpha) * POINTS[:, 2]
    theirs = POINTS[:, :2] / below[:, None] * [fx, fy] + [cx, cy]
    np.testing.assert_allclose(theirs, lens("omni-none").project(jnp.asarray(POINTS)), atol=1e-9)


# --- ROS, COLMAP -----------------------------------------------------------------------------------------------------


def test_a_camera_info_is_what_ros_expects(tmp_path: Path) -> None:
    write_calibration(make_rig(["pinhole-radtan"], False, 0), tmp_path / "left.yaml", "ros")
    content = yaml.safe_load((tmp_path / "left.yaml").read_text())
    fx, fy, cx, cy = CORE
    assert list(content) == [
        "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model", "distortion_coefficients",
        "rectification_matrix", "projection_matrix",
    ]  # fmt: skip
    assert content["camera_matrix"] == {"rows": 3, "cols": 3, "data": [fx, 0, cx, 0, fy, cy, 0, 0, 1]}
    assert content["distortion_model"] == "plumb_bob"
    assert content["distortion_coefficients"]["cols"] == 5
    assert content["projection_matrix"]["data"] == [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]


def test_colmaps_first_pixel_has_its_centre_at_a_half(tmp_path: Path) -> None:
    write_calibration(make_rig(["pinhole-none"], False, 0), tmp_path / "cameras.txt", "colmap")
    words = (tmp_path / "cameras.txt").read_text().splitlines()[-1].split()
    assert words[:4] == ["1", "PINHOLE", "640", "480"]
    fx, fy, cx, cy = CORE
    np.testing.assert_allclose([float(word) for word in words[4:]], [fx, fy, cx + 0.5, cy + 0.5], atol=1e-12)


def test_colmaps_smaller_models_are_read(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text("# a comment\n2 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n1 RADIAL_FISHEYE 64 48 50 32 24 0.1 0.2\n")
    fisheye, radial = read_calibration(path).cameras
    assert (model_name(fisheye.model), model_name(radial.model)) == ("pinhole-equi", "pinhole-radtan")
    np.testing.assert_array_equal(fisheye.model.parameters, [50, 50, 31.5, 23.5, 0.1, 0.2, 0, 0])
    np.testing.assert_array_equal(radial.model.parameters, [500, 500, 319.5, 239.5, -0.1, 0, 0, 0])


def test_names_of_cameras_become_names_of_files(tmp_path: Path) -> None:
    rig = make_rig(["pinhole-radtan"] * 2, False, 0)

    def named(*names: str) -> CalibratedRig:
        cameras = [dataclasses.replace(camera, name=name) for camera, name in zip(rig.cameras, names, strict=True)]
        return dataclasses.replace(rig, cameras=tuple(cameras))

    for k, (names, files) in enumerate(
        [
            (("narrow_stereo/left", "../right"), ["narrow_stereo_left.yaml", "right.yaml"]),
            (("camera", "camera"), ["cam0.yaml", "cam1.yaml"]),
        ]
    ):
        done = write_calibration(named(*names), tmp_path / str(k), "ros")
        assert [path.name for path in done.paths] == files
        assert [camera.name for camera in read_calibration(tmp_path / str(k)).cameras] == list(names)


# --- what cannot be ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", FORMATS)
def test_a_lens_that_a_format_cannot_hold_is_refused_with_a_way_out(tmp_path: Path, format: str) -> None:
    other = next(name for name in LENSES if name not in FORMATS[format].models)
    with pytest.raises(CalibrationError) as caught:
        write_calibration(make_rig([other], True, 0), tmp_path, format)
    message = str(caught.value)
    assert f"cannot hold the model '{other}'" in message
    assert all(name in message for name in FORMATS[format].models)
    assert "jaxcal convert camera" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format", FORMATS)
@settings(deadline=None, max_examples=12)
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_by_name(
    format: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp(format)
    model = "pinhole-equi" if "pinhole-equi" in FORMATS[format].models else "pinhole-radtan"
    path = data.draw(st.sampled_from(write_calibration(make_rig([model], True, 1), folder, format).paths))
    words = re.split(r"(?<=[ \n])", path.read_text())
    place = data.draw(st.integers(0, len(words) - 1))
    words[place] = data.draw(
        st.sampled_from(["", "\n", "foo ", "nan ", "[", "{} ", "null ", "1e400 ", "-1 ", ": ", '"'])
    )
    path.write_text("".join(words[: data.draw(st.sampled_from([len(words), place + 1]))]))
    try:
        outcome = read_calibration(path).format
    except CalibrationError as error:
        outcome = str(error)
    assert outcome in FORMATS or str(folder) in outcome


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "cam0: [", "not a yaml file"),
        ("a.json", "{", "not a json file"),
        ("a.xml", "<opencv_storage><a>", "not a xml file"),
        ("a.yaml", "target_type: aprilgrid", "not a calibration that is known"),
        ("a.txt", "some words", "not a calibration that is known"),
        ("a.txt", "1 EQUIRECTANGULAR 640 480", "EQUIRECTANGULAR is not known"),
        ("a.txt", "1 PINHOLE 640 480 1 2 3", "expected 4"),
        ("a.yaml", "%YAML:1.0\nmodel_type: SCARAMUZZA\nimage_width: 1\nimage_height: 1", "'SCARAMUZZA' is not known"),
        ("a.yaml", "%YAML:1.0\nmodel_type: MEI\nimage_width: 1\nimage_height: 1", "'mirror_parameters' is missing"),
        ("a.json", '{"value0": {"T_imu_cam": [], "intrinsics": []}}', "'resolution' is missing"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationError, match=message) as caught:
        read_calibration(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


@pytest.mark.parametrize("format", ["ros", "opencv"])
def test_a_lens_with_too_few_coefficients_is_named_with_its_file(tmp_path: Path, format: str) -> None:
    (path,) = write_calibration(make_rig(["pinhole-equi"], True, 0), tmp_path, format).paths
    head, tail = path.read_text().split("distortion_coefficients:", 1)
    tail = re.sub(r"(rows|cols): 4", r"\1: 3", tail, count=1)
    path.write_text(head + "distortion_coefficients:" + re.sub(r",[^,\]]*\]", "]", tail, count=1))
    with pytest.raises(CalibrationError, match="3 distortion coefficients") as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)


def test_two_calibrations_in_a_folder_are_not_guessed_between(tmp_path: Path) -> None:
    rig = make_rig(["pinhole-radtan"], True, 0)
    write_calibration(rig, tmp_path, "basalt")
    write_calibration(rig, tmp_path, "kalibr")
    with pytest.raises(CalibrationError, match="several formats"):
        read_calibration(tmp_path)
    with pytest.raises(CalibrationError, match="no such file"):
        read_calibration(tmp_path / "nothing")


def test_what_a_tool_cannot_hold_of_a_rig_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="one or two cameras"):
        write_calibration(make_rig(["pinhole-radtan"] * 3, True, 0), tmp_path, "vins")
    with pytest.raises(CalibrationError, match="pose to an IMU"):
        write_calibration(make_rig(["pinhole-radtan"], False, 0), tmp_path, "openvins")
    with pytest.raises(CalibrationError, match=re.escape("several files here (cam0.yml, cam1.yml)")):
        write_calibration(make_rig(["pinhole-radtan"] * 2, False, 0), tmp_path / "a.yml", "opencv")
    with pytest.raises(CalibrationError, match="format 'basal' is unknown"):
        write_calibration(make_rig(["pinhole-radtan"], False, 0), tmp_path, "basal")
    with pytest.raises(CalibrationError, match=r"end in \.json"):
        write_calibration(make_rig(["ds-none"], True, 0), tmp_path / "a.yaml", "basalt")
