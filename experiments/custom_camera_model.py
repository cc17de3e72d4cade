"""A camera model of your own, in about ten lines, calibrated on real data beside pinhole-radtan.

The model below is a stereographic lens with a polynomial on top: five numbers, no tangential terms, good from narrow
lenses to fisheyes. Change it, or write another: `project` for ONE point in JAX and a first guess are all it takes.
Unprojection, Jacobians, batching, yaml, plots and `--camera-model mymodule:MyCamera` follow from that.

Data: a folder with `euroc_imu_april/observations.npz` (corners of an AprilGrid in the two cameras of a EuRoC sensor) in
it, by --data or the environment variable JAXCAL_DATA. Every second frame is held back: there only the board's pose is
fitted, so that a model which merely follows the noise does not look better than it is.
"""

import argparse
import os
import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.recording import load_detections


class StereographicPolynomial(jaxcal.CameraModel):
    """pixel = f u (1 + k1 |u|^2 + k2 |u|^4) + c with u = 2 tan(theta / 2) (x, y) / |(x, y)|."""

    focal: Array
    centre: Array
    k: Array
    num_intrinsics = 3
    projection_names = ("f", "cx", "cy")
    distortion_names = ("k1", "k2")

    def project(self, point):
        u = 2.0 * point[:2] / (jnp.sqrt(point @ point + 1e-24) + point[2] + 1e-9)
        return self.focal * u * (1.0 + self.k[0] * u @ u + self.k[1] * (u @ u) ** 2) + self.centre

    @classmethod
    def from_focal(cls, focal, image_size):
        return cls(jnp.asarray(float(focal)), (jnp.asarray(image_size) - 1) / 2, jnp.zeros(2))


def main() -> int:
    arguments = parse_arguments()
    if arguments.data is None:
        print("error: no data. Give --data FOLDER, or set JAXCAL_DATA.", file=sys.stderr)
        return 1
    target = jaxcal.AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
    path = arguments.data / "euroc_imu_april" / "observations.npz"
    mine = f"{Path(__file__).stem}:StereographicPolynomial"
    print(f"{'camera':7} {'model':48} {'parameters':>10} {'RMS px':>8} {'held back px':>13}")
    try:
        for camera in ("cam0", "cam1"):
            detections = load_detections(path, target, (752, 480), camera)
            shown, held_back = detections_of(detections, 0), detections_of(detections, 1)
            for model in (mine, *arguments.compare):
                calibration = jaxcal.calibrate_cameras([shown], target, [model])
                (result,) = calibration.cameras
                away = held_back_rms(result.model, held_back, target.points)
                count, rms = result.model.num_parameters, result.reprojection_rms_px
                print(f"{camera:7} {model:48} {count:10d} {rms:8.4f} {away:13.4f}", flush=True)
                calibration.save(arguments.output / f"{camera}-{model.replace(':', '.')}")
    except jaxcal.CalibrationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"yaml and covariances: {arguments.output.resolve()}")
    return 0


def parse_arguments() -> argparse.Namespace:
    folder = os.environ.get("JAXCAL_DATA")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=Path(folder) if folder else None, help="folder with the recordings"
    )
    parser.add_argument(
        "--compare", nargs="+", default=["pinhole-radtan"], help="models to set beside it (%(default)s)"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("out/custom_model"), help="folder for results (%(default)s)"
    )
    return parser.parse_args()


def detections_of(detections: jaxcal.Detections, odd: int) -> jaxcal.Detections:
    """The corners of every second frame."""
    rows = detections.frame % 2 == odd
    frame, point, pixels = detections.frame[rows], detections.point[rows], detections.pixels[rows]
    return jaxcal.Detections(detections.timestamps_ns, frame, point, pixels, detections.image_size)


def held_back_rms(model: jaxcal.CameraModel, detections: jaxcal.Detections, points: np.ndarray) -> float:
    """RMS error (px) over frames in which only the pose is fitted; the worst 2 % of the corners are set aside."""
    every = [detections.frame == frame for frame in detections.seen_frames]
    squares = np.concatenate(
        [frame_errors(model, detections.pixels[rows], points[detections.point[rows]], len(points)) for rows in every]
    )
    return float(np.sqrt(np.mean(np.sort(squares)[: int(0.98 * len(squares))])))


def frame_errors(model: jaxcal.CameraModel, pixels: np.ndarray, points: np.ndarray, size: int) -> np.ndarray:
    """Squared errors (n,), px^2, of one frame's corners at the pose that fits them best."""
    count = len(pixels)
    padded_points = np.pad(points, [(0, size - count), (0, 0)], mode="edge")  # one shape, one compilation
    padded_pixels = np.pad(pixels, [(0, size - count), (0, 0)], mode="edge")

    def residual(pose: np.ndarray) -> np.ndarray:
        in_camera = Rotation.from_rotvec(pose[:3]).apply(padded_points) + pose[3:]
        return (np.asarray(_project(model, in_camera)) - padded_pixels)[:count].ravel()

    start = pose_from_rays(np.asarray(_unproject(model, padded_pixels))[:count], points)
    found = least_squares(residual, start, x_scale="jac", loss="huber")
    return np.sum(found.fun.reshape(-1, 2) ** 2, axis=1)


def pose_from_rays(rays: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pose (6,) of a planar target (rotation vector, translation) whose points lie along rays, by a linear solution."""
    plane = np.column_stack([points[:, :2], np.ones(len(points))])
    x, y, z = rays.T
    rows = [np.column_stack([0 * plane, -z[:, None] * plane, y[:, None] * plane])]
    rows.append(np.column_stack([z[:, None] * plane, 0 * plane, -x[:, None] * plane]))
    homography = np.linalg.svd(np.concatenate(rows))[2][-1].reshape(3, 3)
    homography /= np.linalg.norm(homography[:, :2]) / np.sqrt(2.0)
    homography *= np.sign(np.sum(rays * (plane @ homography.T)))
    left, _, right = np.linalg.svd(np.column_stack([homography[:, :2], np.cross(homography[:, 0], homography[:, 1])]))
    return np.concatenate([Rotation.from_matrix(left @ right).as_rotvec(), homography[:, 2]])


_project = eqx.filter_jit(lambda model, points: model.project(points))
_unproject = eqx.filter_jit(lambda model, pixels: model.unproject(pixels))


if __name__ == "__main__":
    sys.exit(main())
