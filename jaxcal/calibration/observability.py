"""What a recording leaves open, in words, and what to record next; nothing to say of a good one."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.state import SharedLayout
from jaxcal.calibration.uncertainty import labels_of
from jaxcal.cameras import CameraModel
from jaxcal.programs import stored_jit

# Boards that hardly any view tilts by more than this (degrees, to the image plane) show the focal length badly.
_SMALL_TILT_DEG = 15.0
# ... if tilting every other view this far (degrees) would make it at least so many times better known.
_GOOD_TILT_DEG = 30.0
_WORTH_SAYING = 2.5
_MOST_VIEWS = 24
# Depths that differ by less than this factor are one distance.
_ONE_DISTANCE = 1.15
_FEW_VIEWS = 6
_FEW_SHARED = 5
# 1-sigma beyond which parameters are called weakly known: focal length and principal point relative to the focal
# length and to the image's width; rotations (rad), translations (m), time shifts (s).
_FOCAL_SIGMA, _CENTRE_SIGMA = 0.01, 0.02
_TURN_SIGMA, _SHIFT_SIGMA, _TIME_SIGMA = np.deg2rad(0.5), 0.02, 0.002
# So many times that, a sigma says nothing any more: the problem is not linear so far from the solution.
_UNKNOWN = 10.0
# Parts of a direction that count for less than this are not named.
_NAMED_PART = 0.25


@dataclass(frozen=True)
class Advice:
    """`sentences` for a person, and whether a lens is not known at all."""

    sentences: tuple[str, ...]
    lens_unknown: bool


@dataclass(frozen=True)
class _Seen:
    """What one camera saw: per view that takes part, the tilt of the board to the image plane (deg) and the depth (m)
    of its middle; and the corners in the image (M, 2)."""

    tilt_deg: np.ndarray
    depth_m: np.ndarray
    pixels: np.ndarray

    @property
    def largest_tilt_deg(self) -> float:
        """Nine in ten views are tilted by less."""
        return float(np.quantile(self.tilt_deg, 0.9))

    @property
    def one_distance(self) -> bool:
        return bool(self.depth_m.max() < _ONE_DISTANCE * max(self.depth_m.min(), 1e-9))


@dataclass(frozen=True)
class _Quantity:
    """Something with a physical meaning: its row (P,) by the shared coordinates, the 1-sigma (in the row's units) that
    would be weak, the factor and unit it is told in, and what kind it is."""

    name: str
    row: np.ndarray
    weak: float
    factor: float
    unit: str
    kind: str


def advice(
    names: Sequence[str],
    models: Sequence[CameraModel],
    layout: SharedLayout,
    covariance: np.ndarray,
    free: np.ndarray,
    cameras: Sequence[CameraFrames],
    kept: Sequence[np.ndarray],
    T_cam_target: Sequence[np.ndarray],
    target_points: np.ndarray,
    views: Sequence[np.ndarray] | None = None,
) -> Advice:
    """What the recording determines badly, which parameters that concerns, and what to record next.

    `covariance` (P, P) of the shared coordinates, of which `free` (P,) are estimated; `kept[c]` (F, N) the corners that
    took part, `T_cam_target[c]` (F, 4, 4), `target_points` (N, 3) m; `views[c]` (F,) the rig's view of each frame, for
    cameras that take pictures together. Empty for a good recording.
    """
    sentences: list[str] = []
    told: set[str] = set()
    with_imu = bool(free[layout.gravity].any())
    quantities = _quantities(names, models, layout, free, covariance, cameras)
    for c, (name, model) in enumerate(zip(names, models, strict=True)):
        if not kept[c].any():
            continue
        seen = _what_was_seen(cameras[c], kept[c], T_cam_target[c], target_points)
        of_lens = [q for q in quantities if q.kind == "lens" and q.name.startswith(f"{name} ")]
        weak = any(_sigma(q, covariance) > q.weak for q in of_lens)
        found = _few_views(name, seen, of_lens, covariance)
        if seen.largest_tilt_deg < _SMALL_TILT_DEG and (weak or not with_imu):
            places = cameras[c], kept[c], T_cam_target[c], target_points
            found += _hardly_tilted(name, model, seen, _tilting_helps(model, *places), of_lens, covariance)
        if found:
            told.add(name)
        sentences += found + _empty_parts(name, seen, cameras[c].detections.image_size)
    if views is not None:
        sentences += _few_shared_views(names, views, kept)
    rest = [q for q in quantities if not (q.kind == "lens" and q.name.split(" ")[0] in told)]
    lost = any(q.kind == "lens" and _sigma(q, covariance) > _UNKNOWN * q.weak for q in quantities)
    return Advice((*sentences, *_weak_directions(rest, covariance)), lens_unknown=lost)


# --- views -----------------------------------------------------------------------------------------------------------


def _what_was_seen(frames: CameraFrames, kept: np.ndarray, T: np.ndarray, points: np.ndarray) -> _Seen:
    rows = np.flatnonzero(kept.any(axis=1) & np.isfinite(T).all(axis=(1, 2)))
    in_camera = points @ T[rows, :3, :3].swapaxes(-1, -2) + T[rows, None, :3, 3]
    depth = np.sum(np.where(kept[rows], in_camera[..., 2], 0.0), axis=1) / kept[rows].sum(axis=1)
    return _Seen(_tilt_deg(in_camera, kept[rows]), depth, frames.pixels[kept])


def _tilt_deg(points: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Angle (F,) of points (F, M, 3), where `seen` (F, M), to the image plane, by how their depth changes across it;
    boards in several planes count as tilted by what no plane explains."""
    count = seen.sum(axis=1)
    share = seen / count[:, None]
    centred = np.where(seen[..., None], points - np.einsum("fm,fmi->fi", share, points)[:, None], 0.0)
    across, depth = centred[..., :2], centred[..., 2]
    slope = np.einsum("fim,fm->fi", np.linalg.pinv(across, rcond=1e-9), depth)
    beyond = np.sqrt(np.sum((depth - np.einsum("fmi,fi->fm", across, slope)) ** 2, axis=1) / count)
    width = np.sqrt(np.sum(across**2, axis=(1, 2)) / count)
    return np.degrees(np.arctan(np.hypot(np.linalg.norm(slope, axis=1), beyond / np.maximum(width, 1e-12))))


def _few_views(name: str, seen: _Seen, of_lens: Sequence[_Quantity], covariance: np.ndarray) -> list[str]:
    count = len(seen.tilt_deg)
    if count >= _FEW_VIEWS:
        return []
    return [
        f"{name}: only {count} views of the board. Beyond its own pose each tells two numbers of focal length and "
        "principal point (Zhang 2000), the rest being distortion, so that nothing checks them: "
        f"{_with_sigmas(of_lens, covariance)}. Record 20 views or more, tilted, at several distances, all over the "
        "image."
    ]


def _hardly_tilted(
    name: str,
    model: CameraModel,
    seen: _Seen,
    better: float,
    of_lens: Sequence[_Quantity],
    covariance: np.ndarray,
) -> list[str]:
    """Frontal views: a longer lens and a board further away look the same."""
    if better < _WORTH_SAYING:
        return []
    distance = ", and all views are from one distance" if seen.one_distance else ""
    tilt = max(round(seen.largest_tilt_deg), 1)
    focal = [q for q in of_lens if q.weak == _FOCAL_SIGMA]
    known = _with_sigmas(focal, covariance) if focal else "the scale of the lens"
    return [
        f"{name}: focal length and distance to the board are known only together, because hardly a view tilts the "
        f"board by more than {tilt} degree{'s' if tilt > 1 else ''} to the image{distance}: {known}. The same "
        f"views, every other one tilted by {_GOOD_TILT_DEG:.0f} degrees, would make these sigmas {_times(better)} "
        "smaller. Record the board tilted by 30 degrees and more about both of its axes, near and far."
    ]


def _empty_parts(name: str, seen: _Seen, image_size: tuple[int, int]) -> list[str]:
    """Thirds of the image, along its sides, in which no corner was."""
    place = (seen.pixels + 0.5) / np.array(image_size)
    sides = {
        "left": (place[:, 0] < 1 / 3).any(),
        "right": (place[:, 0] > 2 / 3).any(),
        "upper": (place[:, 1] < 1 / 3).any(),
        "lower": (place[:, 1] > 2 / 3).any(),
    }
    empty = [side for side, seen_there in sides.items() if not seen_there]
    if not empty:
        return []
    thirds = f"the {' and the '.join(empty)} third{'s' if len(empty) > 1 else ''}"
    return [
        f"{name}: no corner was ever in {thirds} of the image. Distortion there is extrapolated, and the principal "
        "point rests on one side of the image. Move the board there, into the edges."
    ]


def _few_shared_views(names: Sequence[str], views: Sequence[np.ndarray], kept: Sequence[np.ndarray]) -> list[str]:
    used = [set(np.asarray(v)[k.any(axis=1)].tolist()) for v, k in zip(views, kept, strict=True)]
    sentences = []
    for c in range(1, len(names)):
        others = set().union(*(used[d] for d in range(len(names)) if d != c))
        count = len(used[c] & others)
        if 0 < count < _FEW_SHARED:
            sentences.append(
                f"{names[c]} saw the board together with another camera in {count} view{'s' if count > 1 else ''} "
                "only: its pose in the rig rests on these, and an error in one of them goes into it. Record ten "
                "moments or more in which both see the board, in different places and tilts."
            )
    return sentences


# --- how much tilt would help ----------------------------------------------------------------------------------------


def _tilting_helps(
    model: CameraModel, frames: CameraFrames, kept: np.ndarray, T: np.ndarray, points: np.ndarray
) -> float:
    """By what factor the sigma of the focal length would shrink, had every other view been tilted (about the board's x
    and y in turn, both ways), as far as the corners would have stayed in the image."""
    rows = np.flatnonzero(kept.any(axis=1) & np.isfinite(T).all(axis=(1, 2)))
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(_MOST_VIEWS, len(rows))).round().astype(int))]
    weight = kept[rows].astype(np.float64)
    as_seen = np.einsum("fij,nj->fni", T[rows, :3, :3], points) + T[rows, None, :3, 3]
    turned = as_seen.copy()
    for k in range(0, len(rows), 2):
        middle = as_seen[k][kept[rows[k]]].mean(axis=0)
        axis = T[rows[k], :3, (k // 2) % 2] * (1.0 if (k // 4) % 2 else -1.0)
        turn = Rotation.from_rotvec(np.deg2rad(_GOOD_TILT_DEG) * axis).as_matrix()
        turned[k] = (as_seen[k] - middle) @ turn.T + middle
    size = jnp.asarray(frames.detections.image_size, dtype=float)
    before, after = (float(_focal_sigma(model, jnp.asarray(p), jnp.asarray(weight), size)) for p in (as_seen, turned))
    return before / after if np.isfinite(before) and after > 0 else 1.0


@stored_jit
def _focal_sigma(
    model: CameraModel, points: Float[Array, "F N 3"], weight: Float[Array, "F N"], image_size: Float[Array, "2"]
) -> Float[Array, ""]:
    """1-sigma of the logarithm of the focal length near the axis, for corner noise of one pixel and free poses, from
    points in the camera's frame; those outside the image or the lens's domain do not count."""
    parameters = model.parameters

    def of_view(places: Array, weights: Array) -> Array:
        pixels = jax.vmap(model.project)(places)
        inside = jnp.all((pixels >= 0.0) & (pixels <= image_size - 1.0), axis=1)
        root = jnp.sqrt(weights * inside * jax.vmap(model.is_valid)(places))[:, None, None]
        A = root * jax.vmap(lambda p: jax.jacrev(lambda v: model.with_parameters(v).project(p))(parameters))(places)
        by_point = jax.vmap(jax.jacrev(model.project))(places)
        turn = jnp.cross(jnp.eye(3)[None], places[:, None]).swapaxes(1, 2)
        B = root * jnp.concatenate([by_point @ turn, by_point], axis=2)
        A, B = A.reshape(-1, A.shape[-1]), B.reshape(-1, 6)
        scale = jnp.sqrt(jnp.sum(B**2, axis=0)) + 1e-12
        own = (B / scale).T @ (B / scale) + 1e-9 * jnp.eye(6)
        cross = (B / scale).T @ A
        return A.T @ A - cross.T @ jnp.linalg.solve(own, cross)

    information = jnp.sum(jax.vmap(of_view)(points, weight), axis=0) + jnp.diag(model.regularisation())
    size = information.shape[0]
    held = jnp.zeros(size).at[jnp.asarray(model.held, dtype=int)].set(1.0)
    information = information * (1.0 - held[:, None]) * (1.0 - held[None, :]) + jnp.diag(held)
    scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diag(information), 1e-300))
    scaled = information * scale[:, None] * scale[None, :] + 1e-12 * jnp.eye(size)
    gradient = jax.grad(lambda v: 0.5 * jnp.log(jnp.abs(jnp.linalg.det(model.with_parameters(v).paraxial()[0]))))(
        parameters
    )
    gradient = gradient * scale * (1.0 - held)
    return jnp.sqrt(gradient @ jnp.linalg.solve(scaled, gradient))


# --- directions ------------------------------------------------------------------------------------------------------


def _quantities(
    names: Sequence[str],
    models: Sequence[CameraModel],
    layout: SharedLayout,
    free: np.ndarray,
    covariance: np.ndarray,
    cameras: Sequence[CameraFrames],
) -> list[_Quantity]:
    """What the shared coordinates mean: lenses near their axis, poses, time shifts, gravity, poses of boards."""
    labels = labels_of(names, models, layout)
    identity = np.eye(layout.size)
    out: list[_Quantity] = []
    for c, (name, model) in enumerate(zip(names, models, strict=True)):
        out += _lens_quantities(name, model, layout.lens(c), covariance, cameras[c].detections.image_size)
    for k, label in enumerate(labels):
        if not free[k] or any(k in range(*layout.lens(c).indices(layout.size)) for c in range(len(names))):
            continue
        if " rotation " in label:
            out.append(_Quantity(label, identity[k], float(_TURN_SIGMA), 180.0 / np.pi, "deg", "pose"))
        elif " translation " in label:
            out.append(_Quantity(label, identity[k], _SHIFT_SIGMA, 1e3, "mm", "pose"))
        elif label.endswith("time shift"):
            out.append(_Quantity(label, identity[k], _TIME_SIGMA, 1e3, "ms", "motion"))
        elif label.startswith("gravity"):
            out.append(_Quantity(label, identity[k], float(_TURN_SIGMA), 180.0 / np.pi, "deg", "motion"))
    return out


def _lens_quantities(
    name: str, model: CameraModel, lens: slice, covariance: np.ndarray, image_size: tuple[int, int]
) -> list[_Quantity]:
    """fx, fy relative to themselves and cx, cy in pixels.

    Where fx or fy is weak by itself, or the lens has none that is estimated, the focal length near the axis takes its
    place: in lenses with a shape parameter (omni, double sphere) that one may be known where fx is not.
    """
    position = {label: k for k, label in enumerate([*model.parameter_names[0], *model.parameter_names[1]])}
    values = np.asarray(model.parameters)
    width, factors = len(covariance), ("fx", "fy", "cx", "cy")
    rows = np.zeros((4, width))
    plain = all(label in position and position[label] not in model.held for label in factors)
    if plain:
        for k, label in enumerate(factors):
            rows[k, lens.start + position[label]] = 1.0 / values[position[label]] if k < 2 else 1.0
    if not plain or max(np.sqrt(rows[:2] @ covariance @ rows[:2].T).diagonal()) > _FOCAL_SIGMA:
        rows[:, lens] = np.asarray(_paraxial_rows(model))
    return [
        _Quantity(
            f"{name} {label}",
            row,
            _FOCAL_SIGMA if k < 2 else _CENTRE_SIGMA * image_size[0],
            100.0 if k < 2 else 1.0,
            "%" if k < 2 else "px",
            "lens",
        )
        for k, (label, row) in enumerate(zip(factors, rows, strict=True))
    ]


@stored_jit
def _paraxial_rows(model: CameraModel) -> Float[Array, "4 n"]:
    """Derivatives by the parameters of: log of the focal lengths near the axis in x and y, and the axis's pixel."""

    def told(parameters: Array) -> Array:
        scale, centre = model.with_parameters(parameters).paraxial()
        return jnp.concatenate([0.5 * jnp.log(jnp.sum(scale**2, axis=1)), centre])

    return jax.jacfwd(told)(model.parameters)


def _weak_directions(quantities: Sequence[_Quantity], covariance: np.ndarray) -> list[str]:
    """Combinations whose sigma is above what would be weak, the weakest first, in words."""
    if not quantities:
        return []
    rows = np.stack([q.row / q.weak for q in quantities])
    values, vectors = np.linalg.eigh(rows @ covariance @ rows.T)
    sentences: list[str] = []
    named: set[int] = set()
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        parts = [int(k) for k in np.argsort(-np.abs(vector)) if abs(vector[k]) > _NAMED_PART]
        weak = [k for k in parts if _sigma(quantities[k], covariance) > quantities[k].weak and k not in named]
        if value <= 1.0 or not weak:
            continue
        named |= set(parts)
        together = "known only together: " if len(parts) > 1 else "badly known: "
        sentences.append(
            f"The recording is weak. {together.capitalize()}"
            f"{_with_sigmas([quantities[k] for k in parts], covariance)}. {_REMEDY[quantities[parts[0]].kind]}"
        )
    return sentences


_REMEDY = {
    "lens": "Record the board tilted by 30 degrees and more about both of its axes, near and far, all over the image.",
    "pose": "Record more moments in which both sides of this pose are seen together, in more varied tilts and places.",
    "motion": "Rotate the rig briskly about at least two axes, there and back, in view of the board.",
}


def _sigma(quantity: _Quantity, covariance: np.ndarray) -> float:
    return float(np.sqrt(max(quantity.row @ covariance @ quantity.row, 0.0)))


def _with_sigmas(quantities: Sequence[_Quantity], covariance: np.ndarray) -> str:
    """'cam0 fx +-4.1 %, cam0 fy +-4.0 %'; sigmas that say nothing any more are given as 'unknown'."""
    told = []
    for q in quantities:
        sigma = _sigma(q, covariance)
        told.append(f"{q.name} unknown" if sigma > _UNKNOWN * q.weak else f"{q.name} +-{sigma * q.factor:.2g} {q.unit}")
    return ", ".join(told)


def _times(factor: float) -> str:
    return f"{factor:.0f} times" if factor < 100.0 else "a hundred times or more"
