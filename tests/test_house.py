"""The rules of the house, checked on its source: who imports whom, what an import costs, what is public."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxcal

ROOT = Path(jaxcal.__file__).parents[1]

# What each room may import of ours; data moves one way. A room is a module or package directly below `jaxcal`.
EVERYWHERE = {"jaxcal.errors", "jaxcal.progress", "jaxcal.atomic", "jaxcal.imports", "jaxcal.programs"}
OBSERVATIONS = {"jaxcal.observations"}
ALLOWED: dict[str, set[str]] = {
    "jaxcal.errors": set(),
    "jaxcal.progress": set(),
    "jaxcal.atomic": set(),
    "jaxcal.child": set(),
    "jaxcal.imports": set(),
    "jaxcal.programs": {"jaxcal.atomic"},
    "jaxcal.jax_settings": set(),
    "jaxcal.observations": set(),
    "jaxcal.cameras": set(),
    "jaxcal.trajectory": set(),
    "jaxcal.targets": set(),
    "jaxcal.estimation": set(),
    "jaxcal.imu": {"jaxcal.trajectory"} | OBSERVATIONS,
    # rig.yaml names a target, and a table of corners is read with the target that it shows.
    "jaxcal.recording": {"jaxcal.targets"} | OBSERVATIONS,
    "jaxcal.detection": {"jaxcal.child", "jaxcal.targets"} | OBSERVATIONS,
    "jaxcal.results": {"jaxcal.cameras", "jaxcal.child", "jaxcal.targets"} | OBSERVATIONS,
    "jaxcal.calibration": {
        "jaxcal.cameras",
        "jaxcal.child",
        "jaxcal.trajectory",
        "jaxcal.imu",
        "jaxcal.targets",
        "jaxcal.estimation",
        "jaxcal.results",
    }
    | OBSERVATIONS,
    "jaxcal.simulation": {
        "jaxcal.cameras",
        "jaxcal.trajectory",
        "jaxcal.imu",
        "jaxcal.targets",
        "jaxcal.recording",
    }
    | OBSERVATIONS,
    # The section of a rig.yaml that holds a job's arguments, which are the job's to name.
    "jaxcal.job_options": {"jaxcal.recording", "jaxcal.calibration", "jaxcal.results", "jaxcal.targets"},
    "jaxcal.event_frames": {"jaxcal.recording", "reconstruction"} | OBSERVATIONS,
    "jaxcal.pipeline": {
        "jaxcal.event_frames",
        "jaxcal.job_options",
        "jaxcal.recording",
        "jaxcal.detection",
        "jaxcal.calibration",
        "jaxcal.results",
        "jaxcal.cameras",
        "reconstruction",
    }
    | OBSERVATIONS,
    # A study of recordings walks the corridor for each of them, and board and lenses are named in its file.
    "jaxcal.studies": {
        "jaxcal.calibration",
        "jaxcal.cameras",
        "jaxcal.estimation",
        "jaxcal.imu",
        "jaxcal.pipeline",
        "jaxcal.recording",
        "jaxcal.results",
        "jaxcal.simulation",
        "jaxcal.targets",
    }
    | OBSERVATIONS,
    # Sphinx's configuration, beside the pages.
    "jaxcal.docs": set(),
    # The command may use every room.
    "jaxcal.cli": {"jaxcal", "reconstruction"},
    "reconstruction": OBSERVATIONS,
    # The same command as `jaxcal reconstruct`, by another door.
    "reconstruction.__main__": {"jaxcal.cli"},
    "reconstruction.training": {"jaxcal.simulation.event_sensor", "reconstruction"} | OBSERVATIONS,
}


def library_files() -> list[Path]:
    return sorted(path for package in ("jaxcal", "reconstruction") for path in (ROOT / package).rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(path: Path) -> Iterator[str]:
    """Full names of the modules of ours that a file imports, anywhere in it, also where only types are checked."""
    package = module_name(path).split(".") if path.name == "__init__.py" else module_name(path).split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            # `from package import module` imports the module; `from module import name` does not add one.
            inner = [f"{base}.{alias.name}" for alias in node.names]
            found = [name if is_module(name) else base for name in inner]
        else:
            continue
        yield from (name for name in found if name.split(".")[0] in ("jaxcal", "reconstruction"))


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").is_file()


def room_of(module: str) -> str:
    """The room that a module lies in: the longest name in the table that it is, or lies below."""
    rooms = [room for room in ALLOWED if module == room or module.startswith(room + ".")]
    return max(rooms, key=len, default=module)


def may_import(room: str, module: str) -> bool:
    if room_of(module) == room:
        return True
    return any(module == name or module.startswith(name + ".") for name in ALLOWED[room] | EVERYWHERE)


def test_every_module_lies_in_a_room_of_the_table() -> None:
    rooms = {room_of(module_name(path)) for path in library_files()}
    assert rooms - {"jaxcal"} == set(ALLOWED)


@pytest.mark.parametrize("room", sorted(ALLOWED))
def test_rooms_import_only_what_lies_before_them(room: str) -> None:
    wrong = [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in library_files()
        if room_of(module_name(path)) == room
        for module in imported_modules(path)
        if not may_import(room, module)
    ]
    assert not wrong


@pytest.mark.parametrize(
    ("line", "seen"),
    [
        ("import jaxcal.calibration.cameras", "jaxcal.calibration.cameras"),
        ("from jaxcal.pipeline import run_pipeline", "jaxcal.pipeline"),
        ("from jaxcal import results", "jaxcal.results"),
        ("from ..results import text", "jaxcal.results.text"),
        ("def f():\n    import reconstruction", "reconstruction"),
    ],
)
def test_the_check_sees_every_way_to_import(
    line: str, seen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("jaxcal/cameras", "jaxcal/results", "jaxcal/calibration", "reconstruction"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("jaxcal/results/text.py", "jaxcal/calibration/cameras.py", "jaxcal/pipeline.py"):
        (tmp_path / name).touch()
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    file = tmp_path / "jaxcal" / "cameras" / "guilty.py"
    file.write_text(line)
    assert list(imported_modules(file)) == [seen]
    assert not may_import("jaxcal.cameras", seen)


def test_only_the_reconstruction_imports_torch() -> None:
    for path in library_files():
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.split(".")[0] == "torch" for name in names):
                assert module_name(path).startswith("reconstruction"), path


def test_importing_jaxcal_is_light() -> None:
    heavy = ("jax", "torch", "cv2", "matplotlib", "h5py", "scipy.optimize", "numba")
    code = f"import sys, jaxcal; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there_and_listed() -> None:
    for name in jaxcal.__all__:
        assert getattr(jaxcal, name) is not None
        assert name in dir(jaxcal)
    with pytest.raises(AttributeError, match="module 'jaxcal' has no attribute 'calibrate_everything'"):
        jaxcal.calibrate_everything  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_the_code_generator_is_chosen_and_the_environment_left_alone() -> None:
    """XLA's options as bytes, in processes of their own: flags are read once."""

    def options(code: str, flags: str) -> str:
        code = f"{code}; import os; from jaxlib import xla_client"
        code += "; print(xla_client.CompileOptions().SerializeAsString().hex(), os.environ.get('XLA_FLAGS'))"
        environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
        environment |= {"XLA_FLAGS": flags} if flags else {}
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()

    chosen, _ = options("import jax", "--xla_cpu_use_fusion_emitters=false").split(" ")
    assert options("import jaxcal, jax", "") == f"{chosen} None"
    assert options("import jax", "") != f"{chosen} None"
    other = "--xla_cpu_use_fusion_emitters=true"
    assert options("import jaxcal, jax", other) == options("import jax", other)
    beside = "--xla_cpu_multi_thread_eigen=false"
    assert options("import jaxcal, jax", beside).endswith(f" {beside}")
    assert options("import jaxcal, jax", beside) != options("import jax", beside)


@pytest.mark.parametrize(
    "imports",
    [
        "import jaxcal, jax.numpy as jnp",
        "import jax.numpy as jnp, jaxcal",
        "import jaxcal, importlib.util as u; assert u.find_spec('jax').loader; import jax.numpy as jnp",
        "import jaxcal.cameras; from jax import numpy as jnp",
    ],
)
def test_whoever_imports_jaxcal_has_jax_in_double_precision_with_programs_on_the_disk(imports: str) -> None:
    code = f"{imports}; import jax; assert jnp.zeros(1).dtype == 'float64'; assert jax.config.jax_compilation_cache_dir"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_help_needs_no_jax() -> None:
    code = "import sys; from jaxcal.cli import main; main(['--help'], standalone_mode=False)"
    code += "; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_library_modules_never_print_and_never_exit() -> None:
    forbidden = {"print", "exit", "quit", "sys.exit", "os._exit", "breakpoint"}
    calls = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node.func)}"
        for path in library_files()
        # `python -m reconstruction.training` is a command.
        if path.name != "__main__.py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in forbidden
    ]
    assert not calls


def test_every_module_says_its_purpose_first() -> None:
    silent = [path for path in library_files() if not ast.get_docstring(ast.parse(path.read_text()))]
    assert not silent
