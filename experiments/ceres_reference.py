"""The same rig problem for Ceres, through pyceres (`pip install jaxcal[bench]`): a reference for speed and optimum.

Residuals, weights and parameters are those of jaxcal's camera-only problem with pinhole-radtan cameras; poses are unit
quaternions on their manifold and translations. pyceres takes cost functions written in Python only, so one of them
holds a whole frame, with its Jacobians in closed form, vectorised in numpy; what Ceres spends in them and what in its
own linear algebra is told apart by its summary.
"""

import time
from dataclasses import dataclass

import numpy as np
import pyceres  # pyright: ignore[reportMissingImports]
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class CeresRun:
    """What a run came to: cost (half the sum of squares), intrinsics (C, 8), and where the wall time went, s."""

    cost: float
    intrinsics: np.ndarray
    wall_s: float
    cpu_s: float
    evaluation_s: float
    linear_solver_s: float
    iterations: int


class _Frame(pyceres.CostFunction):
    """Reprojection of one frame: blocks q_view (x y z w), t_view, q_cam, t_cam, intrinsics."""

    def __init__(self, points: np.ndarray, pixels: np.ndarray) -> None:
        pyceres.CostFunction.__init__(self)
        self.points, self.pixels = points, pixels
        self.set_num_residuals(2 * len(points))
        self.set_parameter_block_sizes([4, 3, 4, 3, 8])

    def Evaluate(self, parameters: list, residuals: np.ndarray, jacobians: list | None) -> bool:
        q_view, t_view, q_cam, t_cam, lens = (np.asarray(p) for p in parameters)
        R_view, R_cam = _matrix(q_view), _matrix(q_cam)
        in_rig = self.points @ R_view.T + t_view
        at = in_rig @ R_cam.T + t_cam
        pixels, by_point, by_lens = _project(lens, at)
        residuals[:] = (pixels - self.pixels).ravel()
        if jacobians is None:
            return True
        by_rig_point = by_point @ R_cam
        parts = (
            lambda: by_rig_point @ _by_quaternion(q_view, self.points),
            lambda: by_rig_point,
            lambda: by_point @ _by_quaternion(q_cam, in_rig),
            lambda: by_point,
            lambda: by_lens,
        )
        for jacobian, part in zip(jacobians, parts, strict=True):
            if jacobian is not None:
                jacobian[:] = part().ravel()
        return True


def _matrix(q: np.ndarray) -> np.ndarray:
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _by_quaternion(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Derivative (n, 3, 4) of R(q) p (n, 3) by x, y, z, w."""
    x, y, z, w = q
    a, b, c = p.T
    by_x = [2 * (y * b + z * c), 2 * (y * a - 2 * x * b - w * c), 2 * (z * a + w * b - 2 * x * c)]
    by_y = [2 * (-2 * y * a + x * b + w * c), 2 * (x * a + z * c), 2 * (-w * a + z * b - 2 * y * c)]
    by_z = [2 * (-2 * z * a - w * b + x * c), 2 * (w * a - 2 * z * b + y * c), 2 * (x * a + y * b)]
    by_w = [2 * (-z * b + y * c), 2 * (z * a - x * c), 2 * (-y * a + x * b)]
    return np.stack([np.stack(column, axis=-1) for column in (by_x, by_y, by_z, by_w)], axis=-1)


def _project(lens: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """pinhole-radtan: pixels (n, 2), by the point (n, 2, 3), by the lens (n, 2, 8)."""
    fx, fy, cx, cy, k1, k2, p1, p2 = lens
    inverse = 1.0 / at[:, 2]
    x, y = at[:, 0] * inverse, at[:, 1] * inverse
    r2 = x * x + y * y
    radial, slope = 1.0 + r2 * (k1 + k2 * r2), k1 + 2.0 * k2 * r2
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    ux = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    uy = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    vx, vy = uy, radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    zero, one = np.zeros_like(x), np.ones_like(x)
    by_point = np.stack(
        [
            np.stack([fx * ux * inverse, fx * uy * inverse, -fx * (ux * x + uy * y) * inverse], axis=-1),
            np.stack([fy * vx * inverse, fy * vy * inverse, -fy * (vx * x + vy * y) * inverse], axis=-1),
        ],
        axis=1,
    )
    upper = [u, zero, one, zero, fx * x * r2, fx * x * r2 * r2, fx * 2 * x * y, fx * (r2 + 2 * x * x)]
    lower = [zero, v, zero, one, fy * y * r2, fy * y * r2 * r2, fy * (r2 + 2 * y * y), fy * 2 * x * y]
    by_lens = np.stack([np.stack(upper, axis=-1), np.stack(lower, axis=-1)], axis=1)
    return np.stack([fx * u + cx, fy * v + cy], axis=-1), by_point, by_lens


def solve_with_ceres(
    points: np.ndarray,
    frames: list[tuple[int, int, np.ndarray, np.ndarray]],
    lenses: np.ndarray,
    T_cam_rig: tuple[np.ndarray, np.ndarray],
    T_rig_target: tuple[np.ndarray, np.ndarray],
    *,
    threads: int = 2,
) -> CeresRun:
    """Minimise from the start given; `frames` are (camera, view, point indices, pixels). cam0 is the rig's frame."""
    q_cam = [np.ascontiguousarray(q) for q in Rotation.from_matrix(T_cam_rig[0]).as_quat()]
    t_cam = [np.array(t) for t in T_cam_rig[1]]
    q_view = [np.ascontiguousarray(q) for q in Rotation.from_matrix(T_rig_target[0]).as_quat()]
    t_view = [np.array(t) for t in T_rig_target[1]]
    lens = [np.array(values, dtype=np.float64) for values in lenses]
    problem = pyceres.Problem()
    costs = []
    for camera, view, seen, pixels in frames:
        costs.append(_Frame(points[seen], pixels))
        blocks = [q_view[view], t_view[view], q_cam[camera], t_cam[camera], lens[camera]]
        problem.add_residual_block(costs[-1], pyceres.TrivialLoss(), blocks)
    for q in (*q_view, *q_cam):
        problem.set_manifold(q, pyceres.EigenQuaternionManifold())
    problem.set_parameter_block_constant(q_cam[0])
    problem.set_parameter_block_constant(t_cam[0])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    options.num_threads = threads
    options.max_num_iterations = 100
    # jaxcal stops when the next step promises less than 1e-11 of the cost.
    options.function_tolerance, options.gradient_tolerance, options.parameter_tolerance = 1e-11, 1e-14, 1e-14
    options.minimizer_progress_to_stdout = False
    summary = pyceres.SolverSummary()
    wall, cpu = time.perf_counter(), time.process_time()
    pyceres.solve(options, problem, summary)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return CeresRun(
        cost=float(summary.final_cost),
        intrinsics=np.stack(lens),
        wall_s=wall,
        cpu_s=cpu,
        evaluation_s=summary.residual_evaluation_time_in_seconds + summary.jacobian_evaluation_time_in_seconds,
        linear_solver_s=summary.linear_solver_time_in_seconds,
        iterations=int(summary.num_successful_steps + summary.num_unsuccessful_steps),
    )
