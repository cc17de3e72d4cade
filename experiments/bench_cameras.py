"""Speed of camera-only calibration against OpenCV and Ceres, on one machine, in one run.

    python experiments/bench_cameras.py              # everything, some minutes
    python experiments/bench_cameras.py --only mono whole

Each part solves the same corners from the same start to the same optimum, and says what that optimum cost. 'cold' is
the first call of a program in a process: compilation included, at a machine's first run, else loading from the disk;
'warm' the best of five later ones (of twenty, in turn, for one camera); CPU seconds are of all threads. Ratios are of
warm wall time, theirs over ours. Ceres needs `pip install jaxcal[bench]`.

- mono: one camera, 40 and 200 views of 144 corners, against cv2.calibrateCamera
- rig: four cameras, 200 and 1000 views, against Ceres, and (200) against OpenCV 5's cv2.calibrateMultiview
- batch: 64 re-noised calibrations in one compiled call (lax.map) against 64 of cv2.calibrateCamera
- whole: a new process that calibrates 40 views: start, corners from a file, compiled programs from the disk, until the
  result is there (Python then takes another half second to put jax away)
- memory: peak memory by number of views
"""

import argparse
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import Checkerboard, Detections
from jaxcal.calibration import solving
from jaxcal.calibration.assemble import CameraFrames, camera_frames
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.robust import START_DAMPING
from jaxcal.calibration.state import RigState
from jaxcal.cameras import PinholeRadtan
from jaxcal.estimation import SolveResult, single_threaded_blas, solve, solve_inside

BOARD = Checkerboard(rows=12, cols=12, spacing=0.04)
SIZE = (752, 480)
TRUTH = np.array([458.0, 457.0, 367.0, 248.0, -0.28, 0.074, 0.0002, 0.00001])
START = np.array([430.0, 430.0, 375.5, 239.5, 0.0, 0.0, 0.0, 0.0])
NOISE_PX = 0.2
REPEATS = 5
MONO_REPEATS = 20  # of a hundredth of a second each
BATCH = 64
FOLDER = os.path.dirname(os.path.abspath(__file__))
PARTS = ("mono", "rig", "batch", "whole", "memory")


@dataclass(frozen=True)
class Case:
    """Corners of a rig, and the start that every solver gets: T_cam_rig and T_rig_target."""

    detections: list[Detections]
    cameras: list[CameraFrames]
    T_cam_rig: tuple[np.ndarray, np.ndarray]
    T_rig_target: tuple[np.ndarray, np.ndarray]
    problem: RigProblem
    state: RigState


@dataclass(frozen=True)
class Timing:
    """Seconds: the first call, and the best later one (wall, CPU)."""

    cold: float
    warm: float
    cpu: float


def make_case(views: int, cameras: int, seed: int = 0) -> Case:
    """Boards in random poses before cameras side by side; all corners are in the image."""
    rng = np.random.default_rng(seed)
    lens = PinholeRadtan.create(TRUTH[:4], TRUTH[4:])
    middle = BOARD.points.mean(axis=0)
    R = Rotation.from_rotvec(0.3 * rng.standard_normal((views, 3))).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    depth = rng.uniform(0.8, 1.3, views)
    place = np.stack([rng.uniform(-0.25, 0.25, views), rng.uniform(-0.12, 0.12, views), np.ones(views)], axis=1)
    t = depth[:, None] * place - R @ middle
    R_cam = Rotation.from_rotvec(np.arange(cameras)[:, None] * [0.0, 0.02, 0.0]).as_matrix()
    t_cam = np.arange(cameras)[:, None] * np.array([-0.03, 0.0, 0.0])
    detections = []
    for c in range(cameras):
        points = np.einsum("fij,nj->fni", R_cam[c] @ R, BOARD.points) + (t @ R_cam[c].T + t_cam[c])[:, None]
        pixels = np.asarray(lens.project(points)) + NOISE_PX * rng.standard_normal((views, len(BOARD.points), 2))
        frame, point = np.nonzero(np.all((pixels > 0) & (pixels < np.array(SIZE) - 1), axis=-1))
        detections.append(Detections(np.arange(views) * 50_000_000, frame, point, pixels[frame, point], SIZE))
    away = Rotation.from_rotvec(0.02 * rng.standard_normal((views, 3))).as_matrix()
    T_rig_target = (away @ R, t + 0.01 * rng.standard_normal((views, 3)))
    T_cam_rig = (R_cam, t_cam + 0.003 * np.arange(cameras)[:, None])
    frames = [camera_frames(d, BOARD, f"cam{c}") for c, d in enumerate(detections)]
    back = T_rig_target[0].swapaxes(-1, -2)
    problem, state = solving.camera_problem(
        [lens.with_parameters(START)] * cameras,
        frames,
        BOARD,
        views=[f.frames for f in frames],
        weights=[np.ones(f.seen.shape) for f in frames],
        T_cam_rig=T_cam_rig,
        T_target_rig=(back, -np.einsum("fij,fj->fi", back, T_rig_target[1])),
        loss_width=np.inf,
    )
    # The others know no prior of the lens.
    problem = eqx.tree_at(
        lambda p: p.prior.information, problem, jax.tree.map(jnp.zeros_like, problem.prior.information)
    )
    return Case(detections, frames, T_cam_rig, T_rig_target, problem, state)


def timed(call: Callable[[], Any], repeats: int = REPEATS) -> tuple[Timing, Any]:
    """Run `call` once cold and `repeats` times warm."""
    return timed_in_turn([call], repeats)[0]


def timed_in_turn(calls: Sequence[Callable[[], Any]], repeats: int = REPEATS) -> list[tuple[Timing, Any]]:
    """Run each call once cold and `repeats` times warm, in turn: a machine that is slower for a while is so for all."""
    cold, results = [], []
    for call in calls:
        start = time.perf_counter()
        results.append(call())
        cold.append(time.perf_counter() - start)
    runs: list[list[tuple[float, float]]] = [[] for _ in calls]
    for _ in range(repeats):
        for place, call in enumerate(calls):
            wall, cpu = time.perf_counter(), time.process_time()
            results[place] = call()
            runs[place].append((time.perf_counter() - wall, time.process_time() - cpu))
    return [(Timing(first, *min(own)), result) for first, own, result in zip(cold, runs, results, strict=True)]


def report(what: str, timing: Timing, cost: float, ratio: float | None = None, more: str = "") -> None:
    """One row of the table."""
    against = "" if ratio is None else f"{ratio:.1f}"
    print(
        f"| {what} | {timing.cold:.3f} | {timing.warm:.4f} | {timing.cpu:.4f} | {cost:.6g} | {against} | {more} |",
        flush=True,
    )


def opencv_inputs(frames: CameraFrames) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Board points and pixels per view, as cv2 wants them (single precision)."""
    points = [BOARD.points[seen].astype(np.float32)[:, None] for seen in frames.seen]
    pixels = [p[seen].astype(np.float32)[:, None] for p, seen in zip(frames.pixels, frames.seen, strict=True)]
    return points, pixels


def optimised(case: Case) -> SolveResult:
    """The optimum from the common start, with the first steps of `calibrate_cameras`."""
    return solve(case.problem, case.state, damping=START_DAMPING)


def start_matrix() -> np.ndarray:
    """The start's camera matrix (3, 3), for OpenCV."""
    return np.array([[START[0], 0, START[2]], [0, START[1], START[3]], [0, 0, 1.0]])


def calibrate_opencv(points: list[np.ndarray], pixels: list[np.ndarray]) -> float:
    """cv2.calibrateCamera from the common start; cost as half the sum of squares."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    rms, *_ = cv2.calibrateCamera(
        points, pixels, SIZE, start_matrix(), np.zeros(5), flags=flags, criteria=(3, 100, 1e-12)
    )
    return 0.5 * rms**2 * sum(len(p) for p in points)


def bench_mono() -> None:
    """One camera, 40 and 200 views, beside `cv2.calibrateCamera` from the same start."""
    for views in (40, 200):
        case = make_case(views, 1)
        inputs = opencv_inputs(case.cameras[0])
        (ours, result), (theirs, cost) = timed_in_turn(
            [
                lambda case=case: optimised(case),
                lambda inputs=inputs: calibrate_opencv(*inputs),
            ],
            MONO_REPEATS,
        )
        steps = f"{int(result.iterations)} iterations"
        report(f"jaxcal, {views} views", ours, float(result.equations.cost), theirs.warm / ours.warm, steps)
        report(f"cv2.calibrateCamera, {views} views", theirs, cost)


def bench_rig() -> None:
    """Four cameras, 200 and 1000 views, beside Ceres and OpenCV 5."""
    for views in (200, 1000):
        case = make_case(views, 4)
        ours, result = timed(lambda case=case: optimised(case))
        steps = f"{int(result.iterations)} iterations"
        report(f"jaxcal, 4 cameras x {views} views", ours, float(result.equations.cost), None, steps)
        _bench_ceres(case, views, ours)
        if views == 200:
            _bench_multiview(case, views, ours)


def _bench_ceres(case: Case, views: int, ours: Timing) -> None:
    try:
        from ceres_reference import solve_with_ceres
    except ImportError:
        print("| Ceres | not installed: pip install jaxcal[bench] | | | | | |")
        return
    frames = [
        (c, int(view), np.flatnonzero(seen), pixels[seen])
        for c, camera in enumerate(case.cameras)
        for view, seen, pixels in zip(camera.frames, camera.seen, camera.pixels, strict=True)
    ]
    lenses = np.tile(START, (len(case.cameras), 1))
    run = solve_with_ceres(BOARD.points, frames, lenses, case.T_cam_rig, case.T_rig_target)
    more = f"{run.iterations} iterations; {run.evaluation_s:.2f} s in residuals, {run.linear_solver_s:.2f} s in algebra"
    report(
        f"Ceres, 4 cameras x {views} views",
        Timing(run.wall_s, run.wall_s, run.cpu_s),
        run.cost,
        run.wall_s / ours.warm,
        more,
    )


def _bench_multiview(case: Case, views: int, ours: Timing) -> None:
    """OpenCV calibrates each camera by itself first, then all together; it takes no start for the poses. One run."""
    whole = case.cameras
    mask = np.zeros((len(whole), views), dtype=np.uint8)
    pixels = []
    for c, frames in enumerate(whole):
        mask[c, frames.frames] = 255
        per_view = np.full((views, len(BOARD.points), 2), -1.0, dtype=np.float32)
        per_view[frames.frames] = np.where(frames.seen[..., None], frames.pixels, -1.0)
        pixels.append([view.reshape(-1, 1, 2) for view in per_view])
    points = [BOARD.points.astype(np.float32)] * views

    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    multiview: Any = cv2.calibrateMultiview  # its type hints want poses that it makes itself

    def call() -> float:
        rms, *_ = multiview(
            points,
            pixels,
            [SIZE] * len(whole),
            mask,
            np.zeros((len(whole), 1), dtype=np.uint8),
            [start_matrix() for _ in whole],
            [np.zeros(5) for _ in whole],
            None,
            None,
            flagsForIntrinsics=np.full((len(whole), 1), flags, dtype=np.int32),
            flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        )
        return 0.5 * rms**2 * sum(int(frames.seen.sum()) for frames in whole)

    try:
        wall, cpu = time.perf_counter(), time.process_time()
        cost = call()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    except cv2.error as error:
        print(f"| cv2.calibrateMultiview | refused: {str(error).splitlines()[0]} | | | | | |")
        return
    report(f"cv2.calibrateMultiview, 4 cameras x {views} views", Timing(wall, wall, cpu), cost, wall / ours.warm)


def bench_batch() -> None:
    """Many calibrations with fresh noise in one compiled call, beside as many of OpenCV's."""
    case = make_case(40, 1)
    rng = np.random.default_rng(1)
    (data,) = case.problem.corners
    noise = NOISE_PX * rng.standard_normal((BATCH, *data.pixels.shape))

    @eqx.filter_jit
    def all_of_them(problem: RigProblem, state: RigState, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
        def one(shift: jax.Array) -> tuple[jax.Array, jax.Array]:
            moved = eqx.tree_at(lambda p: p.corners[0].pixels, problem, problem.corners[0].pixels + shift)
            result = solve_inside(moved, state, damping=START_DAMPING)
            return result.state.lenses[0][0], result.equations.cost

        return jax.lax.map(one, noise)

    def ours_call() -> Any:
        with single_threaded_blas():
            return jax.block_until_ready(all_of_them(case.problem, case.state, jnp.asarray(noise)))

    ours, (_, costs) = timed(ours_call)
    frames = case.cameras[0]
    inputs = []
    for shift in noise:
        moved = frames.pixels + shift[: len(frames.frames)].swapaxes(1, 2)
        renoised = CameraFrames(frames.detections, frames.frames, frames.time_ns, moved, frames.seen)
        inputs.append(opencv_inputs(renoised))
    theirs, total = timed(lambda: sum(calibrate_opencv(*each) for each in inputs), repeats=1)
    report(f"jaxcal, {BATCH} calibrations of 40 views", ours, float(jnp.sum(costs)), theirs.warm / ours.warm)
    report(f"cv2.calibrateCamera, {BATCH} times", theirs, total)


WHOLE = """
import time, jaxcal
detections, board = jaxcal.Detections.load({path!r}), jaxcal.Checkerboard(rows={rows}, cols={cols}, spacing={spacing})
calibrate = jaxcal.calibrate_cameras
start = time.perf_counter()
calibration = calibrate([detections], board)
print(time.perf_counter() - start, calibration.cameras[0].reprojection_rms_px, flush=True)
"""


def make_detections(views: int, cameras: int) -> list[Detections]:
    """The corners of a case alone."""
    return make_case(views, cameras).detections


def bench_whole() -> None:
    """`calibrate_cameras` from corners in a file, in new processes."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/corners.npz"
        make_detections(40, 1)[0].save(path)
        script = WHOLE.format(path=path, rows=BOARD.rows, cols=BOARD.cols, spacing=BOARD.spacing)
        for _ in range(4):
            start = time.perf_counter()
            with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                call, rms = (float(x) for x in process.stdout.readline().split())
                result = time.perf_counter() - start
                process.wait()
                rows.append((result, call, time.perf_counter() - start, rms))
    for label, row in (("first run", rows[0]), ("later run, programs from the disk", min(rows[1:]))):
        print(
            f"| calibrate_cameras, 40 views, new process, {label} | | {row[0]:.2f} | | | | the call itself "
            f"{row[1]:.2f} s; the process gone after {row[2]:.2f} s; rms {row[3]:.3f} px |",
            flush=True,
        )


def peak_mib() -> float:
    """Peak memory of this process, MiB; getrusage would tell that of the process that started it, if larger."""
    status = Path("/proc/self/status")
    if not status.exists():  # not Linux
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024


def bench_memory() -> None:
    """Peak memory over the number of views."""
    for views in (100, 1000, 4000):
        code = (
            f"import sys; sys.path.insert(0, {FOLDER!r}); import bench_cameras as b; "
            f"case = b.make_case({views}, 1); b.optimised(case); print(b.peak_mib())"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        print(f"| peak memory, one camera x {views} views | | | | | | {float(done.stdout):.0f} MiB |", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run (default: all)")
    chosen = parser.parse_args().only
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}, ", end="")
    print(f"OpenCV {cv2.__version__}, jaxcal {jaxcal.__version__}\n")
    print("| what | cold s | warm s | CPU s | cost | ratio | |\n|---|---|---|---|---|---|---|")
    parts = {"mono": bench_mono, "rig": bench_rig, "batch": bench_batch, "whole": bench_whole, "memory": bench_memory}
    for part in chosen:
        parts[part]()
    print(f"\npeak memory of this process {peak_mib():.0f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
