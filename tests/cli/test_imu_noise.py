"""`jaxcal imu-noise`: the imu.yaml it writes reads back as what was measured; what it says; how it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from jaxcal import ImuNoise
from jaxcal.cli import main
from jaxcal.recording import load_noise

RATE_HZ = 25.0
DENSITIES = {"gyroscope": (1.7e-4, 3e-6), "accelerometer": (2e-3, 2e-3)}


def imu_noise(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["imu-noise", *map(str, arguments)], catch_exceptions=False)


def readings(seconds: float, seed: int = 0) -> np.ndarray:
    """Gyroscope and accelerometer (N, 6) at rest."""
    rng = np.random.default_rng(seed)
    count = int(seconds * RATE_HZ)
    parts = [
        density * np.sqrt(RATE_HZ) * rng.standard_normal((count, 3))
        + np.cumsum(walk / np.sqrt(RATE_HZ) * rng.standard_normal((count, 3)), axis=0)
        for density, walk in DENSITIES.values()
    ]
    return np.concatenate(parts, axis=1) + np.array([0.01, -0.02, 0.005, 0.2, -0.1, 9.79])


def write_csv(path: Path, values: np.ndarray) -> Path:
    times = 1_600_000_000_000_000_000 + np.arange(len(values)) * round(1e9 / RATE_HZ)
    rows = [f"{t}," + ",".join(f"{v:.9f}" for v in row) for t, row in zip(times, values, strict=True)]
    path.write_text("#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_csv(tmp_path_factory.mktemp("imu") / "still.csv", readings(400.0))


def test_help_teaches_how_to_record() -> None:
    output = imu_noise("--help").output
    for word in ("jaxcal imu-noise still.csv --out imu.yaml", "3 hours", "half an hour", "10 minutes", "fan"):
        assert word in output


@pytest.mark.parametrize("inflate", [1.0, 2.5])
def test_imu_yaml_reads_back_as_what_was_measured(still: Path, tmp_path: Path, inflate: float) -> None:
    result = imu_noise(still, "--out", tmp_path / "imu.yaml", "--inflate", str(inflate), "--json")
    assert result.exit_code == 0
    told = json.loads(result.output)
    noise = load_noise(tmp_path / "imu.yaml")
    assert noise == ImuNoise(**told["imu_yaml"])
    assert noise.update_rate == pytest.approx(RATE_HZ)
    assert noise.gyro_noise_density == pytest.approx(inflate * 1.7e-4, rel=0.1)
    assert noise.accel_noise_density == pytest.approx(inflate * 2e-3, rel=0.15)
    assert noise.accel_random_walk == pytest.approx(inflate * 2e-3, rel=0.3)
    assert noise.gyro_random_walk == pytest.approx(inflate * told["gyroscope"]["random_walk"]["value"], rel=1e-3)
    # The file says what is a limit and what was measured, per axis.
    assert not told["gyroscope"]["random_walk"]["seen"]
    lines = (tmp_path / "imu.yaml").read_text().splitlines()
    (walk,) = [line for line in lines if line.startswith("gyroscope_random_walk:")]
    assert "upper limit, not a measurement" in walk
    (walk,) = [line for line in lines if line.startswith("accelerometer_random_walk:")]
    assert "limit" not in walk
    assert any(line.startswith("#   measured: x 1.") and ", y 1." in line for line in lines)
    assert any("400 s are too short" in line for line in lines)
    assert any("2.5 times" in line for line in lines) == (inflate == 2.5)
    assert "rostopic: /imu0" in lines


def test_it_prints_a_table_and_draws(still: Path, tmp_path: Path) -> None:
    result = imu_noise(still, "--plot", tmp_path / "new" / "allan.png")
    assert result.exit_code == 0
    assert f"{still}: 400 s at 25 Hz, still" in result.output
    assert "noise, /sqrt(Hz)" in result.output
    assert "note: gyroscope: 400 s are too short" in result.output
    assert (tmp_path / "new" / "allan.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_a_knock_is_refused_and_the_remedy_works(tmp_path: Path) -> None:
    values = readings(150.0, seed=1)
    values[:40, 3:] += np.random.default_rng(2).normal(0.0, 0.6, (40, 3))
    path = write_csv(tmp_path / "knocked.csv", values)
    result = imu_noise(path, "--out", tmp_path / "imu.yaml")
    assert result.exit_code == 1
    assert f"error: {path}: the IMU was moved or knocked in 3 of 150 seconds (accelerometer)" in result.output
    assert "--start 3.0 --stop 150.0" in result.output
    assert not (tmp_path / "imu.yaml").exists()
    result = imu_noise(path, "--out", tmp_path / "imu.yaml", "--start", "3", "--stop", "150")
    assert result.exit_code == 0
    assert load_noise(tmp_path / "imu.yaml").gyro_noise_density == pytest.approx(1.7e-4, rel=0.1)


def test_usage_errors(still: Path, tmp_path: Path) -> None:
    assert "absent.csv: no such IMU file" in imu_noise(tmp_path / "absent.csv").output
    assert "pictures end in .png" in imu_noise(still, "--plot", "allan.gif").output
    assert "nothing lies between --start and --stop" in imu_noise(still, "--start", "500").output
    assert "lasts 30.0 s, which is too short" in imu_noise(still, "--stop", "30").output
    assert imu_noise(still, "--inflate", "0").exit_code == 2
