"""Rigs made up from a seed, with lenses of every built-in model that some file of another tool can hold."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.cameras import CameraModel, camera_model
from jaxcal.observations import ImuNoise
from jaxcal.results.interchange import CalibratedRig, RigImu
from jaxcal.results.kalibr import CamchainCamera

CORE = (458.654, 457.296, 367.215, 248.375)
RATIONAL = (0.55, 0.045, 2e-4, -1e-4, 0.0005, 0.9, 0.15, 0.004)
PRISM = (1e-3, -2e-5, -8e-4, 1e-5)
LENSES: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "pinhole-none": (CORE, ()),
    "pinhole-radtan": (CORE, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
    "pinhole-radtan5": (CORE, (-0.28, 0.09, 2e-4, -3e-4, -0.005)),
    "pinhole-rational8": (CORE, RATIONAL),
    "pinhole-thinprism12": (CORE, RATIONAL + PRISM),
    "pinhole-tilted14": (CORE, (*RATIONAL, *PRISM, 0.02, -0.03)),
    "pinhole-equi": ((190.978, 190.973, 254.93, 256.897), (0.00348, 0.00071, -0.00205, 0.0002)),
    "pinhole-fov": (CORE, (0.95,)),
    "pinhole-division": (CORE, (-0.2,)),
    "omni-none": ((1.2, 600.0, 605.0, 318.0, 241.0), ()),
    "omni-radtan": ((0.9, 600.0, 605.0, 318.0, 241.0), (-0.1, 0.02, 1e-3, -1e-3)),
    "eucm-none": ((0.6291, 1.0418, 191.148, 191.1315, 254.9586, 256.8815), ()),
    "ds-none": ((-0.24095, 0.56699, 349.756, 348.7245, 365.8944, 249.33), ()),
}


def lens(name: str) -> CameraModel:
    """The example lens of a model."""
    return camera_model(name).create(*LENSES[name])


def make_rig(models: list[str], with_imu: bool, seed: int, shift_s: float = 0.0123) -> CalibratedRig:
    """A rig of cameras with these lenses; all numbers but those of the lenses follow from the seed."""
    random = np.random.default_rng(seed)
    T_cam_imu = [_pose(random) for _ in models]
    cameras = tuple(
        CamchainCamera(
            name=f"cam{k}",
            model=lens(name),
            image_size=(640 + 16 * k, 480 + 8 * k),
            T_cn_cnm1=T_cam_imu[k] @ np.linalg.inv(T_cam_imu[k - 1]) if k else None,
            T_cam_imu=T_cam_imu[k] if with_imu else None,
            timeshift_cam_imu=shift_s if with_imu else None,
            overlaps=tuple(j for j in range(len(models)) if j != k),
            rostopic=f"/cam{k}/image_raw",
        )
        for k, name in enumerate(models)
    )
    if not with_imu:
        return CalibratedRig(cameras)
    densities = (10.0 ** random.uniform(-5, -2, 4)).tolist()
    imu = RigImu(ImuNoise(*densities, update_rate=200.0), random.normal(0, 0.02, 3), random.normal(0, 0.1, 3))
    return CalibratedRig(cameras, imu, 9.80665)


def _pose(random: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=random).as_matrix()
    pose[:3, 3] = random.normal(0.0, 0.1, 3)
    return pose
