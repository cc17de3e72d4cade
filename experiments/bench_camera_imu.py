"""Speed of camera-IMU calibration: simulated recordings, one new process per case, so that nothing is warm by chance.

    python experiments/bench_camera_imu.py                       # four cases of 60 s, some minutes
    python experiments/bench_camera_imu.py --only mono-4
    python experiments/bench_camera_imu.py --only mono-4 --duration 60 600      # is it linear?
    python experiments/bench_camera_imu.py --gpu                 # on the GPU that jax finds, if there is one

Cases: one camera or four, 20 Hz, an AprilGrid of 144 corners (0.2 px), IMU at 200 Hz; a spline of order 4 with 20 knots
per second, or of order 6 with 100 (Kalibr's own density).

'solve' is the engine alone: the first problem that `calibrate_camera_imu` makes, from the start that it has found by
itself. 'whole' is `calibrate_camera_imu` on corners in memory, without a guess: lenses, alignment, five rounds of
solving, covariances. 'cold' is the first call in a process without compiled programs on the disk, 'disk' with them,
'warm' the best of later calls; CPU seconds are of all threads. Shares of 'solve' are measured on its parts by
themselves: assembly (`linearise`) and factorisation (with the step), times the iterations. Memory is the peak of the
process. Run it on a quiet machine: it says what else was going on.
"""

import argparse
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

import jaxcal
from jaxcal import AprilGrid, Detections, ImuNoise, ImuRecording, calibrate_camera_imu, load_imu
from jaxcal.calibration import robust
from jaxcal.estimation import SolveResult, damped_step, single_threaded_blas
from jaxcal.simulation import paper_rig, simulate_detections, simulate_imu

TARGET = AprilGrid(rows=6, cols=6, tag_size=0.055, tag_spacing=0.3)
NOISE_PX = 0.2
MODEL = "pinhole-radtan"
COMPILE_EVENTS = ("jaxpr_trace_duration", "jaxpr_to_mlir_module_duration", "backend_compile_duration")


@dataclass(frozen=True)
class Case:
    """Places of its cameras in the built-in rig, and its spline."""

    cameras: tuple[int, ...]
    order: int
    knot_rate_hz: float


CASES = {
    "mono-4": Case((1,), 4, 20.0),
    "four-4": Case((0, 1, 2, 3), 4, 20.0),
    "mono-6": Case((1,), 6, 100.0),
    "four-6": Case((0, 1, 2, 3), 6, 100.0),
}


# --- the recording ---------------------------------------------------------------------------------------------------


def write_recording(case: Case, duration_s: float, folder: Path) -> float:
    """Simulate corners and IMU into a folder; the mean number of corners per frame."""
    rig = paper_rig(duration_s=duration_s, seed=0, target=TARGET)
    rig = replace(rig, cameras=tuple(rig.cameras[place] for place in case.cameras))
    corners, frames = 0, 0
    for c in range(len(rig.cameras)):
        detections = simulate_detections(rig, c, NOISE_PX)
        detections.save(folder / f"cam{c}.npz")
        corners, frames = corners + len(detections), frames + len(detections.timestamps_ns)
    imu = simulate_imu(rig)
    np.savez(folder / "imu.npz", imu_ns=imu.timestamps_ns, gyro_rad_s=imu.gyro_rad_s, acc_m_s2=imu.accel_m_s2)
    noise = {name: getattr(imu.noise, name) for name in ImuNoise.__dataclass_fields__}
    (folder / "noise.json").write_text(json.dumps(noise))
    return corners / frames


def read_recording(case: Case, folder: Path) -> tuple[list[Detections], ImuRecording]:
    """The corners and the IMU that the simulation has written."""
    detections = [Detections.load(folder / f"cam{c}.npz") for c in range(len(case.cameras))]
    noise = ImuNoise(**json.loads((folder / "noise.json").read_text()))
    return detections, load_imu(noise, folder / "imu.npz")


# --- what is timed (in a process of its own) -------------------------------------------------------------------------


@dataclass
class Watch:
    """Marks of one `calibrate_camera_imu`: its phases (through `progress`), every solve (start, stop, CPU seconds), all
    compilation."""

    optimise: list[float] = field(default_factory=list)
    solves: list[tuple[float, float, float]] = field(default_factory=list)
    compiling: list[tuple[float, float]] = field(default_factory=list)

    def progress(self, stage: str, done: int, total: int) -> None:
        """Note when rounds of the optimisation begin (a `Progress`)."""
        if stage == "optimise":
            self.optimise.append(time.perf_counter())

    def compiled(self, event: str, duration_secs: float, **kwargs: Any) -> None:
        """Note when jax compiled (a listener of `jax.monitoring`)."""
        if event.endswith(COMPILE_EVENTS):
            now = time.perf_counter()
            self.compiling.append((now - duration_secs, now))

    def compile_s(self, start: float, stop: float) -> float:
        """Seconds of [start, stop] in which something was traced, lowered or compiled; nested ones count once."""
        total, reached = 0.0, start
        for a, b in sorted(self.compiling):
            a, b = max(a, reached), min(b, stop)
            if b > a:
                total, reached = total + b - a, b
        return total


class Solves:
    """Stands in for the engine's `solve` inside the calibration: keeps the first problem and times each call."""

    def __init__(self, watch: Watch) -> None:
        self.watch = watch
        self.engine: Callable[..., SolveResult] = robust.solve
        self.first: tuple[Any, Any, dict[str, Any]] | None = None

    def __call__(self, problem: Any, state: Any, **options: Any) -> SolveResult:
        if self.first is None:
            self.first = (problem, state, options)
        start, cpu = time.perf_counter(), time.process_time()
        result = self.engine(problem, state, **options)
        self.watch.solves.append((start, time.perf_counter(), time.process_time() - cpu))
        return result


def timed(call: Callable[[], Any]) -> tuple[float, float]:
    """Wall and CPU seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    jax.block_until_ready(call())
    return time.perf_counter() - wall, time.process_time() - cpu


def phases(watch: Watch, start: float, stop: float) -> dict[str, float]:
    """Seconds of one whole call: all of it, and its phases without what was compiled in them."""
    spans = {"initialisation": (start, watch.optimise[0]), "rounds": (watch.optimise[0], watch.optimise[-1])}
    spans["outcome"] = (watch.optimise[-1], stop)
    own = {name: b - a - watch.compile_s(a, b) for name, (a, b) in spans.items()}
    return {"total": stop - start, "compile": watch.compile_s(start, stop), **own}


def run_case(case: Case, folder: Path, repeats: int) -> dict[str, Any]:
    """Everything of one process: the first call, and with `repeats` later ones and the parts of the engine."""
    watch = Watch()
    jax.monitoring.register_event_duration_secs_listener(watch.compiled)
    solves = Solves(watch)
    robust.solve = solves
    detections, imu = read_recording(case, folder)

    def whole() -> dict[str, float]:
        watch.optimise.clear()
        watch.solves.clear()
        start = time.perf_counter()
        calibration = calibrate_camera_imu(
            detections,
            imu,
            TARGET,
            [MODEL] * len(detections),
            spline_order=case.order,
            knot_rate_hz=case.knot_rate_hz,
            progress=watch.progress,
        )
        times = phases(watch, start, time.perf_counter())
        return times | {"rms_px": float(np.mean([camera.reprojection_rms_px for camera in calibration.cameras]))}

    cpu = time.process_time()
    first = whole() | {"cpu": time.process_time() - cpu}
    a, b, cpu = watch.solves[0]
    out: dict[str, Any] = {
        "device": str(jax.devices()[0]),
        "first": first,
        "first_solve": {"total": b - a, "cpu": cpu, "compile": watch.compile_s(a, b)},
    }
    if repeats:
        runs = []
        for _ in range(repeats):
            cpu = time.process_time()
            runs.append(whole() | {"cpu": time.process_time() - cpu})
        out["warm"] = min(runs, key=lambda run: run["total"])
        out["peak_mib"] = peak_mib()
        out["solve"] = engine_alone(solves, repeats)
    else:
        out["peak_mib"] = peak_mib()
    return out


def engine_alone(solves: Solves, repeats: int) -> dict[str, float]:
    """Warm seconds of the first problem's solve, and of one assembly and one factorisation in it."""
    assert solves.first is not None
    problem, state, options = solves.first
    result = solves.engine(problem, state, **options)
    wall, cpu = min(timed(lambda: solves.engine(problem, state, **options)) for _ in range(repeats))
    assemble = eqx.filter_jit(lambda problem, state: problem.linearise(state))
    factorise = eqx.filter_jit(damped_step)
    with single_threaded_blas():
        equations = jax.block_until_ready(assemble(problem, state))
        assembly = min(timed(lambda: assemble(problem, state)) for _ in range(repeats + 1))[0]
        damping = jax.numpy.asarray(1e-4)
        factorisation = min(timed(lambda: factorise(equations, damping)) for _ in range(repeats + 1))[0]
    return {
        "wall": wall,
        "cpu": cpu,
        "iterations": int(result.iterations),
        "assembly": assembly,
        "factorisation": factorisation,
        "cost": float(result.equations.cost),
    }


def peak_mib() -> float:
    """Peak memory of this process, MiB; getrusage would tell that of the process that started it, if larger."""
    status = Path("/proc/self/status")
    if not status.exists():  # not Linux
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024


# --- the table -------------------------------------------------------------------------------------------------------


def in_new_process(mode: str, name: str, duration_s: float, folder: Path, repeats: int, gpu: bool) -> Any:
    """Run a part of this script in a process of its own, with the folder's compiled programs."""
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(folder / "programs"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    }
    if mode == "run":
        environment["JAX_PLATFORMS"] = "cuda" if gpu else "cpu"
    own = ["--child", mode, "--only", name, "--duration", str(duration_s), "--folder", str(folder)]
    done = subprocess.run(
        [sys.executable, __file__, *own, "--repeats", str(repeats)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{name}, {duration_s:g} s: {done.stderr.strip()[-3000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def bench(name: str, duration_s: float, repeats: int, gpu: bool) -> None:
    """One case: a process without programs on the disk, and one with; their rows of the table."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        corners = in_new_process("record", name, duration_s, folder, 0, gpu)
        # The simulation's programs are no part of the calibration's first call.
        shutil.rmtree(folder / "programs", ignore_errors=True)
        load = os.getloadavg()[0]
        cold = in_new_process("run", name, duration_s, folder, 0, gpu)
        disk = in_new_process("run", name, duration_s, folder, repeats, gpu)
    solve, warm, first = disk["solve"], disk["warm"], cold["first"]
    steps = solve["iterations"]
    assembly, factorisation = (steps * solve[part] / solve["wall"] for part in ("assembly", "factorisation"))
    print(
        f"| {name} solve | {duration_s:g} | {cold['first_solve']['total']:.2f} | {disk['first_solve']['total']:.2f} "
        f"| {solve['wall']:.3f} | {solve['cpu']:.3f} | {steps} iterations; assembly {assembly:.0%}, factorisation "
        f"{factorisation:.0%}; cold: compile {cold['first_solve']['compile'] / cold['first_solve']['total']:.0%}, "
        f"CPU {cold['first_solve']['cpu']:.1f} s; cost {solve['cost']:.6g} | |"
    )
    print(
        f"| {name} whole | {duration_s:g} | {first['total']:.2f} | {disk['first']['total']:.2f} | {warm['total']:.3f} "
        f"| {warm['cpu']:.3f} | cold: {_shares(first)}, CPU {first['cpu']:.1f} s; warm: {_shares(warm)}; "
        f"rms {warm['rms_px']:.4f} px | {disk['peak_mib']:.0f} |",
    )
    print(
        f"<!-- {name}: {corners:.1f} corners per frame; {disk['device']}; load before {load:.1f}, peak of the cold "
        f"process {cold['peak_mib']:.0f} MiB -->",
        flush=True,
    )


def _shares(run: dict[str, float]) -> str:
    names = ("compile", "initialisation", "rounds", "outcome")
    return ", ".join(f"{name} {run[name] / run['total']:.0%}" for name in names)


def has_gpu() -> bool:
    """Asked in a process of its own, since jax takes most of a GPU's memory as soon as it looks."""
    code = "import jax; jax.devices('gpu')"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="cases to run (default: all)")
    parser.add_argument("--duration", nargs="+", type=float, default=[60.0], help="seconds of recording (60)")
    parser.add_argument("--repeats", type=int, default=3, help="warm calls, of which the best counts (3)")
    parser.add_argument("--gpu", action="store_true", help="run on a GPU")
    parser.add_argument("--child", choices=("record", "run"), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.child == "record":
        print(json.dumps(write_recording(CASES[chosen.only[0]], chosen.duration[0], chosen.folder)))
        return 0
    if chosen.child == "run":
        print(json.dumps(run_case(CASES[chosen.only[0]], chosen.folder, chosen.repeats)))
        return 0
    if chosen.repeats < 1:
        parser.error("--repeats: at least 1")
    if chosen.gpu and not has_gpu():
        parser.error("--gpu: jax finds none here (pip install 'jax[cuda12]' on a machine that has one)")
    print(
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, ", end=""
    )
    print(f"jax {jax.__version__}, jaxcal {jaxcal.__version__}\n")
    print("| what | recording s | cold s | disk s | warm s | CPU s | | peak MiB |\n|---|---|---|---|---|---|---|---|")
    for duration in chosen.duration:
        for name in chosen.only:
            bench(name, duration, chosen.repeats, chosen.gpu)
    print("\nA load above 0.5 before a case says that others were computing: its times are worth little then.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
