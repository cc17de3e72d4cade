"""A lens for all lenses: the enhanced unified camera model on whole batches of hypotheses, in closed form.

Two shape parameters beside the focal length take it from a narrow lens to one that sees more than 190 degrees, near
enough to any real lens to find the board's poses and to start any other model from (Khomutenko, Garcia and Martinet,
"An enhanced unified camera model", RA-L 2016; domain after Usenko, Demmel and Cremers, "The double sphere camera
model", 3DV 2018). Plain numpy: nothing needs to be compiled.

A hypothesis is a row [log f, log(fx / fy), cx, cy, a, log beta] with alpha = 1 - exp(-a), so that every real number is
allowed: alpha < 1, zero for a pinhole, negative for a pincushion. fx = f sqrt(fx / fy), fy = f / sqrt(fx / fy).
"""

from typing import NamedTuple

import numpy as np

SIZE = 6
_LOWEST = np.array([-2.0, -1.0, -1e6, -1e6, -4.0, -10.0])
_HIGHEST = np.array([20.0, 1.0, 1e6, 1e6, 15.0, 10.0])
# Half fields of view (degrees) tried at the outermost corners, with the alphas that lenses of that kind have.
_SWEEP = (
    (3.0, (0.0,)),
    (7.0, (0.0,)),
    (14.0, (0.0,)),
    (24.0, (0.0,)),
    (36.0, (0.0, 0.5)),
    (50.0, (0.0, 0.6)),
    (64.0, (0.35, 0.65)),
    (80.0, (0.5, 0.7)),
    (96.0, (0.58, 0.75)),
)


class Projection(NamedTuple):
    """Pixels (B, F, 2, N), Jacobians by the point (B, F, 2, 3, N) and by the lens (B, F, n, 2, N), and the domain.

    `valid` (B, F, N) tells where the numbers mean anything; all of them are finite.
    """

    pixels: np.ndarray
    by_point: np.ndarray
    by_lens: np.ndarray | None
    valid: np.ndarray


class GenericLens:
    """The enhanced unified model as the lens of a batch of fits (see `first_fit.Lens`)."""

    def project(self, parameters: np.ndarray, points: np.ndarray, with_lens: bool) -> Projection:
        """Project points (B, F, 3, N), camera frame, through lenses (B, 6)."""
        fx, fy, cx, cy, alpha, beta = _unpack(parameters)
        x, y, z = points[..., 0, :], points[..., 1, :], points[..., 2, :]
        radius2 = x * x + y * y
        d = np.sqrt(beta * radius2 + z * z) + 1e-300
        denominator = alpha * d + (1.0 - alpha) * z
        # Beyond the fold (alpha > 1/2) two directions share a pixel; at a vanishing denominator it lies at infinity.
        limit = np.where(alpha > 0.5, (1.0 - alpha) / np.maximum(alpha, 0.5), alpha / np.maximum(1.0 - alpha, 0.5))
        valid = (z > -limit * d) & (denominator > 1e-3 * d)
        inverse = 1.0 / np.where(valid, denominator, d)
        mx, my = x * inverse, y * inverse
        pixels = np.stack([fx * mx + cx, fy * my + cy], axis=-2)

        slope = alpha * beta / d * inverse
        along = (alpha * z / d + 1.0 - alpha) * inverse
        by_point = np.empty((*points.shape[:-2], 2, 3, points.shape[-1]))
        by_point[..., 0, 0, :] = fx * (inverse - mx * slope * x)
        by_point[..., 0, 1, :] = -fx * mx * slope * y
        by_point[..., 0, 2, :] = -fx * mx * along
        by_point[..., 1, 0, :] = -fy * my * slope * x
        by_point[..., 1, 1, :] = fy * (inverse - my * slope * y)
        by_point[..., 1, 2, :] = -fy * my * along
        if not with_lens:
            return Projection(pixels, by_point, None, valid)

        by_lens = np.zeros((*points.shape[:-2], SIZE, 2, points.shape[-1]))
        u, v = fx * mx, fy * my
        by_alpha = -(d - z) * inverse * (1.0 - alpha)
        by_beta = -0.5 * alpha * beta * radius2 / d * inverse
        by_lens[..., 0, 0, :], by_lens[..., 0, 1, :] = u, v
        by_lens[..., 1, 0, :], by_lens[..., 1, 1, :] = 0.5 * u, -0.5 * v
        by_lens[..., 2, 0, :] = 1.0
        by_lens[..., 3, 1, :] = 1.0
        by_lens[..., 4, 0, :], by_lens[..., 4, 1, :] = u * by_alpha, v * by_alpha
        by_lens[..., 5, 0, :], by_lens[..., 5, 1, :] = u * by_beta, v * by_beta
        return Projection(pixels, by_point, by_lens, valid)


def _unpack(parameters: np.ndarray) -> tuple[np.ndarray, ...]:
    """fx, fy, cx, cy, alpha, beta, each (B, 1, 1)."""
    # Trial steps that go astray stay within what doubles hold.
    bounded = np.clip(parameters, _LOWEST, _HIGHEST)
    log_f, log_aspect, cx, cy, a, log_beta = (bounded[:, i, None, None] for i in range(SIZE))
    return (
        np.exp(log_f + 0.5 * log_aspect),
        np.exp(log_f - 0.5 * log_aspect),
        cx,
        cy,
        1.0 - np.exp(-a),
        np.exp(log_beta),
    )


def unproject(parameters: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays (B, F, N, 3) of pixels (F, N, 2) through lenses (B, 6), and where they exist (B, F, N).

    Khomutenko et al. 2016, eq. 7. A pixel outside the lens' image circle gets the ray at its rim.
    """
    fx, fy, cx, cy, alpha, beta = _unpack(parameters)
    mx, my = (pixels[None, ..., 0] - cx) / fx, (pixels[None, ..., 1] - cy) / fy
    radius2 = beta * (mx * mx + my * my)
    under_root = 1.0 - (2.0 * alpha - 1.0) * radius2
    valid = (under_root > 0.0) & ((alpha > 0.0) | (alpha**2 * radius2 < 1.0))
    denominator = alpha * np.sqrt(np.maximum(under_root, 0.0)) + (1.0 - alpha)
    mz = np.where(valid, (1.0 - alpha**2 * radius2) / np.where(valid, denominator, 1.0), 0.0)
    rays = np.stack([mx, my, mz], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True), valid


def hypotheses(pixels: np.ndarray, image_size: tuple[int, int], focal: float | None) -> np.ndarray:
    """Lenses (B, 6) to try for corners (M, 2): a sweep over fields of view and shapes, and a focal length if known."""
    centre = (np.array(image_size) - 1.0) / 2.0
    radius = float(np.quantile(np.linalg.norm(pixels - centre, axis=1), 0.98))
    radius = max(radius, 0.05 * max(image_size))
    rows = []
    for degrees, alphas in _SWEEP:
        sine, cosine = np.sin(np.deg2rad(degrees)), np.cos(np.deg2rad(degrees))
        for alpha in alphas:
            rows.append([np.log(radius * (alpha + (1.0 - alpha) * cosine) / sine), alpha])
    if focal is not None:
        rows.append([np.log(focal), 0.0])
    out = np.zeros((len(rows), SIZE))
    out[:, 0] = [row[0] for row in rows]
    out[:, 2:4] = centre
    out[:, 4] = [-np.log(1.0 - row[1]) for row in rows]
    return out


def weak_prior(image_size: tuple[int, int], noise_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and information (6,) of what lenses are commonly like, to decide what the corners leave open.

    In units of costs of residuals in pixels, hence scaled by the variance of the corners' noise.
    """
    width, height = image_size
    size = float(max(image_size))
    mean = np.array([np.log(0.7 * size), 0.0, (width - 1) / 2.0, (height - 1) / 2.0, 0.3, 0.0])
    sigma = np.array([0.7, 0.03, 0.05 * size, 0.05 * size, 1.0, 0.7])
    return mean, (noise_px / sigma) ** 2


def half_field_of_view(parameters: np.ndarray, pixels: np.ndarray) -> float:
    """Angle (degrees) from the axis to the outermost of the corners (M, 2) through one lens (6,)."""
    rays, _ = unproject(parameters[None], pixels[None])
    return float(np.rad2deg(np.max(np.arccos(np.clip(rays[0, 0, :, 2], -1.0, 1.0)))))
