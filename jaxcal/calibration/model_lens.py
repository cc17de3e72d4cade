"""Any camera model as the lens of a small fit: compiled programs of two fixed sizes serve all its calls."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxcal.calibration.generic_lens import Projection
from jaxcal.calibration.pixel_derivatives import pixel_derivatives
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
        flat = points.swapaxes(0, 1).reshape(3, -1)
        # Programs take numpy arrays as they are, which is quicker than to put them on the device first.
        program = _with_lens if with_lens else _without_lens
        outputs = [program(self._template, parameters, chunk) for chunk in _chunks(flat, fill=1.0)]

        def joined(parts: list[list[Array]]) -> np.ndarray:
            """The parts (M,) or (n, M) of all chunks one below the other, (F, rows, N)."""
            rows = _join([_join([np.atleast_2d(part) for part in chunk], axis=0) for chunk in parts], axis=1)
            rows = rows[:, : flat.shape[1]].reshape(len(rows), count, corners)
            return np.ascontiguousarray(rows.swapaxes(0, 1))

        pixels = joined([[u, v] for u, v in (output.pixel for output in outputs)])
        by_point = joined([[*of_u, *of_v] for of_u, of_v in (output.by_point for output in outputs)])
        valid = joined([[output.valid] for output in outputs])[:, 0]
        by_lens = None
        if with_lens:
            of_u, of_v = (joined([list(output.by_lens[c]) for output in outputs]) for c in range(2))
            by_lens = np.stack([of_u, of_v], axis=2)
        return Projection(pixels, by_point.reshape(count, 2, 3, corners), by_lens, valid)


class _Outputs(NamedTuple):
    """Of points (M,): pixel, its derivatives by the point and by the lens, of u and of v, all finite; validity."""

    pixel: tuple[Array, Array]
    by_point: tuple[Sequence[Array], Sequence[Array]]
    by_lens: tuple[Sequence[Array], Sequence[Array]]
    valid: Array


def _join(arrays: list[np.ndarray], axis: int) -> np.ndarray:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays, axis=axis)


def _chunks(points: np.ndarray, fill: float) -> list[np.ndarray]:
    size = _CHUNK if points.shape[1] <= _LARGE_CHUNK // 2 else _LARGE_CHUNK
    padded = np.pad(points, [(0, 0), (0, -points.shape[1] % size)], constant_values=fill)
    return np.split(padded, max(padded.shape[1] // size, 1), axis=1)


@stored_jit
def _with_lens(template: CameraModel, parameters: Any, points: Any) -> _Outputs:
    """Pixels and derivatives of points (3, M)."""
    return _outputs(template, parameters, points, with_lens=True)


@stored_jit
def _without_lens(template: CameraModel, parameters: Any, points: Any) -> _Outputs:
    """As `_with_lens`, less the derivatives by the lens."""
    return _outputs(template, parameters, points, with_lens=False)


def _outputs(template: CameraModel, parameters: Array, points: Array, *, with_lens: bool) -> _Outputs:
    def one(point: Array) -> tuple:
        pixel, by_point, by_lens = zip(*pixel_derivatives(template, parameters, point), strict=True)
        return pixel, by_point, by_lens if with_lens else ((), ())

    parts = jax.vmap(one, in_axes=1, out_axes=-1)(jnp.asarray(points))
    # Whether a point lies in the model's domain is not asked: outside, models give pixels far away, and a domain that
    # ends where the coefficients say would be a wall in the way of the optimisation.
    valid = jnp.full(points.shape[1], True)
    for part in jax.tree.leaves(parts):
        valid = valid & jnp.isfinite(part).reshape(-1, points.shape[1]).all(axis=0)
    pixel, by_point, by_lens = jax.tree.map(lambda part: jnp.where(valid, part, 0.0), parts)
    return _Outputs(pixel, by_point, by_lens, valid)
