"""One camera model from another, or from rays and their pixels: conversion by re-fit, with the residual shown."""

import logging
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.registry import camera_model, model_name
from jaxcal.errors import CalibrationError
from jaxcal.programs import stored_jit

logger = logging.getLogger(__name__)

_GRID = (28, 20)  # pixels that stand for the image when none are given
_CHUNK = 512  # numbers of rays are rounded up to multiples of this: few programs
_STEPS = 100
_TOLERANCE = 1e-10
_PERFECT_PX = 1e-4  # a fit as good as this needs no other start
# Weight of rays outside the image, which steady a surface of knots where its model reaches beyond the image.
_OUTSIDE = 1e-2
# Those rays: places a side of a stereographic grid, and its half width, 2 tan(75 deg) for 150 degrees off the axis.
_SPHERE_GRID, _WIDEST_PLANE = 64, 7.46
# Models that end at 90 degrees are fitted up to here (deg): nearer to their rim one pixel outweighs the image.
_RIM_DEG, _PLANE_LIMIT_DEG = 91.0, 80.0


@dataclass(frozen=True)
class Refit:
    """A lens in the form of another model.

    `residual_px` (M, 2) is the new model's projection minus the old one's at `pixels` (M, 2), the places of the image
    where both have a ray; `share` is the part of the places asked for that these are.
    """

    model: CameraModel
    residual_px: np.ndarray
    pixels: np.ndarray
    share: float

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths, px."""
        return float(np.sqrt(np.mean(np.sum(self.residual_px**2, axis=1))))

    @property
    def max_px(self) -> float:
        """The longest residual, px."""
        return float(np.linalg.norm(self.residual_px, axis=1).max())


def refit(
    source: CameraModel,
    target: str | type[CameraModel],
    image_size: tuple[int, int],
    *,
    pixels: np.ndarray | None = None,
    max_angle: float | None = None,
) -> Refit:
    """The model of class (or name) `target` that is closest to a lens over its image, in the least-squares sense.

    `pixels` (M, 2) are the places compared, a regular grid over the image by default. Rays further than `max_angle`
    (rad) from the axis are left out; by default 80 degrees where the target ends at 90, else none. Left out, too, are
    places where the source has no ray and, afterwards, rays outside the target's domain: `Refit.share` tells.

    A model with a prior (the knots of a splined one) is also shown rays beyond the image, with little weight, so that
    its surface goes on smoothly; its other parameters keep the lens's central values.

    Raises CalibrationError when fewer places remain than the target has parameters (those with a prior not counted).
    """
    cls = camera_model(target) if isinstance(target, str) else target
    asked = _grid(image_size) if pixels is None else np.asarray(pixels, dtype=float).reshape(-1, 2)
    first = _central(source, cls, image_size)
    tied = np.asarray(first.regularisation()) > 0
    limit = (np.pi if tied.any() else _limit(cls, image_size)) if max_angle is None else max_angle
    rays, kept = _rays_of(source, asked)
    kept &= np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]) <= limit
    if tied.any():
        kept &= _valid(first, rays)
    needed = -(-int(np.sum(~tied)) // 2)
    if kept.sum() < needed:
        raise CalibrationError(
            f"{model_name(source)} cannot be refitted as {model_name(cls)}: {kept.sum()} of {len(asked)} places of the "
            f"image have a ray within {np.degrees(limit):.0f} degrees that both models can see; {needed} are needed. "
            "Choose a model with a wider field of view."
        )
    data, start = (rays[kept], asked[kept], np.ones(kept.sum())), None
    if tied.any():
        outside, far = _beyond_the_image(source, first, image_size)
        weight = np.append(data[2], np.full(len(outside), _OUTSIDE))
        data, start = (np.concatenate([data[0], outside]), np.concatenate([data[1], far]), weight), first
    model = _fit(cls, *data, image_size, start, _focal(source))
    seen = kept & _valid(model, rays)
    if not seen.any():
        raise CalibrationError(f"{model_name(source)} cannot be refitted as {model_name(cls)}: no ray is left in view.")
    residual = np.asarray(model.project(rays[seen])) - asked[seen]
    return Refit(model, residual, asked[seen], float(seen.sum()) / max(len(asked), 1))


def fit_rays(
    cls: type[CameraModel],
    rays: np.ndarray,
    pixels: np.ndarray,
    image_size: tuple[int, int],
    *,
    weight: np.ndarray | None = None,
    start: CameraModel | None = None,
) -> CameraModel:
    """The model of a class that brings rays (M, 3) of any length closest to their pixels (M, 2), by least squares.

    `weight` (M,) multiplies the squared residuals. Without `start` the class's own first models (`starts`) are tried,
    at the focal length that the rays near the axis have. Raises CalibrationError when the arrays do not go together.
    """
    rays, pixels = np.asarray(rays, dtype=float), np.asarray(pixels, dtype=float)
    if rays.ndim != 2 or rays.shape[1:] != (3,) or pixels.shape != (len(rays), 2) or not len(rays):
        raise CalibrationError(
            f"fit_rays: rays of shape {rays.shape}, pixels of shape {pixels.shape}; expected (M, 3) and (M, 2), M > 0."
        )
    weight = np.ones(len(rays)) if weight is None else np.asarray(weight, dtype=float)
    if cls.held:
        # Rays beyond a surface of knots would pull at its edge.
        first = cls.from_focal(1.0, image_size) if start is None else start
        weight = weight * _valid(first, rays)
    return _fit(cls, rays, pixels, weight, image_size, start, _focal_of_rays(rays, pixels, image_size))


# --- the fit ---------------------------------------------------------------------------------------------------------


def _fit(
    cls: type[CameraModel],
    rays: np.ndarray,
    pixels: np.ndarray,
    weight: np.ndarray,
    image_size: tuple[int, int],
    start: CameraModel | None,
    focal: float,
) -> CameraModel:
    """The best of the minima reached from each start."""
    starts = (start,) if start is not None else cls.starts(focal, image_size)
    padded = -(-len(rays) // _CHUNK) * _CHUNK - len(rays)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    data = (
        jnp.asarray(np.pad(unit, [(0, padded), (0, 0)], constant_values=1.0)),
        jnp.asarray(np.pad(pixels, [(0, padded), (0, 0)])),
        jnp.asarray(np.sqrt(np.pad(weight, (0, padded)))),
    )
    best: tuple[float, CameraModel] | None = None
    for first in starts:
        model, cost = _levenberg_marquardt(first, data)
        logger.debug("%s: cost %.4g from %s", cls.name, cost, np.asarray(first.parameters)[:8])
        if best is None or cost < best[0]:
            best = (cost, model)
        if best[0] < 0.5 * _PERFECT_PX**2 * weight.sum():
            break
    assert best is not None, "starts() gives at least one model"
    return best[1]


def _levenberg_marquardt(
    first: CameraModel, data: tuple[Float[Array, "M 3"], Float[Array, "M 2"], Float[Array, " M"]]
) -> tuple[CameraModel, float]:
    """Minimum of the weighted squares and of the model's own prior, from one start; damping by the diagonal.

    In a model with a prior only the parameters that have one are free; it draws to the start.
    """
    value = np.asarray(first.parameters)
    prior = np.asarray(first.regularisation())
    free = prior > 0 if prior.any() else np.ones(len(value), dtype=bool)
    # Knots enter linearly: full steps. The others would be thrown far off where the rays say little about them.
    origin, damping = value.copy(), 1e-12 if prior.any() else 1e-4
    raise_by = 2.0
    cost, gradient, normal = _equations(first, *data)
    for _ in range(_STEPS):
        matrix = (np.asarray(normal) + np.diag(prior))[np.ix_(free, free)]
        slope = (np.asarray(gradient) + prior * (value - origin))[free]
        scale = np.maximum(np.diag(matrix), 1e-12 * np.diag(matrix).max())
        step = np.zeros(len(value))
        step[free] = -np.linalg.solve(matrix + damping * np.diag(scale), slope)
        moved = value + step
        expected = -(slope @ step[free]) - 0.5 * step[free] @ matrix @ step[free]
        before = float(cost) + 0.5 * prior @ (value - origin) ** 2
        trial = _equations(first.with_parameters(moved), *data)
        after = float(trial[0]) + 0.5 * prior @ (moved - origin) ** 2
        if np.isfinite(after) and after < before:
            # Nielsen's rule: in a curved valley (xi against k1, say) a fixed factor has every second step refused.
            gain = (before - after) / max(expected, 1e-300)
            damping = max(damping * max(1.0 / 5.0, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-12)
            value, (cost, gradient, normal), raise_by = moved, trial, 2.0
        else:
            damping, raise_by = damping * raise_by, raise_by * 2.0
        if expected <= _TOLERANCE * before + 1e-20 or damping > 1e12:
            break
    return first.with_parameters(value), float(cost)


@stored_jit
def _equations(
    model: CameraModel, rays: Float[Array, "M 3"], pixels: Float[Array, "M 2"], root_weight: Float[Array, " M"]
) -> tuple[Float[Array, ""], Float[Array, " n"], Float[Array, "n n"]]:
    """Half the sum of squares, its gradient and Gauss-Newton Hessian by the parameters."""

    def residual(parameters: Float[Array, " n"], ray: Float[Array, "3"], pixel: Float[Array, "2"]) -> Array:
        return model.with_parameters(parameters).project(ray) - pixel

    parameters = model.parameters
    error = jax.vmap(residual, in_axes=(None, 0, 0))(parameters, rays, pixels) * root_weight[:, None]
    jacobian = (
        jax.vmap(jax.jacrev(residual), in_axes=(None, 0, 0))(parameters, rays, pixels) * root_weight[:, None, None]
    )
    rows, side = jacobian.reshape(-1, jacobian.shape[-1]), error.reshape(-1)
    return 0.5 * side @ side, rows.T @ side, rows.T @ rows


# --- rays ------------------------------------------------------------------------------------------------------------


def _grid(image_size: tuple[int, int]) -> np.ndarray:
    """Pixels (M, 2) on a regular grid from corner to corner of the image."""
    axes = [np.linspace(-0.5, size - 0.5, count) for size, count in zip(image_size, _GRID, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _rays_of(source: CameraModel, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays (M, 3) of a lens through pixels, and whether each is a ray of that pixel in the lens's domain (M,)."""
    padded = -(-len(pixels) // _CHUNK) * _CHUNK - len(pixels)
    rays, error, valid = _unprojected(source, jnp.asarray(np.pad(pixels, [(0, padded), (0, 0)], mode="edge")))
    count = len(pixels)
    return np.asarray(rays)[:count], np.asarray(valid)[:count] & (np.asarray(error)[:count] < 1e-3)


@stored_jit
def _unprojected(source: CameraModel, pixels: Float[Array, "M 2"]) -> tuple[Array, Array, Array]:
    rays = source.unproject(pixels)
    error = jnp.linalg.norm(source.project(rays) - pixels, axis=1)
    return rays, error, jax.vmap(source.is_valid)(rays)


@stored_jit
def _validity(model: CameraModel, rays: Float[Array, "M 3"]) -> Array:
    return jax.vmap(model.is_valid)(rays)


def _valid(model: CameraModel, rays: np.ndarray) -> np.ndarray:
    padded = -(-len(rays) // _CHUNK) * _CHUNK - len(rays)
    return np.asarray(_validity(model, jnp.asarray(np.pad(rays, [(0, padded), (0, 0)], mode="edge"))))[: len(rays)]


def _beyond_the_image(
    source: CameraModel, target: CameraModel, image_size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Rays within both models' domains, and their pixels up to half an image outside the image."""
    u = np.linspace(-1.0, 1.0, _SPHERE_GRID)
    plane = _WIDEST_PLANE * np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    square = np.sum(plane**2, axis=1) / 4.0
    rays = np.column_stack([plane, 1.0 - square]) / (1.0 + square)[:, None]
    rays = rays[_valid(source, rays) & _valid(target, rays)]
    pixels, size = np.asarray(source.project(rays)), np.asarray(image_size)
    near = np.all((pixels > -0.5 * size) & (pixels < 1.5 * size), axis=1)
    return rays[near], pixels[near]


def _focal(source: CameraModel) -> float:
    """Pixels per radian at the centre of the image."""
    scale = np.asarray(source.paraxial()[0])
    return float(np.sqrt(np.abs(np.linalg.det(scale))))


def _central(source: CameraModel, cls: type[CameraModel], image_size: tuple[int, int]) -> CameraModel:
    """The class's first model with the centre and the central focal lengths of a lens, where it names them so."""
    scale, centre = (np.asarray(part) for part in source.paraxial())
    first = cls.from_focal(_focal(source), image_size)
    value = np.array(first.parameters)
    if cls.projection_names[-4:] == ("fx", "fy", "cx", "cy") and cls.num_intrinsics == len(cls.projection_names):
        ratio = np.sqrt(abs(scale[0, 0] / scale[1, 1]))
        at = cls.num_intrinsics - 4
        value[at : at + 2] *= ratio, 1.0 / ratio
        value[at + 2 : at + 4] = centre
    return first.with_parameters(value)


def _limit(cls: type[CameraModel], image_size: tuple[int, int]) -> float:
    """Angle (rad) up to which a model is fitted by default."""
    edge = np.radians(_RIM_DEG)
    beyond = np.array([[np.sin(edge), 0.0, np.cos(edge)]])
    wide = any(_valid(start, beyond).all() for start in cls.starts(1.0, image_size))
    return np.pi if wide else float(np.radians(_PLANE_LIMIT_DEG))


def _focal_of_rays(rays: np.ndarray, pixels: np.ndarray, image_size: tuple[int, int]) -> float:
    """Pixels per radian: the median over the rays nearest to the axis."""
    angle = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    radius = np.linalg.norm(pixels - (np.asarray(image_size) - 1.0) / 2.0, axis=1)
    near = angle <= np.quantile(angle, 0.5)
    return float(max(np.median(radius[near] / np.maximum(angle[near], 1e-6)), 1.0))
