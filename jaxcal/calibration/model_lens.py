"""Any camera model as the lens of a small fit: compiled programs of two fixed sizes serve all its calls."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxcal.calibration.generic_lens import Projection
from jaxcal.cameras import CameraModel
from jaxcal.programs import stored_jit

# Points per call: large enough to vectorise, small enough that padding costs nothing; and where there are many.
_CHUNK, _LARGE_CHUNK = 4096, 32768


class ModelLens:
    """A camera model's class, as a `first_fit.Lens`; the model given only lends its shape."""

    def __init__(self, template: CameraModel) -> None:
        self._template = template

    def project(self, parameters: np.ndarray, points: np.ndarray, with_lens: bool) -> Projection:
        """Project points (B, F, 3, N), camera frame, through lenses (B, n)."""
        each = [self._project_one(*pair, with_lens) for pair in zip(parameters, points, strict=True)]
        by_lens = [one.by_lens for one in each if one.by_lens is not None]
        return Projection(
            np.stack([one.pixels for one in each]),
            np.stack([one.by_point for one in each]),
            np.stack(by_lens) if by_lens else None,
            np.stack([one.valid for one in each]),
        )

    def _project_one(self, parameters: np.ndarray, points: np.ndarray, with_lens: bool) -> Projection:
        count, corners = points.shape[0], points.shape[-1]
        flat = points.swapaxes(-1, -2).reshape(-1, 3)
        # Programs take numpy arrays as they are, which is quicker than to put them on the device first.
        program = _with_lens if with_lens else _without_lens
        outputs = [program(self._template, parameters, chunk) for chunk in _chunks(flat, fill=1.0)]

        def joined(part: int) -> np.ndarray:
            values = np.concatenate([np.asarray(output[part]) for output in outputs], axis=-1)[..., : len(flat)]
            values = values.reshape(*values.shape[:-1], count, corners)
            return np.ascontiguousarray(np.moveaxis(values, -2, 0))

        return Projection(joined(0), joined(1), joined(3) if with_lens else None, joined(2))


def _chunks(rows: np.ndarray, fill: float) -> list[np.ndarray]:
    size = _CHUNK if len(rows) <= _LARGE_CHUNK // 2 else _LARGE_CHUNK
    padded = np.pad(rows, [(0, -len(rows) % size), (0, 0)], constant_values=fill)
    return np.split(padded, max(len(padded) // size, 1))


def _pixel(template: CameraModel, parameters: Array, point: Array) -> Array:
    return template.with_parameters(parameters).project(point)


@stored_jit
def _with_lens(template: CameraModel, parameters: Any, points: Any) -> tuple[Array, Array, Array, Array]:
    """Pixels (2, M), Jacobian by the point (2, 3, M), validity (M), Jacobian by the lens (n, 2, M); all finite."""

    def one(point: Array) -> tuple[Array, Array, Array, Array]:
        pixel, pull = jax.vjp(lambda *at: _pixel(template, *at), parameters, point)
        by_lens, by_point = _pulled(pull)
        return _finite(pixel, by_point, by_lens.T)

    return jax.vmap(one, out_axes=-1)(points)


@stored_jit
def _without_lens(template: CameraModel, parameters: Any, points: Any) -> tuple[Array, Array, Array]:
    """As `_with_lens`, less the Jacobian by the lens."""

    def one(point: Array) -> tuple[Array, Array, Array]:
        pixel, pull = jax.vjp(lambda at: _pixel(template, parameters, at), point)
        (by_point,) = _pulled(pull)
        return _finite(pixel, by_point, jnp.zeros(0))[:3]

    return jax.vmap(one, out_axes=-1)(points)


def _pulled(pull: Callable[[Array], tuple[Array, ...]]) -> tuple[Array, ...]:
    """Jacobians of a pixel, coordinate by coordinate: twice as fast as `jacrev` with its batch of unit vectors."""
    rows = zip(pull(jnp.array([1.0, 0.0])), pull(jnp.array([0.0, 1.0])), strict=True)
    return tuple(jnp.stack(both) for both in rows)


def _finite(pixel: Array, by_point: Array, by_lens: Array) -> tuple[Array, Array, Array, Array]:
    """The same, and whether all is finite; zeros where it is not."""
    # Whether the point lies in the model's domain is not asked: outside, models give pixels far away, and a domain that
    # ends where the coefficients say would be a wall in the way of the optimisation.
    valid = jnp.array(True)
    for part in (pixel, by_point, by_lens):
        valid = valid & jnp.all(jnp.isfinite(part))
    return jnp.where(valid, pixel, 0.0), jnp.where(valid, by_point, 0.0), valid, jnp.where(valid, by_lens, 0.0)
