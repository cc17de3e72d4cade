"""Tests for errors of the model, on a calibration's own residuals: each possible cause with the evidence for it.

Every cause is a handful of directions in which the corners would move: a smooth distortion of the image beyond the
lens model, a bend of the board, rows seen later than others, lens or place of a camera different in the second half.
To first order about the solution, the squared errors fall by r'B (B'B)^-1 B'r when those directions B are fitted too,
where r and B have lost what the calibration's own parameters and the poses of the views explain: the score test (Rao
1948), chi-squared of as many degrees of freedom as B has directions left, where there is only noise. Coefficients that
were fitted to one half of the views are tried on the other, as a re-fit would be. The strongest cause is found first,
and is one of the calibration's own parameters when the others are looked at again: a bent board, say, looks like a
lens error, too, but no longer does so then.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import chebyshev
from scipy.special import chdtrc  # scipy.stats says the same, and takes half a second to import

from jaxcal.calibration.assemble import split_groups
from jaxcal.calibration.known import KnownProblem
from jaxcal.calibration.problem import camera_poses
from jaxcal.cameras import CameraModel
from jaxcal.programs import stored_jit
from jaxcal.results import Calibration
from jaxcal.results.cross_validation import FALSE_ALARMS, Cause, Evidence

# Distortions beyond a lens model that are usual: along the radius, in these powers of it, and in x and y.
_RADIAL, _SHIFTED = (3, 5, 7, 9), (2, 4)
# Any others: polynomials of this degree over the image.
_DEGREE = 6
# Frames further apart than this tell no velocity (s).
_NEIGHBOUR_S = 0.25
_CORNER_STEP = 4096
# Directions that the calibration's own parameters explain to this share are none.
_OWN = 1e-7


@dataclass(frozen=True)
class Columns:
    """What a group of directions is: a cause of `subject`, or the calibration's own parameters (`cause` None)."""

    cause: Cause | None
    subject: str
    where: slice


@dataclass(frozen=True)
class Equations:
    """Normal equations of all directions, after the poses of the views are taken out, for the views of each half (in
    turns): `matrix` (2, P, P), `right` (2, P); and how many corner coordinates there are."""

    columns: tuple[Columns, ...]
    matrix: np.ndarray
    right: np.ndarray
    rows: int


def find_model_errors(known: KnownProblem, halves: int = 0) -> list[Evidence]:
    """Test every cause; those that are found carry their `step`. `halves` is the number of other tests that share the
    chance of a false alarm."""
    equations = _equations(known)
    causes = [columns for columns in equations.columns if columns.cause is not None]
    threshold = FALSE_ALARMS / (len(causes) + halves)
    own = [columns for columns in equations.columns if columns.cause is None]
    judged: dict[int, Evidence] = {}
    step = 0
    while True:
        left = {k: _judge(equations, own, c) for k, c in enumerate(causes) if k not in judged or not judged[k].found}
        judged |= left
        real = {k: e for k, e in left.items() if e.p_value < threshold and e.held_back > 0}
        if not real:
            return [judged[k] for k in range(len(causes))]
        # As many numbers as a cause has must pay for themselves (Schwarz 1978).
        best = max(real, key=lambda k: real[k].gain - real[k].freedom * np.log(equations.rows))
        judged[best] = replace(real[best], step=step)
        own.append(causes[best])
        step += 1


# --- judging ---------------------------------------------------------------------------------------------------------


def _judge(equations: Equations, own: Sequence[Columns], cause: Columns) -> Evidence:
    before = np.concatenate([np.arange(c.where.start, c.where.stop) for c in own])
    more = np.arange(cause.where.start, cause.where.stop)
    matrix, right = equations.matrix.sum(axis=0), equations.right.sum(axis=0)
    gain, freedom, value = _gain(matrix, right, before, more)
    held_back = 0.0
    for half in (0, 1):
        other = 1 - half
        without = _fit(equations.matrix[half], equations.right[half], before)
        both = _fit(equations.matrix[half], equations.right[half], np.concatenate([before, more]))
        held_back += _fall(equations, other, both) - _fall(equations, other, without)
    p_value = float(chdtrc(freedom, gain)) if freedom else 1.0
    single = float(value[0]) if len(more) == 1 and freedom else None
    return Evidence(cast("Cause", cause.cause), cause.subject, gain, freedom, p_value, held_back, None, single)


def _gain(matrix: np.ndarray, right: np.ndarray, before: np.ndarray, more: np.ndarray) -> tuple[float, int, np.ndarray]:
    """By how much the squares fall when `more` directions are fitted beside those `before`; how many of them are not
    explained by those; and their coefficients."""
    inverse = _pinv(matrix[np.ix_(before, before)])
    cross = matrix[np.ix_(before, more)]
    information = matrix[np.ix_(more, more)] - cross.T @ inverse @ cross
    force = right[more] - cross.T @ inverse @ right[before]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[more], 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    kept = values > _OWN
    part = vectors[:, kept].T @ (scale * force)
    coefficients = scale * (vectors[:, kept] @ (part / values[kept]))
    return float(np.sum(part**2 / values[kept])), int(kept.sum()), coefficients


def _fit(matrix: np.ndarray, right: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Coefficients (P,) of least squares over some columns."""
    out = np.zeros(len(right))
    out[columns] = _pinv(matrix[np.ix_(columns, columns)]) @ right[columns]
    return out


def _fall(equations: Equations, half: int, coefficients: np.ndarray) -> float:
    """By how much coefficients lower the squares of a half."""
    return float(2.0 * coefficients @ equations.right[half] - coefficients @ equations.matrix[half] @ coefficients)


def _pinv(matrix: np.ndarray) -> np.ndarray:
    diagonal = np.diag(matrix)
    # What nothing was seen of stays as it is.
    scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 0.0)
    return np.linalg.pinv(matrix * scale[:, None] * scale, rcond=1e-9, hermitian=True) * scale[:, None] * scale


# --- the equations ---------------------------------------------------------------------------------------------------


def _equations(known: KnownProblem) -> Equations:
    columns, total = _layout(known)
    poses = split_groups(known.layout, known.cameras, [np.asarray(p) for p in camera_poses(known.problem, known.state)])
    errors = known.errors(known.state)
    late = known.times_s > np.median(known.times_s)
    parts: list[list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = [[] for _ in range(known.num_views)]
    for c in range(known.layout.num_cameras):
        for view, part in _frames(known, c, poses[c], errors[c], late, columns, total):
            parts[view].append(part)
    matrix, right = np.zeros((2, total, total)), np.zeros((2, total))
    second = ~known.in_turns()
    for view, own in enumerate(parts):
        if not own:
            continue
        residual = np.concatenate([part[0] for part in own])
        pose = np.concatenate([part[1] for part in own])
        directions = np.concatenate([part[2] for part in own])
        q, _ = np.linalg.qr(pose)
        directions -= q @ (q.T @ directions)
        residual -= q @ (q.T @ residual)
        half = int(second[view])
        matrix[half] += directions.T @ directions
        right[half] += directions.T @ residual
    rows = 2 * sum(int(kept.sum()) for kept in known.kept)
    return Equations(tuple(columns), matrix, right, rows)


def _layout(known: KnownProblem) -> tuple[list[Columns], int]:
    """All directions: first those of the calibration, then those of each cause."""
    columns: list[Columns] = []
    start = 0

    def add(cause: Cause | None, subject: str, size: int) -> None:
        nonlocal start
        columns.append(Columns(cause, subject, slice(start, start + size)))
        start += size

    cameras = known.calibration.cameras
    warp = known.layout.warp
    for camera in cameras:
        add(None, f"{camera.name} lens", camera.model.num_parameters)
    for camera in cameras[1:] if known.tied else ():
        add(None, f"{camera.name} place", 6)
    if warp:
        add(None, "board", len(_bends(np.zeros((1, 2)))[0]))
    for camera in cameras:
        add("lens", camera.name, len(_RADIAL) + 2 * len(_SHIFTED))
        add("uneven lens", camera.name, (_DEGREE + 1) * (_DEGREE + 2))
    if len(known.calibration.target.boards) == 1:
        if not warp:
            add("bent board", "board", len(_bends(np.zeros((1, 2)))[0]))
        add("misprinted board", "board", 2)
    for camera, lags in zip(cameras, with_lag(known.calibration), strict=True):
        if not lags:
            add("rolling shutter", camera.name, 1)
    for camera in cameras:
        add("changed lens", camera.name, camera.model.num_parameters)
    for camera in cameras[1:] if known.tied else ():
        add("moved camera", camera.name, 6)
    return columns, start


def with_lag(calibration: Calibration) -> list[bool]:
    """Which cameras' stamps may lag (frames made of events): a lag is not quite the same in all rows, and would be
    taken for a rolling shutter."""
    sigmas = calibration.settings.get("stamp_sigma_s") or [0.0] * len(calibration.cameras)
    return [float(sigma) > 0.0 for sigma in sigmas]


def _frames(
    known: KnownProblem,
    c: int,
    poses: np.ndarray,
    errors: np.ndarray,
    late: np.ndarray,
    columns: Sequence[Columns],
    total: int,
):
    """Per frame of a camera its view, and whitened: residual (m,), derivative by the rig's pose (m, 6), and all
    directions (m, P)."""
    camera, frames = known.calibration.cameras[c], known.cameras[c]
    points = known.calibration.target_points
    in_camera = np.einsum("fij,nj->fni", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    by_point, by_lens = _jacobians(camera.model, in_camera.reshape(-1, 3))
    by_point = by_point.reshape(*in_camera.shape[:2], 2, 3)
    by_lens = by_lens.reshape(*in_camera.shape[:2], 2, -1)
    velocity = np.einsum("fnij,fnj->fni", by_point, _velocities(in_camera, frames.time_ns))
    R_cam_rig, t_cam_rig = np.asarray(known.state.R_cam_rig)[c], np.asarray(known.state.t_cam_rig)[c]
    size = np.array(camera.image_size, dtype=float)
    centre = np.asarray(camera.model.project(jnp.array([1e-9, 1e-9, 1.0])))
    bends, prints = _board_directions(known)
    place = {(column.cause, column.subject): column.where for column in columns}
    names = [one.name for one in known.calibration.cameras]
    for f in range(len(frames.frames)):
        kept = known.kept[c][f]
        if kept.sum() < 4:
            continue
        root = np.sqrt(known.weights[c][f][kept])[:, None, None]
        P, L = by_point[f][kept] * root, by_lens[f][kept] * root
        turned = in_camera[f][kept] - t_cam_rig  # R_cam_rig times the point in the rig's frame
        by_pose = np.concatenate([-P @ _cross(turned), P], axis=2) @ _blocks(R_cam_rig)
        by_place = np.concatenate([-P @ _cross(turned), P], axis=2)
        whole = np.zeros((int(kept.sum()), 2, total))
        # Where the model puts the corners: the noise must not be in the directions as well.
        pixels = frames.pixels[f][kept] + errors[f][kept]
        from_centre = (pixels - centre) / (0.5 * np.linalg.norm(size))
        after = float(late[known.views[c][f]])
        whole[..., place[None, f"{names[c]} lens"]] = L
        whole[..., place["lens", names[c]]] = _round_directions(from_centre) * root
        whole[..., place["uneven lens", names[c]]] = _image_directions(2.0 * pixels / size - 1.0) * root
        if ("rolling shutter", names[c]) in place:
            rows = pixels[:, 1] - 0.5 * size[1]
            whole[..., place["rolling shutter", names[c]]] = (velocity[f][kept] * rows[:, None])[..., None] * root
        whole[..., place["changed lens", names[c]]] = after * L
        if (None, f"{names[c]} place") in place:
            whole[..., place[None, f"{names[c]} place"]] = by_place
            whole[..., place["moved camera", names[c]]] = after * by_place
        by_target = P @ poses[f, :3, :3]
        for key, directions in (((None, "board"), bends), (("bent board", "board"), bends)):
            if key in place:
                whole[..., place[key]] = np.einsum("nij,nkj->nik", by_target, directions[kept])
        if ("misprinted board", "board") in place:
            where = place["misprinted board", "board"]
            whole[..., where] = np.einsum("nij,nkj->nik", by_target, prints[kept])
        residual = -errors[f][kept] * root[..., 0]
        flat = (residual.ravel(), by_pose.reshape(-1, 6), whole.reshape(-1, total))
        yield int(known.views[c][f]), flat


def _jacobians(model: CameraModel, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of pixels by points (M, 2, 3) and by the lens (M, 2, n)."""
    count = len(points)
    padded = np.pad(points, [(0, -count % _CORNER_STEP), (0, 0)], mode="edge")
    by_point, by_lens = [], []
    for start in range(0, len(padded), _CORNER_STEP):
        parts = _derivatives(model, jnp.asarray(padded[start : start + _CORNER_STEP]))
        by_point.append(np.asarray(parts[0]))
        by_lens.append(np.asarray(parts[1]))
    return np.concatenate(by_point)[:count], np.concatenate(by_lens)[:count]


@stored_jit
def _derivatives(model: CameraModel, points: Float[Array, "M 3"]) -> tuple[Array, Array]:
    def project(vector: Array, point: Array) -> Array:
        return model.with_parameters(vector).project(point)

    both = jax.vmap(jax.jacrev(project, argnums=(1, 0)), in_axes=(None, 0))
    by_point, by_lens = both(model.parameters, points)
    return by_point, by_lens


def _velocities(in_camera: np.ndarray, time_ns: np.ndarray) -> np.ndarray:
    """How points (F, N, 3) move in the camera's frame, m/s, from the frames before and after; 0 where those are far."""
    time = (time_ns - time_ns[0]) * 1e-9
    count = len(time)
    before, after = np.maximum(np.arange(count) - 1, 0), np.minimum(np.arange(count) + 1, count - 1)
    before = np.where(time - time[before] < _NEIGHBOUR_S, before, np.arange(count))
    after = np.where(time[after] - time < _NEIGHBOUR_S, after, np.arange(count))
    span = time[after] - time[before]
    moved = in_camera[after] - in_camera[before]
    return np.where(span[:, None, None] > 0, moved / np.maximum(span, 1e-9)[:, None, None], 0.0)


def _round_directions(place: np.ndarray) -> np.ndarray:
    """Displacements (m, 2, q) of pixels at places (m, 2) from the optical axis, 1 at about the image's corners."""
    radius = np.linalg.norm(place, axis=1)
    radial = np.stack([place * radius[:, None] ** (power - 1) for power in _RADIAL], axis=2)
    powers = np.stack([radius**power for power in _SHIFTED], axis=1)
    zero = np.zeros_like(powers)
    shifted = np.stack([np.concatenate([powers, zero], axis=1), np.concatenate([zero, powers], axis=1)], axis=1)
    return np.concatenate([radial, shifted], axis=2)


def _image_directions(place: np.ndarray) -> np.ndarray:
    """Smooth displacements (m, 2, q) of pixels at places (m, 2) from -1 to 1 across the image."""
    terms = chebyshev.chebvander2d(np.clip(place[:, 0], -1, 1), np.clip(place[:, 1], -1, 1), [_DEGREE, _DEGREE])
    terms = terms.reshape(len(place), _DEGREE + 1, _DEGREE + 1)
    i, j = np.nonzero(np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)) <= _DEGREE)
    values = terms[:, i, j]
    zero = np.zeros_like(values)
    return np.stack([np.concatenate([values, zero], axis=1), np.concatenate([zero, values], axis=1)], axis=1)


def _bends(across: np.ndarray) -> np.ndarray:
    """Heights (N, 7), m per unit, of bent boards at places (N, 2) from -1 to 1 across: of second and third degree."""
    x, y = across.T
    return np.stack([x**2, y**2, x * y, x**3, x**2 * y, x * y**2, y**3], axis=1)


def _board_directions(known: KnownProblem) -> tuple[np.ndarray, np.ndarray]:
    """How each point moves when the board is bent (N, 7, 3), and when it is stretched along x or sheared (N, 2, 3)."""
    points = known.calibration.target.points
    across = np.asarray(known.problem.geometry.across)
    heights = _bends(across)
    bends = np.zeros((*heights.shape, 3))
    bends[..., 2] = heights
    prints = np.zeros((len(points), 2, 3))
    prints[:, 0, 0] = points[:, 0] - points[:, 0].mean()
    prints[:, 1, 0] = points[:, 1] - points[:, 1].mean()
    return bends, prints


def _cross(vectors: np.ndarray) -> np.ndarray:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _blocks(rotation: np.ndarray) -> np.ndarray:
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    return out
