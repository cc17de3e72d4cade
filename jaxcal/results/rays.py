"""Rays of a lens through pixels, by one compiled program for all that ask for them."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras import CameraModel
from jaxcal.programs import stored_jit

# A ray that projects further than this from its pixel (px) is not the pixel's: it lies outside the lens's domain.
_MISSED_PX = 1e-3
# Numbers of pixels are rounded up to a multiple of this: tracing an unprojection takes longer than doing it.
_STEP = 2560


@dataclass(frozen=True)
class Look:
    """Unit `rays` (K, 3) of a lens through pixels, and whether each is its pixel's, in the lens's domain, `valid` (K,);
    and the lens near its axis, as `CameraModel.paraxial`: pixels per radian (2, 2), and the axis' pixel (2,)."""

    rays: np.ndarray
    valid: np.ndarray
    scale: np.ndarray
    centre: np.ndarray


def rays_through(model: CameraModel, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays (K, 3) of a lens through pixels (K, 2), and whether each is its pixel's, in the lens's domain (K,)."""
    look = look_through(model, pixels)
    return look.rays, look.valid


def look_through(model: CameraModel, pixels: np.ndarray) -> Look:
    """How a lens looks through pixels (K, 2)."""
    count = -(-max(len(pixels), 1) // _STEP) * _STEP
    padded = np.pad(np.asarray(pixels, dtype=np.float64), ((0, count - len(pixels)), (0, 0)), mode="edge")
    rays, valid, scale, centre = (np.asarray(part) for part in _look_through(model, jax.device_put(padded)))
    return Look(rays[: len(pixels)], valid[: len(pixels)], scale, centre)


@stored_jit
def _look_through(model: CameraModel, pixels: Float[Array, "K 2"]) -> tuple[Array, Array, Array, Array]:
    rays = model.unproject(pixels)
    missed = jnp.linalg.norm(model.project(rays) - pixels, axis=-1)
    return rays, jax.vmap(model.is_valid)(rays) & (missed < _MISSED_PX), *model.paraxial()
