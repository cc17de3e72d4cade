"""What a study keeps of a calibration: each block of parameters with its values and 1-sigmas, as plain data."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.results import CalibratedRig, Calibration, load_calibration, read_calibration, rig_of
from jaxcal.results.kalibr import CamchainCamera

_POSE_LABELS = ("rx", "ry", "rz", "tx", "ty", "tz")
_POSE_UNITS = ("deg", "deg", "deg", "mm", "mm", "mm")
_LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))


@dataclass(frozen=True)
class Block:
    """One block of parameters, such as 'cam0.intrinsics' or 'cam1.T_cn_cnm1'.

    `values` (n,) in `units`, or for a pose the matrix (4, 4); `sigma` (n,) in `units`, None where it is not known. A
    pose has six parameters: rotation (a turn on the left, deg) and translation (mm).
    """

    name: str
    labels: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    sigma: np.ndarray | None

    @property
    def is_pose(self) -> bool:
        """Whether `values` are a (4, 4) pose."""
        return self.values.shape == (4, 4)

    @property
    def shown(self) -> np.ndarray:
        """(n,) values for a person: a pose as rotation vector and translation."""
        if not self.is_pose:
            return self.values
        return np.concatenate([_degrees(self.values[:3, :3]), 1e3 * self.values[:3, 3]])

    def minus(self, other: "Block | None") -> np.ndarray:
        """(n,) deviation from another estimate of the same block; NaN where there is none to compare with."""
        if other is None or other.labels != self.labels:
            return np.full(len(self.labels), np.nan)
        if not self.is_pose:
            return self.values - other.values
        turn = _degrees(self.values[:3, :3] @ other.values[:3, :3].T)
        return np.concatenate([turn, 1e3 * (self.values[:3, 3] - other.values[:3, 3])])

    def to_json(self) -> dict[str, Any]:
        """Plain lists, without loss."""
        return {
            "name": self.name,
            "labels": list(self.labels),
            "units": list(self.units),
            "values": self.values.tolist(),
            "sigma": None if self.sigma is None else self.sigma.tolist(),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Block":
        """What `to_json` gave."""
        sigma = content["sigma"]
        return cls(
            content["name"],
            tuple(content["labels"]),
            tuple(content["units"]),
            np.array(content["values"], dtype=float),
            None if sigma is None else np.array(sigma, dtype=float),
        )


def blocks_of(calibration: Calibration) -> list[Block]:
    """Every block that the calibration states, with its sigmas."""
    known = {name for name, _ in calibration.blocks}

    def with_sigma(block: Block, scale: np.ndarray) -> Block:
        sigma = calibration.std(block.name) * scale if block.name in known else None
        return Block(block.name, block.labels, block.units, block.values, sigma)

    blocks = [with_sigma(block, scale) for block, scale in _of_rig(rig_of(calibration))]
    for camera in calibration.cameras:
        for name, value, scale, unit in (
            ("timeshift_cam_cam0", camera.timeshift_cam_cam0, 1e3, "ms"),
            ("line_delay", camera.line_delay_s, 1e6, "us"),
        ):
            if value is not None:
                block = _plain(f"{camera.name}.{name}", (name,), (unit,), np.array([value]), scale)
                blocks.append(with_sigma(block, np.array([scale])))
    blocks += [with_sigma(block, scale) for block, scale in _of_others(calibration)]
    return blocks


def combined(blocks: Sequence[Block]) -> Block:
    """The mean of estimates of one block, without a sigma."""
    first = blocks[0]
    if not first.is_pose:
        return Block(first.name, first.labels, first.units, np.mean([b.values for b in blocks], axis=0), None)
    mean = np.eye(4)
    mean[:3, :3] = Rotation.from_matrix([b.values[:3, :3] for b in blocks]).mean().as_matrix()
    mean[:3, 3] = np.mean([b.values[:3, 3] for b in blocks], axis=0)
    return Block(first.name, first.labels, first.units, mean, None)


def reference_blocks(path: Path) -> dict[str, Block]:
    """What a reference says: a calibration of ours, any file that `read_calibration` reads, or the ground_truth.yaml of
    a simulation. Raises CalibrationError when it is none of these."""
    truth = _ground_truth(path)
    if truth is not None:
        return {block.name: block for block, _ in _of_rig(truth)}
    if path.suffix == ".npz" or (path / "calibration.npz").is_file():
        return {block.name: block for block in blocks_of(load_calibration(path))}
    return {block.name: block for block, _ in _of_rig(read_calibration(path))}


def _ground_truth(path: Path) -> CalibratedRig | None:
    """The rig that a simulation wrote down; None where the file is no ground truth."""
    if path.suffix not in (".yaml", ".yml") or not path.is_file():
        return None
    import yaml

    from jaxcal.cameras import camera_model
    from jaxcal.results.kalibr import name_of

    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(content, Mapping) or "gravity_in_target" not in content:
        return None
    cameras: list[CamchainCamera] = []
    before: np.ndarray | None = None
    try:
        for name, entry in content.items():
            if not (isinstance(entry, Mapping) and "camera_model" in entry):
                continue
            cls = camera_model(name_of(entry["camera_model"], entry["distortion_model"]))
            size = (int(entry["resolution"][0]), int(entry["resolution"][1]))
            parameters = np.array([*entry["intrinsics"], *entry["distortion_coeffs"]], dtype=float)
            model: CameraModel = cls.from_focal(1.0, size).with_parameters(parameters)
            pose = np.array(entry["T_cam_imu"], dtype=float).reshape(4, 4)
            relative = None if before is None else pose @ np.linalg.inv(before)
            shift = float(entry["timeshift_cam_imu"])
            cameras.append(CamchainCamera(str(name), model, size, relative, pose, shift, ()))
            before = pose
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CalibrationError(f"{path}: a damaged ground truth ({type(error).__name__}: {error}).") from error
    return CalibratedRig(tuple(cameras))


def _of_rig(rig: CalibratedRig) -> Iterator[tuple[Block, np.ndarray]]:
    """Lenses, poses and time offsets, each with what its sigma is multiplied by to be in the block's units."""
    for camera in rig.cameras:
        names = camera.model.parameter_names
        for part, labels in zip(("intrinsics", "distortion"), names, strict=True):
            if labels:
                units = tuple("px" if label in ("fx", "fy", "cx", "cy") else "" for label in labels)
                values = np.asarray(getattr(camera.model, part), dtype=float)
                yield _plain(f"{camera.name}.{part}", labels, units, values), np.ones(len(labels))
        for part in ("T_cn_cnm1", "T_cam_imu"):
            pose = getattr(camera, part)
            if pose is not None:
                yield _pose(f"{camera.name}.{part}", pose)
        if camera.timeshift_cam_imu is not None:
            name = f"{camera.name}.timeshift_cam_imu"
            values = np.array([camera.timeshift_cam_imu])
            yield _plain(name, ("timeshift_cam_imu",), ("ms",), values, 1e3), np.array([1e3])


def _of_others(calibration: Calibration) -> Iterator[tuple[Block, np.ndarray]]:
    if calibration.gravity is not None:
        yield _plain("gravity", ("gx", "gy", "gz"), ("m/s^2",) * 3, calibration.gravity), np.ones(3)
    for number, imu in enumerate(calibration.imus):
        for name, matrix in imu.parameters.items():
            values, entries = _entries(name, np.asarray(matrix, dtype=float))
            yield _plain(f"imu{number}.{name}", entries, ("",) * len(entries), values), np.ones(len(entries))
        if imu.T_imu_imu0 is not None and imu.timeshift_imu_imu0 is not None:
            yield _pose(f"imu{number}.T_imu_imu0", imu.T_imu_imu0)
            values = np.array([imu.timeshift_imu_imu0])
            name = "timeshift_imu_imu0"
            yield _plain(f"imu{number}.{name}", (name,), ("ms",), values, 1e3), np.array([1e3])
    shape = calibration.target_shape
    if shape is not None:
        for b, pose in enumerate(shape.T_target_board[1:], start=1):
            yield _pose(f"target.T_target_board{b}", pose)
        if shape.warp_m is not None:
            yield _plain("target.warp", ("warp x", "warp y"), ("mm", "mm"), shape.warp_m, 1e3), np.full(2, 1e3)


def _entries(name: str, matrix: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """The free entries of a matrix of an IMU's model, as `jaxcal.imu` counts them."""
    if name.startswith("M_"):
        return np.array([matrix[i, j] for i, j in _LOWER]), tuple(f"{i + 1}{j + 1}" for i, j in _LOWER)
    if name == "C_gyro_i":
        return Rotation.from_matrix(matrix).as_rotvec(), ("x", "y", "z")
    if matrix.ndim == 2:
        return matrix.ravel(), tuple(f"{i + 1}{j + 1}" for i in range(3) for j in range(3))
    return matrix, ("x", "y", "z")


def _plain(name: str, labels: Sequence[str], units: Sequence[str], values: np.ndarray, scale: float = 1.0) -> Block:
    return Block(name, tuple(labels), tuple(units), scale * np.asarray(values, dtype=float), None)


def _pose(name: str, pose: np.ndarray) -> tuple[Block, np.ndarray]:
    scale = np.repeat([np.degrees(1.0), 1e3], 3)
    return Block(name, _POSE_LABELS, _POSE_UNITS, np.asarray(pose, dtype=float), None), scale


def _degrees(rotation: np.ndarray) -> np.ndarray:
    return np.degrees(Rotation.from_matrix(rotation).as_rotvec())
