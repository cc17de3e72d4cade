"""What the noise of the corners, carried through the calibration, does to a projected point.

The lens parameters alone do not answer this: a change of the lens that a turn or shift of the camera undoes does no
harm. So the camera may move, as it would have in the solution: a point that is fixed with respect to the boards that
were seen is projected by the perturbed lens from the perturbed place (mrcal, "Projection uncertainty", sections on
fixed coordinate systems and on cross-reprojection, https://mrcal.secretsauce.net/uncertainty.html; the aggregate motion
is the least-squares one over all corners seen). To first order:

    pixel moves by      A d + B xi        d: change of the lens, xi: of the camera's pose (rotation, translation)
    xi = -(sum B'B)^-1 (sum B'A) d        sums over the corners that were used, at their places in space
    covariance of pixel (A - B G) S (A - B G)'      G = (sum B'B)^-1 (sum B'A), S the covariance of the lens
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.programs import stored_jit
from jaxcal.results.calibration import Calibration, CameraCalibration
from jaxcal.results.rays import rays_through

DEFAULT_GRID = (60, 40)
# Numbers of corners are rounded up to a multiple of this power of two, so that few programs are compiled.
_CORNER_STEP = 4096
# Fewer corners than this do not fix a pose.
_FEWEST_CORNERS = 4


@dataclass(frozen=True)
class ProjectionUncertainty:
    """Uncertainty of projection over the image of one camera, at one range.

    `pixels` (ny, nx, 2) a grid over the image, its outermost points the centres of the outermost pixels; `covariance`
    (ny, nx, 2, 2) px^2 of the projection there, `sigma_px` (ny, nx) its 1-sigma in the worst direction; NaN where the
    lens has no ray. `range_m` is the distance of the points (inf: directions). `observed` (ny, nx) marks what lies
    within the outline of the corners of some view.

    `centre_px` is sigma at the image's centre, `rim_px` its median along the rim of the observed region and `worst_px`
    the largest inside that region; NaN where there is none.
    """

    camera: str
    range_m: float
    pixels: np.ndarray
    covariance: np.ndarray
    sigma_px: np.ndarray
    observed: np.ndarray
    centre_px: float
    rim_px: float
    worst_px: float

    @property
    def sentence(self) -> str:
        """The summary in words."""
        where = "at infinity" if np.isinf(self.range_m) else f"{self.range_m:g} m away"
        return (
            f"{self.camera}: the noise of the corners moves the projection of a point {where} by {self.centre_px:.2g} "
            f"px (1-sigma) at the image's centre, {self.rim_px:.2g} px at the rim of where corners were seen, and "
            f"{self.worst_px:.2g} px at worst inside."
        )


def projection_uncertainty(
    calibration: Calibration,
    camera: str | int,
    *,
    range_m: float | None = None,
    grid: tuple[int, int] = DEFAULT_GRID,
) -> ProjectionUncertainty:
    """Projection uncertainty of a camera (name or place) over its image, for points `range_m` metres from the camera.

    `range_m` None (or inf) means points at infinity; `grid` is (nx, ny). Only the noise of the corners counts: errors
    of the model do not show. Raises CalibrationError when the camera is unknown, when the range or grid make no sense,
    and when the calibration holds no poses or too few corners (`can_be_told`).
    """
    chosen = _camera(calibration, camera)
    nx, ny = grid
    if nx < 2 or ny < 2:
        raise CalibrationError(f"projection uncertainty: a grid of {nx} x {ny} points; expected 2 x 2 or more.")
    width, height = chosen.image_size
    across, down = np.meshgrid(np.linspace(0.0, width - 1.0, nx), np.linspace(0.0, height - 1.0, ny))
    pixels = np.stack([across, down], axis=-1)
    centre = np.array([[(width - 1.0) / 2.0, (height - 1.0) / 2.0]])
    covariance = projection_covariance(calibration, camera, np.concatenate([centre, pixels.reshape(-1, 2)]), range_m)
    sigma = worst_sigma(covariance)
    over_image = sigma[1:].reshape(ny, nx)
    observed = observed_region(chosen, grid)
    return ProjectionUncertainty(
        camera=chosen.name,
        range_m=np.inf if range_m is None else float(range_m),
        pixels=pixels,
        covariance=covariance[1:].reshape(ny, nx, 2, 2),
        sigma_px=over_image,
        observed=observed,
        centre_px=float(sigma[0]),
        rim_px=_over(over_image[_rim(observed)], np.median),
        worst_px=_over(over_image[observed], np.max),
    )


def projection_covariance(
    calibration: Calibration, camera: str | int, pixels: np.ndarray, range_m: float | None = None
) -> np.ndarray:
    """Covariance (K, 2, 2), px^2, of the projection of the points that `pixels` (K, 2) show at `range_m` metres.

    NaN where the lens has no ray for a pixel. Raises CalibrationError as `projection_uncertainty` does.
    """
    chosen = _camera(calibration, camera)
    if range_m is not None and not range_m > 0:
        raise CalibrationError(f"projection uncertainty: range {range_m} m; expected metres above 0, or None.")
    corners, weight = _corners_in_camera(calibration, chosen)
    if len(corners) < _FEWEST_CORNERS:
        raise CalibrationError(
            f"{chosen.name}: {len(corners)} corners with a known pose of the board; projection uncertainty needs "
            f"{_FEWEST_CORNERS} or more. Results of earlier releases hold no poses: calibrate again."
        )
    blocks = _lens_blocks(calibration, chosen)
    if not blocks:
        raise CalibrationError(f"{chosen.name}: this calibration holds no covariance of the lens. Calibrate again.")
    lens = calibration.covariance_of(*blocks)
    count = -(-len(corners) // _CORNER_STEP) * _CORNER_STEP
    padded = np.concatenate([corners, np.tile([[0.0, 0.0, 1.0]], (count - len(corners), 1))])
    inverse_range = 0.0 if range_m is None else 1.0 / range_m
    rays, valid = rays_through(chosen.model, pixels)
    normal, right, of_lens, of_pose = (
        np.asarray(part)
        for part in _sensitivities(
            chosen.model,
            # Without a program for each shape, as `jnp.asarray` would have.
            *map(jax.device_put, (padded, np.pad(weight, (0, count - len(corners))), rays, np.float64(inverse_range))),
        )
    )
    moved = of_lens - of_pose @ implied_motion(normal, right)
    covariance = np.einsum("kip,pq,kjq->kij", moved, lens, moved, optimize=True)
    return np.where(valid[:, None, None], covariance, np.nan)


def can_be_told(calibration: Calibration, camera: CameraCalibration) -> bool:
    """Whether projection uncertainty can be stated: there is a covariance, and corners with poses."""
    parameters = np.asarray(camera.model.parameters)
    sound = bool(np.isfinite(parameters).all() and np.isfinite(calibration.covariance).all())
    known = bool(_lens_blocks(calibration, camera))
    return known and sound and len(_corners_in_camera(calibration, camera)[0]) >= _FEWEST_CORNERS


def implied_motion(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(6, n) change of the pose per change of the lens, up to its sign, from sum B'B (6, 6) and sum B'A (6, n).

    Rotations and translations that the corners leave open stay zero.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale[:, None] * scale[None, :]
    return scale[:, None] * (np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) @ (scale[:, None] * right))


@stored_jit
def _sensitivities(
    model: CameraModel,
    corners: Float[Array, "M 3"],
    weight: Float[Array, " M"],
    rays: Float[Array, "K 3"],
    inverse_range: Float[Array, ""],
) -> tuple[Array, Array, Array, Array]:
    """Weighted sums over the corners: B'B (6, 6) and B'A (6, n); on the rays: A (K, 2, n) and B (K, 2, 6)."""
    parameters = model.parameters

    def project(vector: Array, point: Array) -> Array:
        return model.with_parameters(vector).project(point)

    B = jax.vmap(lambda point: _pose_jacobian(model, point, jnp.asarray(1.0)))(corners)
    weighted = B * weight[:, None, None]
    normal = jnp.einsum("mik,mil->kl", weighted, B)
    # B'A without A, which is large for splined lenses: six vector-Jacobian products over all corners at once.
    _, pull = jax.vjp(lambda vector: jax.vmap(lambda point: project(vector, point))(corners), parameters)
    right = jax.vmap(lambda column: pull(column)[0])(jnp.moveaxis(weighted, -1, 0))
    A = jax.vmap(lambda ray: jax.jacrev(project)(parameters, ray))(rays)
    B_there = jax.vmap(lambda ray: _pose_jacobian(model, ray, inverse_range))(rays)
    return normal, right, A, B_there


def _pose_jacobian(
    model: CameraModel, point: Float[Array, "3"], inverse_range: Float[Array, ""]
) -> Float[Array, "2 6"]:
    """Change of the pixel of a point (3,) with a small rotation (on the left) and translation of the scene.

    The point is `point / inverse_range`: for a direction and 0 a point at infinity. Projection does not see the length
    of a point, so its derivative is inversely proportional to it.
    """
    x, y, z = point
    by_rotation = jnp.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # d(w x p) / dw
    return jax.jacrev(model.project)(point) @ jnp.concatenate([by_rotation, inverse_range * jnp.eye(3)], axis=1)


def _camera(calibration: Calibration, camera: str | int) -> CameraCalibration:
    if isinstance(camera, int) and 0 <= camera < len(calibration.cameras):
        return calibration.cameras[camera]
    for one in calibration.cameras:
        if one.name == camera:
            return one
    known = ", ".join(one.name for one in calibration.cameras)
    raise CalibrationError(f"no camera is called '{camera}'. This calibration has: {known}.")


def _lens_blocks(calibration: Calibration, camera: CameraCalibration) -> list[str]:
    """The blocks of the covariance that make up the lens; none unless they are all there."""
    wanted = (f"{camera.name}.intrinsics", f"{camera.name}.distortion")
    sizes = {name: size for name, size in calibration.blocks if name in wanted}
    return [name for name in wanted if name in sizes] if sum(sizes.values()) == camera.model.num_parameters else []


def _corners_in_camera(calibration: Calibration, camera: CameraCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Places (M, 3), m, in the camera's frame of the corners that were used and whose frame has a pose, and their
    relative weights (M,)."""
    if camera.T_cam_target is None:
        return np.zeros((0, 3)), np.zeros(0)
    used = camera.used
    T = camera.T_cam_target[camera.detections.frame[used]]
    points = calibration.target_points[camera.detections.point[used]]
    places = np.einsum("mij,mj->mi", T[:, :3, :3], points) + T[:, :3, 3]
    precision = camera.detections.precision
    weight = np.ones(len(places)) if precision is None else precision[used] ** 2
    known = np.isfinite(places).all(axis=1)
    return places[known], weight[known]


def worst_sigma(covariance: np.ndarray) -> np.ndarray:
    """Square root of the larger eigenvalue of covariances (K, 2, 2), in closed form."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.sqrt(np.maximum((a + c) / 2.0 + np.hypot((a - c) / 2.0, b), 0.0))


def observed_region(camera: CameraCalibration, grid: tuple[int, int]) -> np.ndarray:
    """(ny, nx) True inside the outline of the used corners of some frame, for a grid (nx, ny) over the image."""
    mask = np.zeros((grid[1], grid[0]), dtype=np.uint8)
    scale = (np.array(grid) - 1.0) / (np.array(camera.image_size) - 1.0)
    used = camera.used
    frame, place = camera.detections.frame[used], camera.detections.pixels[used] * scale
    # Corners are in order of their frames.
    starts = np.flatnonzero(np.diff(frame, prepend=-1))
    for corners in np.split(place.astype(np.float32), starts[1:]) if len(starts) else ():
        outline = cv2.convexHull(corners).reshape(-1, 2)
        cv2.fillConvexPoly(mask, outline.round().astype(np.int32), 1)
    return mask.astype(bool)


def _rim(region: np.ndarray) -> np.ndarray:
    """Cells of a region with a neighbour that is not in it; beyond the array nothing is."""
    padded = np.pad(region, 1)
    inside = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return region & ~inside


def _over(values: np.ndarray, statistic: Callable[[np.ndarray], np.floating]) -> float:
    finite = values[np.isfinite(values)]
    return float(statistic(finite)) if len(finite) else float("nan")
