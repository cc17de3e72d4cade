"""Images of a planar pattern through any camera model, antialiased in closed form."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int32

from jaxcal.cameras import CameraModel
from jaxcal.programs import stored_jit
from jaxcal.simulation.pattern import BLACK, Pattern

# The pixel's own area blurs like a Gaussian of this variance (px^2).
_PIXEL_VARIANCE = 1.0 / 12.0
# Gauss-Hermite nodes for a standard normal.
_NODES = ((-np.sqrt(3.0), 1.0 / 6.0), (0.0, 2.0 / 3.0), (np.sqrt(3.0), 1.0 / 6.0))
_FAR = 1e6  # metres; where the background ends
_HORIZON_PX = 5.0  # rays that close to the plane's horizon see the background
_COARSE_PX = 8  # spacing of the grid from which rays are interpolated
_NEWTON_STEPS = 3


class PixelRays(NamedTuple):
    """Rays of some pixels: `ray` (3, N) of unit length, `per_pixel` (3, 2, N) their change per pixel.

    Pixels run along the last axis, so that compiled loops read them in a row.
    """

    ray: Float32[Array, "3 n"]
    per_pixel: Float32[Array, "3 2 n"]


class Lines(NamedTuple):
    """Lines of a pattern along one axis, ends of the background included, and a table to find intervals by.

    Bin b of the table starts at `start` + b / `bins_per_metre` and holds at most one line; `first` (B,) is the
    interval in which it starts.
    """

    at: Float32[Array, " n"]
    start: Float32[Array, ""]
    bins_per_metre: Float32[Array, ""]
    first: Int32[Array, " b"]


class Discs(NamedTuple):
    """Equal discs on L rectangular lattices: `origin`, `pitch` and highest number `last`, each (L, 2) for x and y."""

    origin: Float32[Array, "lattices 2"]
    pitch: Float32[Array, "lattices 2"]
    last: Float32[Array, "lattices 2"]
    radius: Float32[Array, " lattices"]


class Surface(NamedTuple):
    """A pattern made ready for rendering: its lines, the reflectance of each cell's 3 x 3 neighbourhood, its discs."""

    x: Lines
    y: Lines
    neighbours: Float32[Array, "cells 9"]
    discs: Discs


def surface_of(pattern: Pattern) -> Surface:
    """Prepare a pattern for `render`."""
    padded = np.pad(pattern.reflectance, 2, constant_values=pattern.background)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    neighbours = jnp.asarray(windows.reshape(-1, 9), dtype=jnp.float32)
    return Surface(_lines(pattern.x_lines), _lines(pattern.y_lines), neighbours, _discs(pattern))


def _discs(pattern: Pattern) -> Discs:
    origin, pitch, last = (
        np.array([getattr(d, name) for d in pattern.discs], np.float32).reshape(-1, 2)
        for name in ("origin", "pitch", "count")
    )
    radius = np.array([disc.radius for disc in pattern.discs], np.float32)
    return Discs(*(jnp.asarray(values) for values in (origin, pitch, last - 1.0, radius)))


def _lines(inner: np.ndarray) -> Lines:
    bins_per_metre = 1.01 / np.min(np.diff(inner))
    start = inner[0] - 0.5 / bins_per_metre
    bins = start + np.arange(int((inner[-1] - start) * bins_per_metre) + 3) / bins_per_metre
    at, start, rate = (
        jnp.asarray(v, dtype=jnp.float32) for v in (np.concatenate([[-_FAR], inner, [_FAR]]), start, bins_per_metre)
    )
    return Lines(at, start, rate, jnp.asarray(np.searchsorted(inner, bins, side="right"), dtype=jnp.int32))


def pixel_rays(model: CameraModel, image_size: tuple[int, int]) -> PixelRays:
    """Rays of all pixels of a camera, row by row. Pixels outside the lens' domain get a zero ray: background.

    The model's own unprojection serves a coarse grid; rays interpolated from it are refined by Newton's method.
    """
    width, height = image_size
    v, u = np.mgrid[:height, :width]
    nodes = _COARSE_PX * np.stack(np.meshgrid(np.arange(width // _COARSE_PX + 2), np.arange(height // _COARSE_PX + 2)))
    coarse = np.asarray(model.unproject(jnp.asarray(np.moveaxis(nodes, 0, -1), dtype=jnp.float64)))
    (i, down), (j, right) = np.divmod(v, _COARSE_PX), np.divmod(u, _COARSE_PX)
    down, right = down[..., None] / _COARSE_PX, right[..., None] / _COARSE_PX
    upper = (1.0 - right) * coarse[i, j] + right * coarse[i, j + 1]
    lower = (1.0 - right) * coarse[i + 1, j] + right * coarse[i + 1, j + 1]
    start = ((1.0 - down) * upper + down * lower).reshape(-1, 3)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    return _refine_rays(model, jnp.asarray(pixels), jnp.asarray(start))


@stored_jit
def _refine_rays(model: CameraModel, pixels: Float[Array, "n 2"], start: Float[Array, "n 3"]) -> PixelRays:
    def inverse(ray: Float[Array, "3"]) -> Float[Array, "3 2"]:
        """Change of the ray per pixel: the least one, orthogonal to the ray, which the projection does not see."""
        jacobian = jax.jacfwd(model.project)(ray)
        gram = jacobian @ jacobian.T
        adjugate = jnp.array([[gram[1, 1], -gram[0, 1]], [-gram[1, 0], gram[0, 0]]])
        return jacobian.T @ adjugate / (gram[0, 0] * gram[1, 1] - gram[0, 1] * gram[1, 0])

    def refined(pixel: Float[Array, "2"], ray: Float[Array, "3"]) -> tuple[Array, Array]:
        for _ in range(_NEWTON_STEPS):
            ray = ray - inverse(ray) @ (model.project(ray) - pixel)
            ray = ray / jnp.linalg.norm(ray)
        found = jnp.linalg.norm(model.project(ray) - pixel) < 1e-4
        valid = found & model.is_valid(ray)
        return jnp.where(valid, ray, 0.0), jnp.where(valid, inverse(ray), 0.0)

    rays, per_pixel = jax.vmap(refined)(pixels, start)
    return PixelRays(rays.T.astype(jnp.float32), jnp.moveaxis(per_pixel, 0, -1).astype(jnp.float32))


def plane_from_camera(T_cam_target: np.ndarray) -> np.ndarray:
    """Matrices (K, 3, 3) that map a ray to (X, Y, 1) / depth on the target plane, for poses (K, 4, 4).

    Zero for a camera behind the board, which sees the background only.
    """
    camera_from_plane = T_cam_target[:, :3][:, :, [0, 1, 3]]
    from_the_front = np.linalg.det(camera_from_plane) < 0.0
    return (np.linalg.inv(camera_from_plane) * from_the_front[:, None, None]).astype(np.float32)


class _Footprint(NamedTuple):
    """Where pixels look on the plane: position (m), its standard deviation per axis (m), and their correlation."""

    x: Array
    y: Array
    sigma_x: Array
    sigma_y: Array
    correlation: Array


def _footprint(rays: PixelRays, matrix: Float32[Array, "3 3"], sigma_px: float | Array) -> _Footprint:
    """Ray-plane intersection, with the first-order image of a Gaussian of `sigma_px` in the image."""

    # Written out by component: a contraction over axes of length 3 would be several times slower here.
    def transform(column: Array) -> list[Array]:
        return [matrix[i, 0] * column[0] + matrix[i, 1] * column[1] + matrix[i, 2] * column[2] for i in range(3)]

    plane_x, plane_y, plane_w = transform(rays.ray)
    (ux, uy, uw), (vx, vy, vw) = transform(rays.per_pixel[:, 0]), transform(rays.per_pixel[:, 1])
    # Rays that miss the plane, or meet it near its horizon where a first order says nothing, see the background.
    ahead = plane_w > _HORIZON_PX * jnp.sqrt(uw * uw + vw * vw)
    depth = 1.0 / jnp.where(ahead, plane_w, 1.0)
    x, y = jnp.where(ahead, plane_x * depth, 0.5 * _FAR), jnp.where(ahead, plane_y * depth, 0.5 * _FAR)
    xu, xv = (ux - x * uw) * depth, (vx - x * vw) * depth
    yu, yv = (uy - y * uw) * depth, (vy - y * vw) * depth
    length_x, length_y = jnp.sqrt(xu * xu + xv * xv) + 1e-12, jnp.sqrt(yu * yu + yv * yv) + 1e-12
    correlation = (xu * yu + xv * yv) / (length_x * length_y)
    sigma_x, sigma_y = (jnp.where(ahead, sigma_px * length, 1.0) for length in (length_x, length_y))
    return _Footprint(x, y, sigma_x, sigma_y, jnp.where(ahead, correlation, 0.0))


def _cell(lines: Lines, value: Array) -> tuple[Array, Array, Array]:
    """Index of the interval of `lines` that holds each value, and the interval's two ends."""
    # Clipped as a float: far values do not fit into an integer.
    place = jnp.clip((value - lines.start) * lines.bins_per_metre, 0.0, lines.first.size - 1.0)
    index = lines.first[place.astype(jnp.int32)]
    index = index + (value >= lines.at[index + 1])
    return index, lines.at[index], lines.at[index + 1]


def _weights(low: Array, high: Array, value: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Shares of a normal distribution below, within and above an interval."""
    scale = np.float32(np.sqrt(0.5)) / sigma
    below = 0.5 * (1.0 + jax.lax.erf((low - value) * scale))
    above = 0.5 * (1.0 + jax.lax.erf((value - high) * scale))
    return below, 1.0 - below - above, above


def _shade(
    rays: PixelRays, matrix: Float32[Array, "3 3"], surface: Surface, sigma_px: float | Array
) -> Float32[Array, " n"]:
    """Mean reflectance under each pixel's Gaussian footprint.

    The footprint's two coordinates are correlated; given one shared component they are independent, and the mean is
    a product of one-dimensional ones (normal shares of the cell and its neighbours). The shared component is
    integrated by Gauss-Hermite quadrature. Exact as long as the footprint is smaller than the neighbouring cells.
    """
    at = _footprint(rays, matrix, sigma_px)
    column, x_low, x_high = _cell(surface.x, at.x)
    row, y_low, y_high = _cell(surface.y, at.y)
    # The barrier keeps the compiler from gathering anew for each of the uses below.
    near = jax.lax.optimization_barrier(surface.neighbours[row * (surface.x.at.size - 1) + column].T)
    shared = jnp.abs(at.correlation)
    alone, common_x = jnp.sqrt(jnp.maximum(1.0 - shared, 1e-3)), jnp.sqrt(shared)
    common_y = common_x * jnp.sign(at.correlation)
    total = jnp.zeros_like(at.x)
    for node, weight in _NODES:
        x = at.x + np.float32(node) * common_x * at.sigma_x
        y = at.y + np.float32(node) * common_y * at.sigma_y
        wx = _weights(x_low, x_high, x, alone * at.sigma_x)
        wy = _weights(y_low, y_high, y, alone * at.sigma_y)
        lines = [wx[0] * near[3 * k] + wx[1] * near[3 * k + 1] + wx[2] * near[3 * k + 2] for k in range(3)]
        total = total + np.float32(weight) * (wy[0] * lines[0] + wy[1] * lines[1] + wy[2] * lines[2])
    return total + (np.float32(BLACK) - total) * _disc_share(at, surface.discs) if surface.discs.radius.size else total


class _Rim(NamedTuple):
    """How far from the rim of the nearest disc of a lattice each pixel looks.

    `outside` (m) is the signed distance, and `sigma` (m) the footprint's standard deviation, both across the rim;
    `along` (m) is the standard deviation along it.
    """

    outside: Array
    sigma: Array
    along: Array


def _rim(at: _Footprint, discs: Discs, lattice: int) -> _Rim:
    """The rim of the nearest disc of one lattice."""
    origin, pitch, last = discs.origin[lattice], discs.pitch[lattice], discs.last[lattice]
    column = jnp.clip(jnp.round((at.x - origin[0]) / pitch[0]), 0.0, last[0])
    row = jnp.clip(jnp.round((at.y - origin[1]) / pitch[1]), 0.0, last[1])
    dx, dy = at.x - origin[0] - column * pitch[0], at.y - origin[1] - row * pitch[1]
    distance = jnp.sqrt(dx * dx + dy * dy) + 1e-9
    nx, ny = dx / distance * at.sigma_x, dy / distance * at.sigma_y
    tx, ty = -dy / distance * at.sigma_x, dx / distance * at.sigma_y
    sigma = jnp.sqrt(jnp.maximum(nx * nx + ny * ny + 2.0 * at.correlation * nx * ny, 1e-18))
    along = jnp.sqrt(jnp.maximum(tx * tx + ty * ty + 2.0 * at.correlation * tx * ty, 1e-18))
    return _Rim(distance - discs.radius[lattice], sigma, along)


def _disc_share(at: _Footprint, discs: Discs) -> Array:
    """The share of each footprint that lies on discs, to second order in the footprint's size over the radius."""
    share = jnp.zeros_like(at.x)
    for lattice in range(discs.radius.size):
        rim = _rim(at, discs, lattice)
        # The rim curves towards the disc: over the footprint's length along it, by this much on average.
        from_centre = jnp.maximum(rim.outside + discs.radius[lattice], 0.5 * discs.radius[lattice])
        curved = rim.outside + 0.5 * rim.along * rim.along / from_centre
        share = share + 0.5 * (1.0 - jax.lax.erf(curved / (np.float32(np.sqrt(2.0)) * rim.sigma)))
    return share


def blur_px(psf_sigma_px: float) -> float:
    """Standard deviation of lens blur and pixel area together, px."""
    return float(np.sqrt(psf_sigma_px**2 + _PIXEL_VARIANCE))


@jax.jit
def render(
    rays: PixelRays, matrices: Float32[Array, "k 3 3"], surface: Surface, blur: float | Float[Array, ""]
) -> Float32[Array, "k n"]:
    """Linear intensities (K, N) of N pixels at K poses; `matrices` from `plane_from_camera`, `blur` from `blur_px`."""
    sigma = jnp.asarray(blur, dtype=jnp.float32)
    return jax.lax.map(lambda matrix: _shade(rays, matrix, surface, sigma), matrices)


@jax.jit
def render_some(
    rays: PixelRays,
    chosen: Int32[Array, " m"],
    matrices: Float32[Array, "k 3 3"],
    surface: Surface,
    blur: float | Float[Array, ""],
) -> Float32[Array, "k m"]:
    """`render` for the pixels with indices `chosen` (M,)."""
    return render(PixelRays(rays.ray[:, chosen], rays.per_pixel[:, :, chosen]), matrices, surface, blur)


@jax.jit
def near_edges(
    rays: PixelRays, matrix: Float32[Array, "3 3"], surface: Surface, band_px: float | Float[Array, ""]
) -> Bool[Array, " n"]:
    """Which of N pixels lie within `band_px` of a line of the pattern, seen from one pose."""
    at = _footprint(rays, matrix, 1.0)
    band_x, band_y = band_px * at.sigma_x, band_px * at.sigma_y
    _, x_low, x_high = _cell(surface.x, at.x)
    _, y_low, y_high = _cell(surface.y, at.y)
    close_x = jnp.minimum(at.x - x_low, x_high - at.x) < band_x
    close_y = jnp.minimum(at.y - y_low, y_high - at.y) < band_y
    inside_x = (at.x > surface.x.at[1] - band_x) & (at.x < surface.x.at[-2] + band_x)
    inside_y = (at.y > surface.y.at[1] - band_y) & (at.y < surface.y.at[-2] + band_y)
    close = close_x | close_y
    for lattice in range(surface.discs.radius.size):
        rim = _rim(at, surface.discs, lattice)
        close = close | (jnp.abs(rim.outside) < band_px * rim.sigma)
    return inside_x & inside_y & close
