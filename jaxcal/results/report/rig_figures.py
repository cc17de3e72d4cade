"""The figures of the rig: where the cameras and the IMU sit, and how they moved before the target."""

import numpy as np
from matplotlib.axes import Axes

from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration
from jaxcal.results.rays import rays_through
from jaxcal.results.report.drawing import (
    ACCENT,
    AXIS_COLOURS,
    INK,
    MUTED,
    PAPER,
    Picture,
    label,
    nothing_to_show,
    panel,
    to_svg,
)
from jaxcal.targets import Target

# A view of the first camera's frame (x right, y down, z forward): rows are the page's right and up.
_FROM_ABOVE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def rig_poses(calibration: Calibration) -> tuple[list[np.ndarray], np.ndarray | None]:
    """Poses T_cam0_camk (4, 4) of all cameras and T_cam0_imu, or None without an IMU.

    A camera that no transform ties to the first one is placed where the one before it is.
    """
    first = calibration.cameras[0]
    poses = [np.eye(4)]
    for camera in calibration.cameras[1:]:
        if camera.T_cn_cnm1 is not None:
            poses.append(poses[-1] @ np.linalg.inv(camera.T_cn_cnm1))
        elif camera.T_cam_imu is not None and first.T_cam_imu is not None:
            poses.append(first.T_cam_imu @ np.linalg.inv(camera.T_cam_imu))
        else:
            poses.append(poses[-1])
    return poses, first.T_cam_imu


def rig_pictures(calibration: Calibration, prefix: str) -> list[Picture]:
    """The rig from above, and with an IMU its path before the target."""
    poses, T_cam0_imu = rig_poses(calibration)
    figure, (axes,) = panel()
    _draw_rig(axes, calibration.cameras, [rim_rays(camera) for camera in calibration.cameras], poses, T_cam0_imu)
    label(axes, "x of the first camera [m]", "z, forward [m]")
    pictures = [
        Picture(
            "The rig from above",
            to_svg(figure, f"{prefix}-above"),
            "Cameras as the pyramids of their fields of view, the IMU as its three axes (x red, y green, z blue).",
            "what you see when you look at the rig: order, spacing and directions.",
            "compare with a ruler; a camera in the wrong place means too few shared views or a wrong target size.",
        )
    ]
    if calibration.imu is not None:
        pictures.append(_path_picture(calibration.imu, calibration.target, f"{prefix}-path"))
    return pictures


def _draw_rig(
    axes: Axes,
    cameras: tuple[CameraCalibration, ...],
    rims: list[np.ndarray],
    poses: list[np.ndarray],
    T_cam0_imu: np.ndarray | None,
) -> None:
    view = _FROM_ABOVE
    centres = np.array([pose[:3, 3] for pose in poses] + ([T_cam0_imu[:3, 3]] if T_cam0_imu is not None else []))
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    size = 0.22 * extent if extent > 1e-6 else 0.05
    flat = centres @ view.T
    axes.plot(*flat[: len(poses)].T, "-", color=MUTED, linewidth=0.8)
    for camera, rim, pose in zip(cameras, rims, poses, strict=True):
        for line in frustum(rim * size):
            axes.plot(*((line @ pose[:3, :3].T + pose[:3, 3]) @ view.T).T, color=ACCENT, linewidth=1.1)
        _name(axes, camera.name, pose[:3, 3] @ view.T)
    if T_cam0_imu is not None:
        centre = T_cam0_imu[:3, 3]
        for axis, colour in enumerate(AXIS_COLOURS):
            line = np.stack([centre, centre + 0.8 * size * T_cam0_imu[:3, axis]])
            axes.plot(*(line @ view.T).T, color=colour, linewidth=1.8)
        _name(axes, "imu0", centre @ view.T, above=True)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.12)


def _name(axes: Axes, text: str, at: np.ndarray, above: bool = False) -> None:
    axes.annotate(
        text,
        (float(at[0]), float(at[1])),
        (0, 9 if above else -14),
        textcoords="offset points",
        ha="center",
        fontsize=8.5,
        color=INK,
        bbox={"facecolor": PAPER, "edgecolor": "none", "alpha": 0.7, "pad": 1.0},
    )


def rim_rays(camera: CameraCalibration) -> np.ndarray:
    """Unit rays (4, 3) through the corners of the image, camera frame; zero where the model has none."""
    width, height = camera.image_size
    corners = np.array([[0.0, 0.0], [width - 1.0, 0.0], [width - 1.0, height - 1.0], [0.0, height - 1.0]])
    rays, _ = rays_through(camera.model, corners)
    return np.where(np.isfinite(rays), rays, 0.0)


def frustum(rim: np.ndarray) -> list[np.ndarray]:
    """Lines of a pyramid with its tip at the origin: four edges to the points `rim` (4, 3), and the rim."""
    return [*(np.stack([np.zeros(3), point]) for point in rim), np.vstack([rim, rim[:1]])]


def _path_picture(imu: ImuCalibration, target: Target, prefix: str) -> Picture:
    figure, (axes,) = panel()
    x = target.points[:, 0]
    finite = np.isfinite(imu.position_m).all(axis=1)
    if finite.any():
        step = max(1, len(imu.t_s) // 1500)
        path = imu.position_m[finite][::step]
        axes.plot(path[:, 0], path[:, 2], color=ACCENT, linewidth=1.0)
        axes.plot(*path[0, [0, 2]], "o", color=ACCENT, markersize=5.0, markerfacecolor="none")
        axes.plot([x.min(), x.max()], [0.0, 0.0], color=INK, linewidth=3.0, solid_capstyle="butt")
        axes.annotate("target", (x.mean(), 0.0), (0, 5), textcoords="offset points", ha="center", fontsize=8, color=INK)
    else:
        nothing_to_show(axes, "no motion estimated")
    axes.set_aspect("equal", adjustable="datalim")
    label(axes, "x of the target [m]", "distance from the target [m]")
    turned = _rotation_span_deg(imu.rotation[finite])
    return Picture(
        "Path of the IMU, seen from above the target",
        to_svg(figure, prefix),
        f"Position in the target's frame (ring: start). Orientations differ by up to {turned:.0f}° from the first.",
        "a smooth path at a plausible distance, with orientations that differ by 40 deg and more.",
        "too little rotation leaves the lever arm and the time offset weak; jumps mean wrong detections.",
    )


def _rotation_span_deg(rotations: np.ndarray) -> float:
    if not len(rotations):
        return 0.0
    trace = np.einsum("ij,nij->n", rotations[0], rotations)
    return float(np.degrees(np.arccos(np.clip((trace.min() - 1.0) / 2.0, -1.0, 1.0))))
