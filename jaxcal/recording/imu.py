"""IMU recordings: EuRoC csv, npz tables and bags, with the noise model from Kalibr's imu.yaml."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuNoise, ImuRecording
from jaxcal.recording.bags import Bag, is_bag
from jaxcal.recording.places import split_place
from jaxcal.recording.yaml_files import as_mapping, as_positive, check_keys, located, read_mapping

_DENSITIES = (
    "accelerometer_noise_density",
    "accelerometer_random_walk",
    "gyroscope_noise_density",
    "gyroscope_random_walk",
)
# What else Kalibr writes into its imu.yaml and its results; none of it describes the noise.
_OTHER_KEYS = ("rostopic", "model", "time_offset", "T_i_b", "gyroscopes", "accelerometers")
_CSV_COLUMNS = "time in whole ns, gyroscope x y z in rad/s, accelerometer x y z in m/s^2"


def load_imu(noise: str | Path | ImuNoise, data: str | Path) -> ImuRecording:
    """Read what an IMU recorded.

    `noise` is a Kalibr imu.yaml (or an ImuNoise); `data` an EuRoC csv (time in ns, gyroscope rad/s, accelerometer
    m/s^2), an npz with `imu_ns` (N,), `gyro_rad_s` (N, 3) and `acc_m_s2` (N, 3), or sensor_msgs/Imu in a bag of ROS 1,
    ROS 2 or mcap: `FILE.bag:/imu`, where the topic may be left out if only one is an IMU's. Raises CalibrationError
    when a file is missing or malformed, or the values are not finite or not in order of time.
    """
    model = noise if isinstance(noise, ImuNoise) else load_noise(noise)
    path, topic = split_place(data)
    if is_bag(path) and path.exists():
        times, gyro, accel = _read_bag(path, topic)
    elif not path.is_file() or topic is not None:
        raise CalibrationError(
            f"{Path(data)}: no such IMU file. Expected a csv ({_CSV_COLUMNS}), an npz table or a bag."
        )
    else:
        times, gyro, accel = _read_npz(path) if path.suffix == ".npz" else _read_csv(path)
    with located(str(path)):
        return ImuRecording(times, gyro, accel, model)


def load_noise(path: str | Path) -> ImuNoise:
    """The noise model in a Kalibr `imu.yaml`, or in the imu.yaml that Kalibr wrote as a result (below `imu0:`)."""
    path = Path(path)
    return noise_from_yaml(read_mapping(path, "imu.yaml"), str(path))


def noise_from_yaml(content: Mapping[str, Any], where: str) -> ImuNoise:
    """The noise model in a mapping with Kalibr's keys; `where` names the mapping in errors.

    Kalibr's keys: accelerometer_noise_density (m/s^2/sqrt(Hz)), accelerometer_random_walk (m/s^3/sqrt(Hz)),
    gyroscope_noise_density (rad/s/sqrt(Hz)), gyroscope_random_walk (rad/s^2/sqrt(Hz)), update_rate (Hz, optional).
    """
    if "imu0" in content:
        content, where = as_mapping(content["imu0"], f"{where}: imu0"), f"{where}: imu0"
    check_keys(content, (*_DENSITIES, "update_rate"), where, required=_DENSITIES, ignored=_OTHER_KEYS)
    values = {key: as_positive(content[key], f"{where}: {key}") for key in _DENSITIES}
    rate = content.get("update_rate")
    return ImuNoise(update_rate=None if rate is None else as_positive(rate, f"{where}: update_rate"), **values)


def _read_bag(path: Path, topic: str | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """sensor_msgs/Imu: header, orientation (4), covariance (9), rate (3), covariance (9), acceleration (3)."""
    times, gyro, accel = [], [], []
    with Bag(path) as bag:
        chosen = bag.choose(topic, ("sensor_msgs/msg/Imu",), "IMU measurements")
        for _, content in bag.messages(chosen.name):
            fields = bag.fields(content)
            times.append(fields.header())
            values = fields.numbers("d", 28)
            gyro.append(values[13:16])
            accel.append(values[25:28])
    return np.array(times, np.int64), np.array(gyro, np.float64), np.array(accel, np.float64)


def _read_csv(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # Epoch nanoseconds do not fit float64, so the time has a column type of its own.
    row = np.dtype([("t", np.int64), ("gyro", np.float64, 3), ("accel", np.float64, 3)])
    try:
        with path.open(encoding="utf-8") as file:
            header = not file.readline().lstrip()[:1].isdigit()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # "no data": ImuRecording says so with a remedy
            table = np.loadtxt(path, dtype=row, delimiter=",", skiprows=int(header), comments="#", ndmin=1)
    except (ValueError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: {error}. Expected a csv with {_CSV_COLUMNS}.") from error
    return table["t"], table["gyro"], table["accel"]


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    names = ("imu_ns", "gyro_rad_s", "acc_m_s2")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as table:
            missing = [name for name in names if name not in table.files]
            if missing:
                raise CalibrationError(
                    f"{path}: '{missing[0]}' is missing; an IMU table holds {', '.join(names)}. It has: "
                    f"{', '.join(table.files)}."
                )
            times, gyro, accel = (table[name] for name in names)
    except CalibrationError:
        raise
    except Exception as error:  # numpy and zipfile report a damaged archive in many ways
        raise CalibrationError(f"{path}: not a readable npz file ({error}). Copy it again.") from error
    return times, gyro, accel
