"""How often calibration without a guess finds the optimum: simulated cameras of every model, lens, board and view set.

    python experiments/stress_initialisation.py --problems 500 --workers 2 --seed 0 --output stress_initialisation

Each problem is given to `calibrate_cameras`, which knows nothing of it but corners. The same corners, less those that
it rejected, are then solved from the true lens and poses. It reached the optimum when its cost is not above that (by
more than a millionth) and it kept the corners that nobody displaced (95 % of them). A CalibrationError, or a warning
that the optimum is uncertain, is a declared failure; anything else is a silent one. Rows go to results.csv as they
come, so that an interrupted run goes on where it stopped; table.md sums them up by model and by field of view.
"""

import argparse
import concurrent.futures
import csv
import dataclasses
import multiprocessing
import sys
import time
import typing
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import jaxcal
from jaxcal import AprilGrid, CalibrationError, CameraModel, Checkerboard, Detections, Target, camera_model
from jaxcal.calibration import solving
from jaxcal.calibration.assemble import CameraFrames, camera_frames
from jaxcal.cameras import names
from jaxcal.estimation import solve as engine_solve

IMAGE_SIZES = ((346, 260), (640, 480), (1280, 720), (2048, 1536), (4000, 3000))
# Few numbers of points and views, so that problems share compiled programs.
VIEW_COUNTS = (7, 16, 30, 60)
# Horizontal fields of view (degrees) that a model is made for, and the spread of its shape parameters there.
PINHOLE_FIELDS = (12.0, 105.0)
FIELDS = {
    "pinhole-none": (12.0, 95.0),
    "pinhole-equi": (30.0, 190.0),
    "omni-none": (30.0, 190.0),
    "omni-radtan": (30.0, 190.0),
    "ds-none": (30.0, 190.0),
    "eucm-none": (30.0, 190.0),
    "pinhole-fov": (30.0, 150.0),
    "pinhole-division": (12.0, 140.0),
    # Made for wide lenses; a narrow one leaves most of their coefficients open.
    "pinhole-rational8": (60.0, 110.0),
    "pinhole-thinprism12": (60.0, 110.0),
    "pinhole-tilted14": (60.0, 110.0),
}
MAX_STEPS = 300
TOLERANCE = 1e-6
# The share of the undisplaced corners that has to be kept.
KEPT = 0.95
TASKS_PER_PROCESS = 40


@dataclasses.dataclass(frozen=True)
class Problem:
    """A camera whose lens and poses are known, and what it saw of a board."""

    lens: CameraModel
    target: Target
    frames: CameraFrames
    R_cam_target: np.ndarray
    t_cam_target: np.ndarray
    field_deg: float
    noise_px: float
    outliers: float
    displaced: np.ndarray


@dataclasses.dataclass(frozen=True)
class Row:
    """How one problem went."""

    number: int
    model: str
    field_deg: float
    width: int
    views: int
    points: int
    noise_px: float
    outliers: float
    outcome: str
    cost: float
    cost_from_truth: float
    seconds: float
    message: str


def main() -> int:
    arguments = parse_arguments()
    file = arguments.output / "results.csv"
    arguments.output.mkdir(parents=True, exist_ok=True)
    done = {row.number for row in read_rows(file)}
    jobs = [(arguments.seed, number, arguments.models) for number in range(arguments.problems) if number not in done]
    context = multiprocessing.get_context("spawn")
    # Processes are renewed, or the compiled programs of all models fill the memory; by new pools, since a pool that
    # renews them itself stops for ever when the last one has had its share (python/cpython issue 115634).
    batch = TASKS_PER_PROCESS * arguments.workers
    with (
        file.open("a", newline="") as stream,
        tqdm(total=arguments.problems, initial=arguments.problems - len(jobs), unit="problem") as bar,
    ):
        writer = csv.writer(stream)
        if stream.tell() == 0:
            writer.writerow([field.name for field in dataclasses.fields(Row)])
        for start in range(0, len(jobs), batch):
            with concurrent.futures.ProcessPoolExecutor(arguments.workers, mp_context=context) as pool:
                some = [pool.submit(run_one, *job) for job in jobs[start : start + batch]]
                for future in concurrent.futures.as_completed(some):
                    writer.writerow(dataclasses.astuple(future.result()))
                    stream.flush()
                    bar.update()
    table = table_of(read_rows(file))
    (arguments.output / "table.md").write_text(table)
    print(table)
    return 0


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=500)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--models", nargs="*", default=names(), help="camera models (default: all built-in ones)")
    parser.add_argument("--output", type=Path, default=Path("stress_initialisation"))
    return parser.parse_args()


def run_one(seed: int, number: int, models: Sequence[str]) -> Row:
    """Make and solve problem `number`; the same numbers give the same problem anywhere."""
    rng = np.random.default_rng([seed, number])
    return solve(number, random_problem(rng, models[number % len(models)]))


# --- solving ---------------------------------------------------------------------------------------------------------


def solve(number: int, problem: Problem) -> Row:
    """Calibrate without a guess, then from the truth, and compare."""
    detections, target = problem.frames.detections, problem.target
    cost, truth, message = np.nan, np.nan, ""
    start = time.monotonic()
    try:
        found = jaxcal.calibrate_cameras([detections], target, [type(problem.lens)])
        seconds = time.monotonic() - start
        camera = found.cameras[0]
        assert camera.T_cam_target is not None
        kept = np.zeros(problem.frames.seen.shape)
        row = np.searchsorted(problem.frames.frames, detections.frame)
        kept[row, detections.point] = camera.used
        poses = camera.T_cam_target[problem.frames.frames]
        cost = least_squares(camera.model, problem, kept, poses[:, :3, :3], poses[:, :3, 3])
        truth = least_squares(problem.lens, problem, kept, problem.R_cam_target, problem.t_cam_target)
        good = kept[row, detections.point][~problem.displaced]
        doubts = [w for w in found.warnings if "optimum" in w]
        message = " ".join(doubts)
        if cost <= truth * (1.0 + TOLERANCE) and np.mean(good) >= KEPT:
            outcome = "optimum"
        else:
            outcome = "failure unnoticed" if found.converged and not doubts else "failure declared"
    except CalibrationError as error:
        seconds = time.monotonic() - start
        outcome, message = "failure declared", str(error)
    return Row(
        number,
        problem.lens.name,
        round(problem.field_deg, 1),
        detections.image_size[0],
        len(problem.frames.frames),
        len(target.points),
        round(problem.noise_px, 3),
        round(problem.outliers, 3),
        outcome,
        cost,
        truth,
        round(seconds, 3),
        message,
    )


def least_squares(
    lens: CameraModel, problem: Problem, kept: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> float:
    """The cost (half the squares, in units of the true noise) where an optimisation of the kept corners ends."""
    back = rotation.swapaxes(-1, -2)
    posed, state = solving.camera_problem(
        [lens],
        [problem.frames],
        problem.target,
        views=[np.arange(len(back))],
        weights=[kept / problem.noise_px**2],
        T_cam_rig=(np.eye(3)[None], np.zeros((1, 3))),
        T_target_rig=(back, -np.einsum("fij,fj->fi", back, translation)),
        loss_width=np.inf,
    )
    return float(engine_solve(posed, state, max_steps=MAX_STEPS).equations.cost)


# --- random problems -------------------------------------------------------------------------------------------------


def random_problem(rng: np.random.Generator, model: str) -> Problem:
    """A random lens of this model that sees a random board in random poses."""
    while True:
        size = IMAGE_SIZES[rng.integers(len(IMAGE_SIZES))]
        low, high = FIELDS.get(model, PINHOLE_FIELDS)
        field = float(np.exp(rng.uniform(np.log(low), np.log(high))) if rng.random() < 0.5 else rng.uniform(low, high))
        lens = random_lens(rng, model, np.deg2rad(field), size)
        target = random_board(rng)
        noise, outliers = float(np.exp(rng.uniform(np.log(0.05), np.log(0.5)))), float(rng.uniform(0.0, 0.05))
        seen = random_views(rng, lens, target, size, np.deg2rad(field), int(rng.choice(VIEW_COUNTS)))
        if seen is None:
            continue
        rotation, translation, pixels, visible = seen
        frame, point = np.nonzero(visible)
        measured = pixels[frame, point] + noise * rng.standard_normal((len(frame), 2))
        wrong = rng.random(len(frame)) < outliers
        angle = rng.uniform(0.0, 2.0 * np.pi, len(frame))
        away = wrong * rng.uniform(0.0, 50.0, len(frame))
        measured += away[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        measured = np.clip(measured, -0.5, np.array(size) - 0.5)
        detections = Detections(1_000_000 * np.arange(len(rotation)), frame, point, measured, size)
        frames = camera_frames(detections, target, "cam0")
        return Problem(
            lens, target, frames, rotation[frames.frames], translation[frames.frames], field, noise, outliers, wrong
        )


def random_board(rng: np.random.Generator) -> Target:
    """A checkerboard or an AprilGrid of 48 or 144 points, 0.1 to 1 m large."""
    length = float(rng.uniform(0.02, 0.1))
    boards = (
        Checkerboard(6, 8, length),
        AprilGrid(3, 4, length, 0.3),
        Checkerboard(12, 12, length),
        AprilGrid(6, 6, length, 0.3),
    )
    return boards[rng.integers(len(boards))]


def random_lens(rng: np.random.Generator, model: str, field: float, size: tuple[int, int]) -> CameraModel:
    """A lens of this model whose image is as wide as its field of view (rad) says, with off-centre axis and aspect."""
    width, height = size
    cls = camera_model(model)
    template = cls.from_focal(1.0, size)
    place = {name: i for i, name in enumerate([*template.parameter_names[0], *template.parameter_names[1]])}
    half = field / 2.0
    while True:
        values = np.array(template.parameters)
        for name, value in shape_of(rng, model, half, height / width).items():
            values[place[name]] = value
        values[[place["fx"], place["fy"], place["cx"], place["cy"]]] = [1.0, 1.0, 0.0, 0.0]
        rim = np.array([np.sin(half), 0.0, np.cos(half)])
        unit = template.with_parameters(values)
        reach = float(np.asarray(unit.project(rim))[0])
        if reach > 0 and bool(unit.is_valid(jnp.asarray(rim))):
            break
    aspect = rng.uniform(0.98, 1.02)
    focal = (width - 1) / 2.0 / reach
    values[place["fx"]], values[place["fy"]] = focal, focal * aspect
    values[place["cx"]] = (width - 1) / 2.0 + rng.uniform(-0.08, 0.08) * width
    values[place["cy"]] = (height - 1) / 2.0 + rng.uniform(-0.08, 0.08) * height
    return template.with_parameters(values)


def shape_of(rng: np.random.Generator, model: str, half: float, aspect: float) -> dict[str, float]:
    """Distortion and shape parameters of a size that real lenses have, by name."""
    # Radius on the normalised image plane at the image's corner; coefficients count by what they do there.
    radius = np.tan(min(half, np.deg2rad(60.0))) * np.hypot(1.0, aspect)
    tangential = {name: float(rng.uniform(-0.002, 0.002)) for name in ("p1", "p2")}
    k1 = float(rng.uniform(-0.25, 0.1)) / max(radius, 0.4) ** 2
    k2 = float(rng.uniform(-0.3, 0.1)) * k1 / max(radius, 0.4) ** 2
    radtan = {"k1": k1, "k2": k2, **tangential}
    # A denominator with the signs of real fits: it grows, and numerator and denominator nearly cancel.
    k4 = float(rng.uniform(0.0, 0.5)) / max(radius, 0.4) ** 2
    rational = {"k1": k1 + k4, "k2": k2 + k1 * k4, **tangential, "k3": 0.0, "k4": k4, "k5": 0.0, "k6": 0.0}
    prism = {name: float(rng.uniform(-0.003, 0.003)) for name in ("s1", "s2", "s3", "s4")}
    tilt = {name: float(rng.uniform(-0.02, 0.02)) for name in ("tau_x", "tau_y")}
    return {
        "pinhole-none": {},
        "pinhole-radtan": radtan,
        "pinhole-radtan5": {**radtan, "k3": float(rng.uniform(-0.1, 0.1)) * k1 / max(radius, 0.4) ** 4},
        "pinhole-rational8": rational,
        "pinhole-thinprism12": {**rational, **prism},
        "pinhole-tilted14": {**rational, **prism, **tilt},
        "pinhole-fov": {"w": float(rng.uniform(0.3, 0.95))},
        "pinhole-division": {"lambda": -float(rng.uniform(0.0, 0.25)) / max(radius, 0.4) ** 2},
        "pinhole-equi": {
            "k1": float(rng.uniform(-0.05, 0.05)),
            "k2": float(rng.uniform(-0.02, 0.02)),
            "k3": float(rng.uniform(-0.005, 0.005)),
            "k4": float(rng.uniform(-0.001, 0.001)),
        },
        "omni-none": {"xi": float(rng.uniform(0.5, 1.5))},
        "omni-radtan": {
            "xi": float(rng.uniform(0.7, 1.5)),
            **tangential,
            "k1": float(rng.uniform(-0.15, 0.05)) / 1.5,
            "k2": 0.0,
        },
        "ds-none": {"xi": float(rng.uniform(-0.3, 0.3)), "alpha": float(rng.uniform(0.45, 0.65))},
        "eucm-none": {"alpha": float(rng.uniform(0.4, 0.65)), "beta": float(rng.uniform(0.8, 1.3))},
    }[model]


def random_views(
    rng: np.random.Generator, lens: CameraModel, target: Target, size: tuple[int, int], field: float, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Poses (F, 3, 3), (F, 3), pixels (F, N, 2) and what is seen (F, N); None when the lens hardly sees the board."""
    tries = 6 * max(VIEW_COUNTS)
    middle = target.points.mean(axis=0)
    length = float(np.ptp(target.points[:, :2], axis=0).max())
    wanted = rng.uniform(0.05, 0.95, (tries, 2)) * (np.array(size) - 1.0)
    sight = np.asarray(lens.unproject(wanted))
    angle = np.minimum(rng.uniform(0.15, 0.8, tries) * field, np.deg2rad(110.0))
    distance = length / (2.0 * np.tan(angle / 2.0))
    rotation = facing(sight) @ tilts(rng, tries)
    translation = sight * distance[:, None] - rotation @ middle
    in_camera = np.einsum("fij,nj->fni", rotation, target.points) + translation[:, None]
    pixels, visible = visibility(lens, in_camera, size)
    visible &= (np.sum(rotation[:, :, 2] * translation, axis=1) < 0)[:, None]  # its front
    if isinstance(target, AprilGrid):
        for tag in range(target.rows * target.cols):
            corners = target.tag_points(tag)
            visible[:, corners] = visible[:, corners].all(axis=1, keepdims=True)
    else:
        visible &= visible.all(axis=1, keepdims=True)
    good = np.flatnonzero(visible.sum(axis=1) >= 12)[:count]
    if len(good) < count:
        return None
    return rotation[good], translation[good], pixels[good], visible[good]


def facing(sight: np.ndarray) -> np.ndarray:
    """Rotations (F, 3, 3) of boards that face the camera along lines of sight (F, 3)."""
    up = np.where(np.abs(sight[:, 1:2]) < 0.9, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    right = np.cross(up, -sight)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(-sight, right), -sight], axis=-1)


def tilts(rng: np.random.Generator, count: int) -> np.ndarray:
    """Turns (F, 3, 3) of a board: 0 to 55 degrees out of its plane, and any roll."""
    way, roll = rng.uniform(0.0, 2.0 * np.pi, (2, count))
    tilt = np.deg2rad(rng.uniform(0.0, 55.0, count))
    axis = np.stack([np.cos(way), np.sin(way), np.zeros(count)], axis=1)
    out_of_plane = Rotation.from_rotvec(tilt[:, None] * axis)
    return (out_of_plane * Rotation.from_rotvec(roll[:, None] * [0.0, 0.0, 1.0])).as_matrix()


def visibility(lens: CameraModel, points: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (F, N, 2) of points (F, N, 3), and which are in the image on the branch that the lens shows (F, N)."""
    flat = points.reshape(-1, 3)
    pixels = np.asarray(lens.project(flat))
    rays = np.asarray(lens.unproject(pixels))
    same = np.sum(rays * flat, axis=1) > (1.0 - 1e-9) * np.linalg.norm(flat, axis=1)
    valid = np.asarray(jax.vmap(lens.is_valid)(jnp.asarray(flat)))
    inside = np.all((pixels > 2.0) & (pixels < np.array(size) - 3.0), axis=1)
    return pixels.reshape(*points.shape[:2], 2), (same & valid & inside).reshape(points.shape[:2])


# --- the table -------------------------------------------------------------------------------------------------------


def read_rows(file: Path) -> list[Row]:
    """Rows written so far."""
    if not file.is_file():
        return []
    kinds = typing.get_type_hints(Row)
    with file.open(newline="") as stream:
        return [Row(**{key: kinds[key](value) for key, value in row.items()}) for row in csv.DictReader(stream)]


def table_of(rows: Sequence[Row]) -> str:
    """Counts of optimum / declared / unnoticed by model and by field of view, and the failures one by one."""
    bins = [(0, 30), (30, 60), (60, 90), (90, 120), (120, 150), (150, 181), (181, 361)]
    lines = [
        "| | problems | optimum | failure declared | failure unnoticed | seconds (median) |",
        "|---|---|---|---|---|---|",
    ]
    groups = [(f"{model}", [r for r in rows if r.model == model]) for model in sorted({r.model for r in rows})]
    groups += [(f"{low} to {high} degrees", [r for r in rows if low <= r.field_deg < high]) for low, high in bins]
    for title, group in [*groups, ("all", list(rows))]:
        if group:
            counts = [sum(r.outcome == o for r in group) for o in ("optimum", "failure declared", "failure unnoticed")]
            seconds = float(np.median([r.seconds for r in group]))
            lines.append(f"| {title} | {len(group)} | {' | '.join(map(str, counts))} | {seconds:.2f} |")
    lines += ["", f"jaxcal {jaxcal.__version__}. Problems that did not reach the optimum:", ""]
    lines += [
        f"- {r.number}: {r.model}, {r.field_deg} degrees, {r.width} px, {r.views} views, {r.points} points, "
        f"{r.noise_px} px noise, {100 * r.outliers:.1f} % outliers: {r.outcome}, cost {r.cost:.6g} for "
        f"{r.cost_from_truth:.6g}. {r.message}"
        for r in sorted(rows, key=lambda r: r.number)
        if r.outcome != "optimum"
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
