"""Covariance of the calibration from the Schur complement, and words for what it does not determine."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxcal.calibration.state import RigState, SharedLayout, tangent_basis
from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.estimation import BlockArrow, factorise, single_threaded_blas
from jaxcal.imu import imu_model
from jaxcal.programs import stored_jit

# Eigenvalues of the information matrix, scaled to unit diagonal, below which a direction counts as unobserved.
UNOBSERVED = 1e-11


@stored_jit
def _schur(equations: BlockArrow) -> tuple:
    chain, shared = equations.diagonal()
    # Keeps chain blocks that nothing observes (knots in a gap) from spoiling the factor; far below any information.
    factor = factorise(equations, 1e-13 * jnp.maximum(chain, 1e-6 * jnp.max(chain)), jnp.zeros_like(shared))
    return factor.schur, factor.chain_covariance()


def shared_covariance(
    equations: BlockArrow, free: np.ndarray, labels: Sequence[str], to_parameters: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Covariance (P, P) of the shared parameters (zero where held), marginal covariance (K, B, B) of the chain blocks,
    and sentences about directions that the data leave open. `to_parameters` (P, P) where the equations count steps that
    are not those of the parameters."""
    with single_threaded_blas():
        schur, chain = (np.asarray(part) for part in _schur(equations))
    values, vectors, scale = _scaled_eigen(schur, free)
    weak = values < UNOBSERVED
    back = np.eye(len(schur)) if to_parameters is None else to_parameters
    open_ones = [_as_parameters(vectors[:, k] * scale, free, back, schur) for k in np.flatnonzero(weak)]
    sentences = [_unobserved_sentence(direction, np.asarray(labels)[free]) for direction in open_ones]
    inverse = (vectors / np.maximum(values, UNOBSERVED)) @ vectors.T
    covariance = np.zeros(schur.shape)
    covariance[np.ix_(free, free)] = inverse * scale[:, None] * scale[None, :]
    return back @ covariance @ back.T, chain, sentences


def shared_information(equations: BlockArrow, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (F, F), as columns, that do not correlate, and how well each is known: 1 / variance along it (F,)."""
    with single_threaded_blas():
        schur = np.asarray(_schur(equations)[0])
    values, vectors, scale = _scaled_eigen(schur, free)
    return values, scale[:, None] * vectors


def _scaled_eigen(schur: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eigenvalues and vectors of the information scaled to unit diagonal, and that scale."""
    information = schur[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    return values, vectors, scale


def _as_parameters(step: np.ndarray, free: np.ndarray, back: np.ndarray, schur: np.ndarray) -> np.ndarray:
    """A step of the free coordinates as one of the parameters, each in units of what it does by itself."""
    full = np.zeros(len(free))
    full[free] = step
    inverse = np.linalg.inv(back)
    alone = np.sqrt(np.maximum(np.einsum("ji,jk,ki->i", inverse, schur, inverse), 0.0))
    direction = ((back @ full) * alone)[free]
    return direction / max(float(np.linalg.norm(direction)), 1e-300)


def _unobserved_sentence(direction: np.ndarray, labels: np.ndarray) -> str:
    strongest = np.argsort(-np.abs(direction))[:4]
    named = ", ".join(str(labels[k]) for k in strongest if abs(direction[k]) > 0.2)
    return (
        f"The recording does not determine a combination of: {named}. Do not use these values; record with more varied "
        "tilt, distance and place in the image (with an IMU: rotate about two axes at least)."
    )


def labels_of(names: Sequence[str], models: Sequence[CameraModel], layout: SharedLayout) -> list[str]:
    """A name for every coordinate of the shared tangent vector."""
    labels: list[str] = []
    pose = [f"rotation {a}" for a in "xyz"] + [f"translation {a}" for a in "xyz"]
    for name, model in zip(names, models, strict=True):
        lens = [label for part in model.parameter_names for label in part]
        labels += [f"{name} {label}" for label in [*lens, *pose, "time shift"]]
    for number, imu in enumerate(layout.imus):
        own = imu_model(imu.model).labels() + ([*pose, "time shift"] if imu.placed else [])
        labels += [f"imu{number} {label}" for label in own]
    labels += [f"gravity {axis}" for axis in ("direction 1", "direction 2", "z")[: layout.gravity_size]]
    labels += [f"{name} line delay" for c, name in enumerate(names) if layout.is_rolling(c)]
    labels += [f"board {b + 1} {label}" for b in range(layout.extra_boards) for label in pose]
    labels += ["board warp x", "board warp y"] if layout.warp else []
    return labels + [f"point {i} offset {a}" for i in range(layout.offsets) for a in "xyz"]


def _hat(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def stamp_sigmas_of(sigma_s: float | Sequence[float], cameras: int) -> list[float]:
    """The 1-sigma of the delay of each camera's time stamps, s. Raises CalibrationError when there are not as many
    numbers as cameras, or one is negative."""
    sigmas = [float(sigma_s)] * cameras if isinstance(sigma_s, int | float) else [float(one) for one in sigma_s]
    if len(sigmas) != cameras or not all(0.0 <= sigma < np.inf for sigma in sigmas):
        raise CalibrationError(
            f"`stamp_sigma_s` is {sigma_s!r}; expected seconds, zero or more: one number for all {cameras} cameras or "
            "one each."
        )
    return sigmas


def with_common_delay(
    covariance: np.ndarray, layout: SharedLayout, sigmas_s: Sequence[float], *, to_first_camera: bool
) -> np.ndarray:
    """Covariance (P, P) of the shared vector with a delay in it that all stamps of a camera share.

    Corners and IMU cannot tell such a delay from a time offset: offsets alone become less certain. `sigmas_s` by
    camera; their cause is taken for one and the same (the network that makes frames of events), so that what cameras
    have in common cancels between them. `to_first_camera`: offsets are to the first camera's clock, not the IMU's.
    """
    delay = np.zeros(len(covariance))
    for c, sigma in enumerate(sigmas_s):
        delay[layout.shift(c)] = sigma - (sigmas_s[0] if to_first_camera else 0.0)
    return covariance + np.outer(delay, delay)


def named_covariance(
    names: Sequence[str],
    layout: SharedLayout,
    state: RigState,
    covariance: np.ndarray,
    num_intrinsics: Sequence[int],
    *,
    with_imu: bool,
    with_time: bool,
) -> tuple[tuple[tuple[str, int], ...], np.ndarray]:
    """Blocks and joint covariance of the parameters as `Calibration` names them, by linear propagation."""
    blocks, jacobian = named_jacobian(names, layout, state, num_intrinsics, with_imu=with_imu, with_time=with_time)
    return blocks, jacobian @ covariance @ jacobian.T


def named_jacobian(
    names: Sequence[str],
    layout: SharedLayout,
    state: RigState,
    num_intrinsics: Sequence[int],
    *,
    with_imu: bool,
    with_time: bool,
) -> tuple[tuple[tuple[str, int], ...], np.ndarray]:
    """The blocks of parameters as `Calibration` names them, and their derivative (n, P) by the shared vector."""
    blocks: list[tuple[str, int]] = []
    rows: list[np.ndarray] = []
    identity = np.eye(layout.size)
    R, t = np.asarray(state.R_cam_rig), np.asarray(state.t_cam_rig)
    for c, name in enumerate(names):
        lens = identity[layout.lens(c)]
        blocks.append((f"{name}.intrinsics", num_intrinsics[c]))
        rows.append(lens[: num_intrinsics[c]])
        if layout.sizes[c] > num_intrinsics[c]:
            blocks.append((f"{name}.distortion", layout.sizes[c] - num_intrinsics[c]))
            rows.append(lens[num_intrinsics[c] :])
        if c > 0:
            blocks.append((f"{name}.T_cn_cnm1", 6))
            own, before = identity[layout.pose(c)], identity[layout.pose(c - 1)]
            R_rel = R[c] @ R[c - 1].T
            turn = own[:3] - R_rel @ before[:3]
            rows.append(np.concatenate([turn, own[3:] + _hat(R_rel @ t[c - 1]) @ turn - R_rel @ before[3:]]))
        if with_imu:
            blocks.append((f"{name}.T_cam_imu", 6))
            rows.append(identity[layout.pose(c)])
        if with_time and (with_imu or c > 0):
            blocks.append((f"{name}.timeshift_cam_{'imu' if with_imu else 'cam0'}", 1))
            rows.append(identity[[layout.shift(c)]])
        if layout.is_rolling(c):
            blocks.append((f"{name}.line_delay", 1))
            rows.append(identity[[layout.line_delay(c)]])
    if with_imu:
        blocks.append(("gravity", 3))
        gravity = np.asarray(state.gravity)
        rows.append((tangent_basis(gravity) if layout.gravity_size == 2 else np.eye(3)) @ identity[layout.gravity])
    for number, imu in enumerate(layout.imus):
        own = identity[layout.imu(number)]
        for block, entries in imu_model(imu.model).blocks:
            blocks.append((f"imu{number}.{block}", len(entries)))
            rows.append(own[: len(entries)])
            own = own[len(entries) :]
        if imu.placed:
            blocks += [(f"imu{number}.T_imu_imu0", 6), (f"imu{number}.timeshift_imu_imu0", 1)]
            rows += [own[:6], own[6:]]
    start = layout.target.start
    for b in range(layout.extra_boards):
        blocks.append((f"target.T_target_board{b + 1}", 6))
        rows.append(identity[start + 6 * b : start + 6 * (b + 1)])
    start += 6 * layout.extra_boards
    for name, size in (("warp", 2 * layout.warp), ("offsets", 3 * layout.offsets)):
        if size:
            blocks.append((f"target.{name}", size))
            rows.append(identity[start : start + size])
            start += size
    return tuple(blocks), np.concatenate(rows)
