"""IMU recordings: exact round trips of csv and npz, noise keys, and errors that name the file."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import CalibrationError, ImuNoise, load_imu
from jaxcal.recording import load_noise

NOISE = {
    "accelerometer_noise_density": 1.4e-3,
    "accelerometer_random_walk": 8.6e-5,
    "gyroscope_noise_density": 8.0e-5,
    "gyroscope_random_walk": 2.2e-6,
}
MODEL = ImuNoise(**NOISE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("imu")


def write_yaml(path: Path, content: dict[str, object], indent: str = "") -> Path:
    lines = [f"{indent}{key}: {value}\n" for key, value in content.items()]
    path.write_text(("imu0:\n" if indent else "") + "".join(lines))
    return path


@given(
    start=st.integers(0, 1_700_000_000_000_000_000),
    steps=st.lists(st.integers(1, 10**7), min_size=2, max_size=20),
    seed=st.integers(0, 2**32 - 1),
)
@settings(deadline=None, max_examples=40)
def test_csv_and_npz_round_trip_exactly(folder: Path, start: int, steps: list[int], seed: int) -> None:
    times = start + np.cumsum(np.array(steps, dtype=np.int64))
    gyro, accel = np.random.default_rng(seed).normal(size=(2, len(times), 3))
    rows = [",".join([str(t), *(repr(float(v)) for v in (*g, *a))]) for t, g, a in zip(times, gyro, accel, strict=True)]
    (folder / "data.csv").write_text("#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n" + "\n".join(rows) + "\n")
    np.savez(folder / "data.npz", imu_ns=times, gyro_rad_s=gyro, acc_m_s2=accel)
    for name in ("data.csv", "data.npz"):
        imu = load_imu(MODEL, folder / name)
        assert np.array_equal(imu.timestamps_ns, times)
        assert np.array_equal(imu.gyro_rad_s, gyro)
        assert np.array_equal(imu.accel_m_s2, accel)


def test_kalibr_input_and_result_layouts(tmp_path: Path) -> None:
    plain = load_noise(write_yaml(tmp_path / "imu.yaml", NOISE | {"rostopic": "/imu0", "update_rate": 200.0}))
    nested = load_noise(write_yaml(tmp_path / "result.yaml", NOISE | {"update_rate": 200.0, "model": "x"}, indent="  "))
    assert plain == nested
    assert (plain.accel_noise_density, plain.update_rate) == (1.4e-3, 200.0)
    # yaml 1.1 reads 8e-5 (no dot) as text
    text = dict.fromkeys(NOISE, "8e-5")
    assert load_noise(write_yaml(tmp_path / "text.yaml", text)).gyro_random_walk == 8e-5


def test_noise_errors(tmp_path: Path) -> None:
    def load(content: dict[str, object]) -> ImuNoise:
        return load_noise(write_yaml(tmp_path / "imu.yaml", content))

    with pytest.raises(CalibrationError, match=r"imu.yaml: unknown key 'gyroscope_noise'. Did you mean 'gyroscope_noi"):
        load(NOISE | {"gyroscope_noise": 1.0})
    with pytest.raises(CalibrationError, match="'gyroscope_random_walk' is missing"):
        load({key: value for key, value in NOISE.items() if key != "gyroscope_random_walk"})
    with pytest.raises(CalibrationError, match="gyroscope_random_walk: expected a positive number, found -1"):
        load(NOISE | {"gyroscope_random_walk": -1})
    with pytest.raises(CalibrationError, match=r"no such imu.yaml file"):
        load_noise(tmp_path / "absent.yaml")
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(CalibrationError, match="expected 'key: value' lines"):
        load_noise(tmp_path / "list.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,0,0,0,0,0,9.8\n2,0,0,0,0,0\n", "data.csv: .*column"),
        ("1.618e18,0,0,0,0,0,9.8\n", "whole ns"),
        (
            "t,wx,wy,wz,ax,ay,az\n1,0,0,0,0,0,9.8\n2,0,0,nan,0,0,9.8\n",
            r"data.csv: ImuRecording: gyro_rad_s: .*\(1, 2\)",
        ),
        ("1,0,0,0,0,0,9.8\n1,0,0,0,0,0,9.8\n", "data.csv: .*duplicate"),
        ("#timestamp\n", "data.csv: .*0 samples"),
    ],
)
def test_csv_errors(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "data.csv").write_text(text)
    with pytest.raises(CalibrationError, match=message):
        load_imu(MODEL, tmp_path / "data.csv")


def test_npz_errors(tmp_path: Path) -> None:
    np.savez(tmp_path / "table.npz", imu_ns=np.arange(3))
    with pytest.raises(CalibrationError, match=r"'gyro_rad_s' is missing.*It has: imu_ns"):
        load_imu(MODEL, tmp_path / "table.npz")
    (tmp_path / "broken.npz").write_bytes((tmp_path / "table.npz").read_bytes()[:60])
    with pytest.raises(CalibrationError, match=r"broken.npz: not a readable npz"):
        load_imu(MODEL, tmp_path / "broken.npz")
    with pytest.raises(CalibrationError, match="no such IMU file"):
        load_imu(MODEL, tmp_path / "absent.csv")
