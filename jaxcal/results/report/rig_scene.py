"""The rig in three dimensions: lines and names that the page draws at once and turns under the mouse."""

from dataclasses import dataclass

import numpy as np

from jaxcal.results.calibration import Calibration
from jaxcal.results.report.rig_figures import frustum, rig_poses, rim_rays

WIDTH, HEIGHT = 440.0, 330.0
# The first look: from behind, to the right and above (rad). `turn.js` goes on from there.
YAW, PITCH = 0.6, 0.36
_MARGIN = 26.0


@dataclass(frozen=True)
class SceneLine:
    """A line through points in page units about the scene's centre: as text 'x,y,z x,y,z', and drawn ('x,y x,y')."""

    kind: str
    space: str
    page: str


@dataclass(frozen=True)
class SceneName:
    """A name at a place, likewise."""

    text: str
    space: str
    x: float
    y: float


@dataclass(frozen=True)
class Scene:
    """What is drawn, seen from `yaw` and `pitch` (rad), and a bar of a round length (page units, its name)."""

    lines: tuple[SceneLine, ...]
    names: tuple[SceneName, ...]
    yaw: float
    pitch: float
    bar: float
    bar_name: str


def rig_scene(calibration: Calibration) -> Scene:
    """Cameras as pyramids, the line of their centres, and the IMU's axes, in the first camera's frame."""
    poses, T_cam0_imu = rig_poses(calibration)
    centres = np.array([pose[:3, 3] for pose in poses] + ([T_cam0_imu[:3, 3]] if T_cam0_imu is not None else []))
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    size = 0.22 * extent if extent > 1e-6 else 0.05
    lines = [("baseline", centres[: len(poses)])] if len(poses) > 1 else []
    for camera, pose in zip(calibration.cameras, poses, strict=True):
        lines += [("camera", line @ pose[:3, :3].T + pose[:3, 3]) for line in frustum(rim_rays(camera) * size)]
    names = [(camera.name, pose[:3, 3]) for camera, pose in zip(calibration.cameras, poses, strict=True)]
    if T_cam0_imu is not None:
        origin = T_cam0_imu[:3, 3]
        ends = origin + 0.8 * size * T_cam0_imu[:3, :3].T
        lines += [(f"axis-{axis}", np.stack([origin, end])) for axis, end in zip("xyz", ends, strict=True)]
        names.append(("imu0", origin))
    return _placed(lines, names)


def look(yaw: float, pitch: float) -> np.ndarray:
    """(2, 3) of a camera's frame (x right, y down, z forward) to the page's right and down."""
    right = [np.cos(yaw), 0.0, np.sin(yaw)]
    down = [np.sin(pitch) * np.sin(yaw), np.cos(pitch), -np.sin(pitch) * np.cos(yaw)]
    return np.array([right, down])


def _placed(lines: list[tuple[str, np.ndarray]], names: list[tuple[str, np.ndarray]]) -> Scene:
    everything = np.concatenate([points for _, points in lines])
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2.0
    # However it is turned, it stays in the picture.
    reach = max(float(np.linalg.norm(everything - middle, axis=1).max()), 1e-9)
    scale = (HEIGHT / 2.0 - _MARGIN) / reach
    view = look(YAW, PITCH)

    def space(points: np.ndarray) -> str:
        return " ".join(",".join(f"{value:.1f}" for value in point) for point in (points - middle) * scale)

    def page(points: np.ndarray) -> np.ndarray:
        return (points - middle) * scale @ view.T + np.array([WIDTH / 2.0, HEIGHT / 2.0])

    drawn = tuple(
        SceneLine(kind, space(points), " ".join(f"{x:.1f},{y:.1f}" for x, y in page(points))) for kind, points in lines
    )
    written = tuple(
        SceneName(text, space(place[None]), *(round(float(v), 1) for v in page(place[None])[0]))
        for text, place in names
    )
    length = _round_length(0.8 * reach)
    return Scene(
        drawn, written, YAW, PITCH, length * scale, f"{length * 1e3:g} mm" if length < 1.0 else f"{length:g} m"
    )


def _round_length(longest: float) -> float:
    """The longest of 1, 2, 5 times a power of ten that is not above."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(power * factor for factor in (1.0, 2.0, 5.0) if power * factor <= longest))
