"""Camera models by name: Kalibr's, OpenCV's, mrcal's and a user's own; and through result files and back."""

import pickle
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from example_lenses import IMAGE_SIZE, LENSES, OWN, SPLINED, Stereographic, lens_of, some_points
from jaxtyping import Array

import jaxcal
from jaxcal import Calibration, Checkerboard, Detections, load_calibration
from jaxcal.cameras import CameraModel, camera_model, model_name, names
from jaxcal.errors import CalibrationError
from jaxcal.results import CameraCalibration, load_camchain

# Kalibr's seven: its wiki, "Supported models".
KALIBR = {"pinhole-radtan", "pinhole-equi", "pinhole-fov", "omni-none", "omni-radtan", "eucm-none", "ds-none"}


@pytest.mark.parametrize("name", sorted(LENSES))
def test_names_lead_to_models_and_back(name: str) -> None:
    assert model_name(camera_model(name)) == name
    assert model_name(lens_of(name)) == name


def test_kalibrs_models_are_all_there() -> None:
    assert set(names()) >= KALIBR


def test_a_misspelt_name_gets_a_suggestion() -> None:
    with pytest.raises(CalibrationError, match=r"Did you mean 'pinhole-radtan'.*Known: .*pinhole-equi"):
        camera_model("pinhole-radtann")
    with pytest.raises(CalibrationError, match=r"'zzz' is unknown. Known.*splined-ORDER-NX-NY-FOV"):
        camera_model("zzz")


def test_mrcals_name_means_the_same_class() -> None:
    theirs = camera_model("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=10_Ny=8_fov_x_deg=150")
    assert theirs is camera_model(SPLINED[0])
    assert camera_model("splined-2-8-9-170.5") is not camera_model("splined-2-8-9-170")
    assert model_name(camera_model("splined-2-8-9-170.5")) == "splined-2-8-9-170.5"


@pytest.mark.parametrize("name", sorted(LENSES))
def test_lenses_can_be_sent_to_another_process(name: str) -> None:
    lens = lens_of(name)
    again = pickle.loads(pickle.dumps(lens))
    assert type(again) is type(lens)
    np.testing.assert_array_equal(again.parameters, lens.parameters)


@pytest.mark.parametrize("name", sorted(LENSES))
def test_a_lens_survives_every_result_file(name: str, tmp_path: Path) -> None:
    lens = lens_of(name)
    calibration = calibration_of(lens)
    calibration.save(tmp_path)
    (read,) = load_camchain(tmp_path / "camchain.yaml")
    (loaded,) = load_calibration(tmp_path).cameras
    for again in (read.model, loaded.model):
        assert type(again) is type(lens)
        np.testing.assert_array_equal(again.parameters, lens.parameters)
    entry = yaml.safe_load((tmp_path / "camchain.yaml").read_text())["cam0"]
    if name in KALIBR:
        # Kalibr's own files spell this one out.
        distortion = entry["distortion_model"].replace("equidistant", "equi")
        assert f"{entry['camera_model']}-{distortion}" == name
    text = (tmp_path / "results.txt").read_text()
    assert f"{float(lens.parameters[0]):g}" in text


def calibration_of(lens: CameraModel) -> Calibration:
    """A calibration of one camera with this lens, as if it had been estimated perfectly."""
    target = Checkerboard(4, 5, 0.1)
    count = len(target.points)
    frame = np.zeros(count, dtype=np.int64)
    pixels = np.full((count, 2), 100.0) + 30.0 * target.points[:, :2]
    detections = Detections(np.array([0]), frame, np.arange(count), pixels, IMAGE_SIZE)
    sizes = (("cam0.intrinsics", len(lens.intrinsics)), ("cam0.distortion", len(lens.distortion)))
    blocks = tuple((block, size) for block, size in sizes if size)
    camera = CameraCalibration(
        name="cam0",
        model=lens,
        image_size=IMAGE_SIZE,
        T_cn_cnm1=None,
        T_cam_imu=None,
        timeshift_cam_imu=None,
        detections=detections,
        residuals_px=np.zeros((count, 2)),
        inlier=np.ones(count, dtype=bool),
        corner_sigma_px=0.1,
    )
    covariance = 1e-6 * np.eye(sum(size for _, size in blocks))
    return Calibration((camera,), target, None, None, blocks, covariance, np.array([2.0, 1.0]))


# --- a user's own ----------------------------------------------------------------------------------------------------


def test_a_users_model_works_by_dotted_name() -> None:
    cls = jaxcal.camera_model(OWN)
    assert cls is Stereographic
    lens = cls.create(LENSES[OWN].intrinsics)
    # It sees behind itself, where no pinhole does.
    points = some_points(OWN, (6,))
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert (rays[:, 2] < 0).any()
    np.testing.assert_allclose(lens.unproject(lens.project(points)), rays, atol=1e-9)
    assert lens.parameter_names == (("fx", "fy", "cx", "cy"), ())
    with pytest.raises(CalibrationError, match="expected 4 and 0"):
        cls.create(LENSES[OWN].intrinsics, [0.1])


class Bent(Stereographic):
    """Another order and number of parameters, without names."""

    num_intrinsics = 5
    bends: Array


def test_parameters_without_names_are_numbered() -> None:
    lens = Bent(jnp.ones(2), jnp.zeros(2), jnp.zeros(3))
    assert lens.parameter_names == (("i1", "i2", "i3", "i4", "i5"), ("d1", "d2"))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("example_lenses:Telecentric", "Telecentric"),
        ("example_lenses:Array", "not a subclass of jaxcal.CameraModel"),
        ("no_such_module_anywhere:Lens", "No module named 'no_such_module_anywhere'"),
        ("jaxcal.cameras.splined:Splined_1_2", "Splined_1_2"),
    ],
)
def test_a_users_model_that_is_not_there(name: str, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        camera_model(name)
