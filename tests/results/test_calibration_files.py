"""What is saved comes back, and what cannot be read is refused with a reason."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_calibration import APRIL_GRID, make_calibration

import jaxcal
from jaxcal.atomic import write_text
from jaxcal.cameras import CameraModel, PinholeRadtan, model_name
from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuNoise, ImuRecording
from jaxcal.results import Calibration, load_calibration, load_camchain, save_calibration
from jaxcal.results.calibration import ImuCalibration
from jaxcal.targets import Checkerboard


class OwnLens(CameraModel):
    """A researcher's model: one focal length, a centre and one term."""

    focal: Any
    centre: Any
    bend: Any

    num_intrinsics: ClassVar[int] = 3

    def project(self, point: Any) -> Any:
        plane = point[:2] / point[2]
        return self.focal * plane * (1.0 + self.bend * plane @ plane) + self.centre

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "OwnLens":
        return cls(jnp.asarray(float(focal)), jnp.asarray(image_size) / 2.0, jnp.asarray(0.0))


def assert_same(first: Any, second: Any, where: str = "calibration") -> None:
    """Equal to the last bit, all the way down, NaN equal to NaN."""
    if isinstance(first, CameraModel):
        assert model_name(first) == model_name(second), where
        first, second = np.asarray(first.parameters), np.asarray(second.parameters)
    if isinstance(first, np.ndarray):
        assert isinstance(second, np.ndarray), where
        assert first.dtype == second.dtype, where
        np.testing.assert_array_equal(first, second, err_msg=where)
    elif dataclasses.is_dataclass(first):
        assert type(first) is type(second), where
        for field in dataclasses.fields(first):
            assert_same(getattr(first, field.name), getattr(second, field.name), f"{where}.{field.name}")
    elif where.endswith(".parameters"):
        assert list(first) == list(second), where
        for name in first:
            assert_same(first[name], second[name], f"{where}[{name}]")
    elif isinstance(first, tuple | list):
        assert len(first) == len(second), where
        for index, (a, b) in enumerate(zip(first, second, strict=True)):
            assert_same(a, b, f"{where}[{index}]")
    elif isinstance(first, float) and np.isnan(first):
        assert np.isnan(second), where
    else:
        assert first == second, where


def recorded(imu: ImuCalibration) -> ImuRecording:
    """A whole recording from which an IMU's result may have been made."""
    times = imu.origin_ns + np.round(imu.t_s * 1e9).astype(np.int64)
    return ImuRecording(times, imu.gyro_rad_s, imu.accel_m_s2, ImuNoise(**imu.noise))


def further_imu(imu: ImuCalibration, seed: int) -> ImuCalibration:
    """A second IMU, of a model with parameters."""
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        imu,
        model="scale-misalignment",
        parameters={"M_accel": rng.random((3, 3)), "M_gyro": rng.random((3, 3)), "A_gyro": rng.random((3, 3))}
        | {"C_gyro_i": np.eye(3)},
        T_imu_imu0=np.eye(4),
        timeshift_imu_imu0=0.003,
        noise_ratio=(1.1, 2.5),
    )


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@settings(deadline=None, max_examples=12)
@given(
    cameras=st.integers(1, 3),
    with_imu=st.booleans(),
    seed=st.integers(0, 2**31),
    unused=st.sampled_from([0.0, 0.3, 1.0]),
    target=st.sampled_from(
        [APRIL_GRID, Checkerboard(6, 9, 0.06), Checkerboard(5, 8, 0.1, 0.07), Checkerboard(4, 5, 0.1, 0.1)]
    ),
    warnings=st.lists(st.text(max_size=20), max_size=2),
    options=st.dictionaries(st.text(max_size=6), json_values, max_size=3),
    bias_std=st.booleans(),
)
def test_a_saved_calibration_comes_back_bit_by_bit(
    tmp_path_factory: pytest.TempPathFactory,
    cameras: int,
    with_imu: bool,
    seed: int,
    unused: float,
    target: Any,
    warnings: list[str],
    options: dict[str, Any],
    bias_std: bool,
) -> None:
    made = make_calibration(cameras, with_imu, seed, frames=8, unused=unused, target=target, duration_s=2.0)
    made = dataclasses.replace(made, warnings=tuple(warnings), settings=options, converged=bool(seed % 2))
    if made.imu is not None and not bias_std:
        made = dataclasses.replace(made, imu=dataclasses.replace(made.imu, gyro_bias_std=None, accel_bias_std=None))
    if made.imu is not None and seed % 5:
        made = dataclasses.replace(made, imu=dataclasses.replace(made.imu, recording=recorded(made.imu)))
    if made.imu is not None and seed % 3:
        made = dataclasses.replace(made, extra_imus=(further_imu(made.imu, seed),))
    folder = tmp_path_factory.mktemp("saved")
    made.save(folder)
    assert_same(load_calibration(folder), made)
    assert_same(load_calibration(folder / "calibration.npz"), made)


def test_the_public_names_save_and_load(tmp_path: Path) -> None:
    made = make_calibration(1, False, frames=6)
    made.save(str(tmp_path / "out"))
    again = jaxcal.load_calibration(str(tmp_path / "out"))
    assert isinstance(again, Calibration)
    assert_same(again, made)
    np.testing.assert_array_equal(again.std("cam0.intrinsics"), made.std("cam0.intrinsics"))


def test_a_model_from_a_users_module_comes_back(tmp_path: Path) -> None:
    made = make_calibration(1, False, frames=6)
    lens = OwnLens(jnp.asarray(455.5), jnp.array([321.0, 239.0]), jnp.asarray(-0.125))
    made = dataclasses.replace(made, cameras=(dataclasses.replace(made.cameras[0], model=lens),))
    made.save(tmp_path)
    assert_same(load_calibration(tmp_path).cameras[0].model, lens)
    (read,) = load_camchain(tmp_path / "camchain.yaml")
    assert_same(read.model, lens)
    content = yaml.safe_load((tmp_path / "camchain.yaml").read_text())
    assert content["cam0"]["camera_model"] == f"{OwnLens.__module__}:OwnLens"


def test_settings_that_json_cannot_hold_are_kept_as_text(tmp_path: Path) -> None:
    made = make_calibration(1, False, frames=6)
    odd = {"path": Path("/data/rig.yaml"), "rate": np.float64(20.5), "sizes": np.array([1, 2]), "names": {"b", "a"}}
    dataclasses.replace(made, settings=odd).save(tmp_path)
    assert load_calibration(tmp_path).settings == {
        "path": "/data/rig.yaml",
        "rate": 20.5,
        "sizes": [1, 2],
        "names": ["a", "b"],
    }


@pytest.mark.parametrize("with_imu", [True, False])
def test_the_folder_holds_kalibrs_files(tmp_path: Path, with_imu: bool) -> None:
    make_calibration(2, with_imu, frames=6).save(tmp_path)
    chain = "camchain-imucam.yaml" if with_imu else "camchain.yaml"
    expected = {"calibration.npz", "results.txt", chain, *(["imu.yaml"] if with_imu else [])}
    assert {path.name for path in tmp_path.iterdir()} == expected


@settings(deadline=None, max_examples=25)
@given(keep=st.floats(0.0, 0.999))
def test_a_truncated_file_is_refused(tmp_path_factory: pytest.TempPathFactory, keep: float) -> None:
    content = _saved_bytes(tmp_path_factory)
    file = tmp_path_factory.mktemp("cut") / "calibration.npz"
    file.write_bytes(content[: int(len(content) * keep)])
    with pytest.raises(CalibrationError, match=r"copy it again|calibrate and save again"):
        load_calibration(file)


@settings(deadline=None, max_examples=40)
@given(place=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_a_flipped_byte_never_gives_another_calibration(
    tmp_path_factory: pytest.TempPathFactory, place: float, flip: int
) -> None:
    content = bytearray(_saved_bytes(tmp_path_factory))
    content[int(place * len(content))] ^= flip
    file = tmp_path_factory.mktemp("flipped") / "calibration.npz"
    file.write_bytes(bytes(content))
    try:
        read = load_calibration(file)
    except CalibrationError:
        return
    # Some bytes of a zip (times, attributes) mean nothing.
    assert_same(read, make_calibration(1, True, frames=4, duration_s=1.0))


def test_a_missing_calibration_is_named_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"calibration\.npz.*calibration\.save"):
        load_calibration(tmp_path)
    with pytest.raises(CalibrationError, match="nowhere"):
        load_calibration(tmp_path / "nowhere")
    (tmp_path / "camchain.yaml").write_text("cam0: {}")
    with pytest.raises(CalibrationError, match="load_camchain"):
        load_calibration(tmp_path)


def test_another_npz_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", pixels=np.zeros(3))
    with pytest.raises(CalibrationError, match="it holds pixels"):
        load_calibration(tmp_path / "other.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 5}, "version 5.*upgrade jaxcal"),
        ({"version": 0}, "version 0.*calibrate and save again"),
        ({"version": None}, "version None"),
        ({"format": "something"}, "format is 'something'"),
        ({"cameras": [{}]}, "content is damaged"),
        ({"blocks": None}, "content is damaged"),
        ({"target": {"target_type": "moon"}}, "target_type is 'moon'"),
        ({"imu": {}}, "content is damaged"),
    ],
)
def test_a_changed_meta_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    _rewrite_meta(tmp_path, lambda meta: meta | change)
    with pytest.raises(CalibrationError, match=message):
        load_calibration(tmp_path)


def test_an_unknown_model_is_refused(tmp_path: Path) -> None:
    def rename(meta: dict[str, Any]) -> dict[str, Any]:
        meta["cameras"][0]["model"] = "pinhole-radtam"
        return meta

    _rewrite_meta(tmp_path, rename)
    with pytest.raises(CalibrationError, match="Did you mean 'pinhole-radtan'"):
        load_calibration(tmp_path)


def test_a_model_with_other_parameters_is_refused(tmp_path: Path) -> None:
    def rename(meta: dict[str, Any]) -> dict[str, Any]:
        meta["cameras"][0]["model"] = "pinhole-none"
        return meta

    _rewrite_meta(tmp_path, rename)
    with pytest.raises(CalibrationError, match="8 parameters were saved, but pinhole-none now has 4"):
        load_calibration(tmp_path)


def test_python_objects_are_never_written(tmp_path: Path) -> None:
    made = dataclasses.replace(make_calibration(1, False, frames=4), convergence=np.array([1.0, None]))
    with pytest.raises(CalibrationError, match="convergence holds Python objects"):
        save_calibration(made, tmp_path)
    assert not (tmp_path / "calibration.npz").exists()


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_text(tmp_path / "a.txt", "old")

    def refuse(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        write_text(tmp_path / "a.txt", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_parameters_survive_yaml_to_the_last_bit(tmp_path: Path) -> None:
    made = make_calibration(1, True, frames=4, duration_s=1.0)
    values = np.nextafter([458.6, 457.3, 322.7, 236.4], 1e9)
    lens = PinholeRadtan.create(values, [-0.1 / 3.0, 1e-5 / 3.0, 2e-17, -1.0 / 7.0])
    dataclasses.replace(made, cameras=(dataclasses.replace(made.cameras[0], model=lens),)).save(tmp_path)
    (read,) = load_camchain(tmp_path / "camchain-imucam.yaml")
    assert_same(read.model, lens)
    assert_same(read.T_cam_imu, made.cameras[0].T_cam_imu)


def test_a_calibration_is_read_without_matplotlib() -> None:
    code = "import sys, jaxcal; jaxcal.load_calibration; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


_SAVED: list[bytes] = []


def _saved_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    if not _SAVED:
        folder = tmp_path_factory.mktemp("whole")
        make_calibration(1, True, frames=4, duration_s=1.0).save(folder)
        _SAVED.append((folder / "calibration.npz").read_bytes())
    return _SAVED[0]


def _rewrite_meta(folder: Path, change: Any) -> None:
    make_calibration(1, True, frames=4, duration_s=1.0).save(folder)
    with np.load(folder / "calibration.npz") as data:
        arrays = {name: data[name] for name in data.files}
    meta = json.loads(arrays["meta"].tobytes())
    arrays["meta"] = np.frombuffer(json.dumps(change(meta)).encode(), dtype=np.uint8)
    np.savez(folder / "calibration.npz", **arrays)
