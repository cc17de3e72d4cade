"""Poses of a planar board from rays, for all views and lens hypotheses at once; valid beyond 90 degrees."""

import numpy as np

# Re-weighted passes of the linear estimate: enough for a fifth of the corners to be wrong.
_PASSES = 4


def planar_poses(points: np.ndarray, rays: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of boards that are flat (z = 0 up to a warp): R_cam_target (..., 3, 3) and t_cam_target (..., 3).

    `points` (..., N, 3) on the board, `rays` (..., N, 3) of unit length in the camera frame, `weight` (..., N) 0 for
    corners that do not take part. Direct linear transform on rays: ray x (H p) = 0 with H = [r1 r2 t] and p = (x, y,
    1), by normal equations (the sum of (I - ray ray') kron (p p')), re-weighted by Geman-McClure's function of the
    angles that remain. Views without enough corners get a board that faces the camera.
    """
    shape = np.broadcast_shapes(points.shape[:-2], rays.shape[:-2], weight.shape[:-1])
    weight = np.broadcast_to(weight, (*shape, weight.shape[-1]))
    rays = np.broadcast_to(rays, (*shape, *rays.shape[-2:]))
    points = np.broadcast_to(points, (*shape, *points.shape[-2:]))
    towards, squeeze, local = _centred_rays(rays, weight)
    plane, unscale = _centred_plane(points, weight)
    products = (plane[..., :, None] * plane[..., None, :]).reshape(*shape, -1, 9)
    across = (np.eye(3) - local[..., :, None] * local[..., None, :]).reshape(*shape, -1, 9)
    robust = weight
    for _ in range(_PASSES):
        homography, determined = _linear_homography(across, products, robust)
        mapped = np.einsum("...ij,...nj->...ni", homography, plane)
        length = np.linalg.norm(mapped, axis=-1)
        cosine = np.sum(mapped * local, axis=-1) / np.maximum(length, 1e-300)
        # Most of the board lies before the lens.
        side = np.where(np.sum(np.sign(cosine) * weight, axis=-1, keepdims=True) < 0, -1.0, 1.0)
        homography = homography * side[..., None]
        cosine = cosine * side
        squared = np.clip(2.0 - 2.0 * cosine, 0.0, 4.0)
        scale = 4.0 * _weighted_median(squared, weight) + 1e-16
        robust = weight / (1.0 + squared / scale[..., None]) ** 2
    homography = homography * squeeze[..., :, None]  # back to unscaled rays
    homography = np.einsum("...ji,...jk,...kl->...il", towards, homography, unscale)
    rotation, translation = _decompose(homography)
    facing = _facing_poses(points, rays, weight)
    finite = np.isfinite(rotation).all(axis=(-2, -1)) & np.isfinite(translation).all(axis=-1)
    good = np.asarray(determined & finite)
    return (
        np.where(good[..., None, None], rotation, facing[0]),
        np.where(good[..., None], translation, facing[1]),
    )


def mirrored_poses(rotation: np.ndarray, translation: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The second pose that explains almost the same image of a small flat board: depths turned over about `middle`.

    `middle` (..., 3) is the board's centre, target frame. The normal is reflected about the line of sight to it
    (Schweighofer and Pinz, "Robust pose estimation from a planar target", PAMI 2006).
    """
    centre = np.einsum("...ij,...j->...i", rotation, middle) + translation
    sight = centre / np.maximum(np.linalg.norm(centre, axis=-1, keepdims=True), 1e-300)
    reflect = np.eye(3) - 2.0 * sight[..., :, None] * sight[..., None, :]
    mirrored = reflect @ rotation * np.array([1.0, 1.0, -1.0])
    return mirrored, centre - np.einsum("...ij,...j->...i", mirrored, middle)


def rotations(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    hat = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)
    first = np.where(small, 1.0, np.sin(safe) / safe)
    second = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    return np.eye(3) + first * hat + second * (hat @ hat)


def _centred_rays(rays: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rotation (..., 3, 3) that turns the mean ray to the z axis, the scale (..., 3) that undoes a stretch across
    it, and the rays so turned, stretched to about 45 degrees of spread, and normalised.

    Without it a narrow view's homography is too ill-conditioned for normal equations.
    """
    mean = np.sum(rays * weight[..., None], axis=-2)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-12)
    helper = np.where(np.abs(mean[..., :1]) < 0.7, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    first = np.cross(helper, mean)
    first = first / np.maximum(np.linalg.norm(first, axis=-1, keepdims=True), 1e-12)
    towards = np.stack([first, np.cross(mean, first), mean], axis=-2)
    local = np.einsum("...ij,...nj->...ni", towards, rays)
    spread2 = np.sum(np.sum(local[..., :2] ** 2, axis=-1) * weight, axis=-1) / np.maximum(weight.sum(axis=-1), 1e-12)
    scale = np.clip(np.sqrt(spread2), 1e-4, 1.0)
    squeeze = np.stack([scale, scale, np.ones_like(scale)], axis=-1)
    local = local / squeeze[..., None, :]
    return towards, squeeze, local / np.linalg.norm(local, axis=-1, keepdims=True)


def _centred_plane(points: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (..., N, 3) as (x, y, 1) with mean zero and unit spread, and the matrix (..., 3, 3) that does it."""
    total = np.maximum(weight.sum(axis=-1), 1e-12)[..., None]
    mean = np.sum(points[..., :2] * weight[..., None], axis=-2) / total
    offset = points[..., :2] - mean[..., None, :]
    spread = np.sqrt(np.sum(offset**2 * weight[..., None], axis=(-2, -1)) / total[..., 0])
    spread = np.maximum(spread, 1e-12)
    plane = np.concatenate([offset / spread[..., None, None], np.ones((*offset.shape[:-1], 1))], axis=-1)
    matrix = np.zeros((*spread.shape, 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1.0 / spread
    matrix[..., :2, 2] = -mean / spread[..., None]
    matrix[..., 2, 2] = 1.0
    return plane, matrix


def _linear_homography(across: np.ndarray, products: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H (..., 3, 3) that minimises the sum of |ray x H p|^2, and whether it is the only one (...)."""
    shape = weight.shape[:-1]
    gram = np.swapaxes(across * weight[..., None], -1, -2) @ products  # [(i j), (k l)]
    gram = gram.reshape(*shape, 3, 3, 3, 3).swapaxes(-3, -2).reshape(*shape, 9, 9)  # [(i k), (j l)]
    gram = np.where(np.isfinite(gram), gram, 0.0)
    values, vectors = np.linalg.eigh(gram)
    return vectors[..., 0].reshape(*shape, 3, 3), values[..., 1] > 1e-12 * np.maximum(values[..., -1], 1e-300)


def _decompose(homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest rotation and the translation of H ~ [r1 r2 t]."""
    with np.errstate(all="ignore"):
        columns = homography[..., :2]
        # The nearest matrix with orthonormal columns, C (C'C)^(-1/2), the root of a 2 x 2 matrix in closed form.
        gram = np.swapaxes(columns, -1, -2) @ columns
        root_determinant = np.sqrt(np.maximum(np.linalg.det(gram), 1e-300))
        trace = gram[..., 0, 0] + gram[..., 1, 1]
        root = gram + root_determinant[..., None, None] * np.eye(2)
        root = root / np.sqrt(trace + 2.0 * root_determinant)[..., None, None]
        adjugate = np.stack([root[..., 1, 1], -root[..., 0, 1], -root[..., 1, 0], root[..., 0, 0]], axis=-1)
        inverse = adjugate.reshape(root.shape) / root_determinant[..., None, None]
        axes = columns @ inverse
        scale = np.sum(axes * columns, axis=(-2, -1)) / 2.0
        third = np.cross(axes[..., 0], axes[..., 1])
        rotation = np.concatenate([axes, third[..., None]], axis=-1)
        return rotation, homography[..., 2] / scale[..., None]


def _facing_poses(points: np.ndarray, rays: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A board that faces the camera along its mean ray, as far away as its angular size says."""
    total = np.maximum(weight.sum(axis=-1), 1e-12)[..., None]
    mean = np.sum(points * weight[..., None], axis=-2) / total
    size = np.sqrt(np.sum(np.sum((points - mean[..., None, :]) ** 2, axis=-1) * weight, axis=-1) / total[..., 0])
    sight = np.sum(rays * weight[..., None], axis=-2) / total
    sight = sight / np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-12)
    spread2 = np.sum(np.sum(np.cross(rays, sight[..., None, :]) ** 2, axis=-1) * weight, axis=-1) / total[..., 0]
    distance = size / np.sqrt(np.maximum(spread2, 1e-8))
    up = np.where(np.abs(sight[..., 1:2]) < 0.9, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    right = np.cross(up, -sight)
    right = right / np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 1e-12)
    rotation = np.stack([right, np.cross(-sight, right), -sight], axis=-1)
    return rotation, sight * distance[..., None] - np.einsum("...ij,...j->...i", rotation, mean)


def _weighted_median(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Median over the last axis of the values whose weight is not zero."""
    ordered = np.sort(np.where(weight > 0, values, np.inf), axis=-1)
    count = np.maximum((weight > 0).sum(axis=-1), 1)
    return np.take_along_axis(ordered, (count[..., None] // 2).clip(max=values.shape[-1] - 1), axis=-1)[..., 0]
