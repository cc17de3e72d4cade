"""`stored_jit`: compiled programs that a later process takes from the disk, without tracing the function again.

jax keeps what XLA made of a program, but finds it only by the traced program itself; and tracing takes longer than the
rest of a small calibration. Here the program is found by what it follows from: the source of jaxcal, the releases of
the libraries, the machine, and the shapes and settings of the arguments. A function with anything else in its arguments
(a camera model of the user's own, say) is jitted as by equinox, and not stored.
"""

import functools
import hashlib
import importlib.metadata
import io
import logging
import os
import pickle
import platform
import sys
import threading
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import serialize_executable
from jaxlib import xla_client

from jaxcal.atomic import write_bytes

logger = logging.getLogger(__name__)

# Set to 0 to store nothing: by who changes jaxcal's constants or functions at run time, which nothing here would see.
VARIABLE = "JAXCAL_STORED_PROGRAMS"
_LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxlie", "numpy")
# Classes and functions from these may be part of a stored program's description: their source or release is in the key.
_KNOWN = frozenset({"jaxcal", "builtins", "copyreg", *_LIBRARIES})
_WORTH_STORING_S = 0.05
_MOST_FILES = 1500

P = ParamSpec("P")
R = TypeVar("R")
_Program = Callable[[list[Any]], Any]
_COMPILING = threading.Lock()
_IN_MEMORY: list[dict[Any, _Program | None]] = []  # of each function


def stored_jit(function: Callable[P, R]) -> Callable[P, R]:
    """`equinox.filter_jit` of a function of a jaxcal module, whose programs outlive the process.

    Arguments and results are pytrees; arrays are data, all else is part of the program. Called inside of another
    program it is a part of that one. Programs lie in the folder `programs` of jax's own cache;
    `JAXCAL_STORED_PROGRAMS=0` or a switched-off cache of jax leaves them out. Only where jax has one CPU and no more.
    """
    jitted = eqx.filter_jit(function)
    programs: dict[Any, _Program | None] = {}
    _IN_MEMORY.append(programs)
    lock = threading.RLock()  # a function may call itself on numbers while it is traced

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        leaves, tree = jax.tree.flatten((args, kwargs))
        if not _may_store() or any(isinstance(leaf, Tracer) for leaf in leaves):
            return jitted(*args, **kwargs)
        arrays = [leaf for leaf in leaves if _is_array(leaf)]
        try:
            key = tree, tuple(map(_description, leaves))
            known = key in programs
        except TypeError:  # what cannot be hashed
            return jitted(*args, **kwargs)
        if not known:
            with lock:
                if key not in programs:
                    programs[key] = _program(function, leaves, tree)
        program = programs.get(key)
        return jitted(*args, **kwargs) if program is None else program(arrays)

    return call


def forget_programs() -> None:
    """Let go of all programs in memory, as `jax.clear_caches` does of jax's own."""
    for programs in _IN_MEMORY:
        programs.clear()


def _may_store() -> bool:
    # Under these jax does otherwise than to run a program.
    off = any(map(_setting, ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")))
    return not off and _folder() is not None and _on_one_cpu()


def _setting(name: str) -> Any:
    return getattr(jax.config, name)


def _folder() -> Path | None:
    cache = _setting("jax_compilation_cache_dir")
    enabled = _setting("jax_enable_compilation_cache") and os.environ.get(VARIABLE, "1") != "0"
    return Path(cache) / "programs" if cache and enabled and "://" not in cache else None


@functools.cache
def _on_one_cpu() -> bool:
    return jax.default_backend() == "cpu" and jax.device_count() == 1


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, (jax.Array, np.ndarray, np.generic))


def _description(leaf: Any) -> Any:
    """What a program depends on of one leaf of its arguments."""
    if _is_array(leaf):
        return leaf.shape, leaf.dtype, bool(getattr(leaf, "weak_type", False))
    return type(leaf).__qualname__, leaf  # 1 is not 1.0, nor True


# --- one program -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Slot:
    """Where an array belongs in a result: the first of them in the first slot."""


def _program(function: Callable[..., Any], leaves: list[Any], tree: Any) -> _Program | None:
    """The program for arguments like these: from the disk, or made and stored; None where it cannot be stored."""
    name = _name_on_disk(function, leaves, tree)
    folder = _folder()
    if name is None or folder is None:
        return None
    path = folder / name
    found = _load(path)
    if found is None:
        found = _make(function, leaves, tree, path)
    return found


def _name_on_disk(function: Callable[..., Any], leaves: list[Any], tree: Any) -> str | None:
    """Name of the file with the program; None where its arguments hold what this module cannot answer for."""
    if "<locals>" in function.__qualname__ or function.__module__.split(".")[0] not in _KNOWN:
        return None
    # A tree that names its nodes' classes and settings, with a description for each array.
    described = jax.tree.unflatten(tree, [_Described(_description(leaf)) for leaf in leaves])
    content = io.BytesIO()
    try:
        pickler = _KnownOnly(content)
        pickler.fast = True  # equal arguments have one description, whichever of their parts are one object
        pickler.dump((function.__module__, function.__qualname__, described))
    except (pickle.PicklingError, AttributeError, TypeError):
        return None
    return hashlib.sha256(_circumstances().encode() + content.getvalue()).hexdigest()


@dataclass(frozen=True)
class _Described:
    description: Any


class _KnownOnly(pickle.Pickler):
    """Pickles what consists of classes and functions whose source the key answers for."""

    def reducer_override(self, obj: Any) -> Any:
        """Refuse classes and functions of others."""
        if isinstance(obj, type) or callable(obj):
            module = getattr(obj, "__module__", None) or type(obj).__module__
            if module.split(".")[0] not in _KNOWN:
                raise pickle.PicklingError(f"{obj!r} is of {module}")
        return NotImplemented


def _make(function: Callable[..., Any], leaves: list[Any], tree: Any, path: Path) -> _Program:
    """Trace and compile the function, and store the program where that took its time."""
    places = [place for place, leaf in enumerate(leaves) if _is_array(leaf)]
    skeletons = []

    def of_arrays(arrays: list[Any]) -> list[Any]:
        everything = list(leaves)
        for place, array in zip(places, arrays, strict=True):
            everything[place] = array
        args, kwargs = jax.tree.unflatten(tree, everything)
        results, structure = jax.tree.flatten(function(*args, **kwargs))
        skeletons.append(
            jax.tree.unflatten(structure, [_Slot() if _is_array(result) else result for result in results])
        )
        return [result for result in results if _is_array(result)]

    of_arrays.__name__ = function.__name__
    start = time.perf_counter()
    lowered = jax.jit(of_arrays).trace([leaves[place] for place in places]).lower()
    compiled, is_new = _compiled(lowered)
    taken = time.perf_counter() - start
    (skeleton,) = skeletons
    if is_new and taken >= _WORTH_STORING_S and "callback" not in lowered.as_text():
        _store(path, compiled, skeleton)
    return _runner(compiled, skeleton)


def _compiled(lowered: Any) -> tuple[Any, bool]:
    """The compiled program, and whether it was compiled here. XLA writes one that it has loaded without its kernels, so
    what jax's cache had is not stored; and jax's cache does not get what is."""
    hits = _cache_hits()
    least_seconds = "jax_persistent_cache_min_compile_time_secs"
    with _COMPILING:
        before, least = hits.count, _setting(least_seconds)
        jax.config.update(least_seconds, float("inf"))
        try:
            return lowered.compile(), hits.count == before
        finally:
            jax.config.update(least_seconds, least)


class _CacheHits:
    """Counts how often jax's own cache had a program."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, event: str, **_: Any) -> None:
        self.count += event == "/jax/compilation_cache/cache_hits"


@functools.cache
def _cache_hits() -> _CacheHits:
    hits = _CacheHits()
    jax.monitoring.register_event_listener(hits)
    return hits


def _runner(compiled: Any, skeleton: Any) -> _Program:
    results, structure = jax.tree.flatten(skeleton, is_leaf=lambda leaf: isinstance(leaf, _Slot))
    slots = [place for place, result in enumerate(results) if isinstance(result, _Slot)]

    def run(arrays: list[Any]) -> Any:
        everything = list(results)
        for place, array in zip(slots, compiled(arrays), strict=True):
            everything[place] = array
        return jax.tree.unflatten(structure, everything)

    return run


# --- on the disk -----------------------------------------------------------------------------------------------------


def _store(path: Path, compiled: Any, skeleton: Any) -> None:
    """Write a program; that it cannot be written is no error, the next process makes it again."""
    try:
        content = pickle.dumps((*serialize_executable.serialize(compiled), skeleton))
        _make_room(path.parent)
        write_bytes(path, zlib.compress(content, 1))
    except Exception as error:  # whatever XLA or the disk object to
        logger.info("a program was not stored: %s", error)


def _load(path: Path) -> _Program | None:
    """The program of a file, None where there is none or it cannot be used; such a file is removed."""
    try:
        content = zlib.decompress(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, zlib.error):
        path.unlink(missing_ok=True)
        return None
    _prepare_lapack()
    try:
        *executable, skeleton = pickle.loads(content)
        compiled = serialize_executable.deserialize_and_load(*executable)
        os.utime(path)  # used just now: it stays when room is made
    except Exception as error:
        logger.info("a stored program cannot be used: %s", error)
        path.unlink(missing_ok=True)
        return None
    return _runner(compiled, skeleton)


@functools.cache
def _prepare_lapack() -> None:
    """jax makes LAPACK's functions known to XLA when it lowers the first program that calls one, which here it may
    never do."""
    try:
        from jaxlib import lapack

        lapack.prepare_lapack_call("potrf_ffi", np.dtype(np.float64))
    except (ImportError, AttributeError, TypeError):  # another release: a fifth of a second
        jax.jit(jax.numpy.linalg.cholesky).lower(jax.ShapeDtypeStruct((2, 2), np.float64))


def _make_room(folder: Path) -> None:
    """Remove the programs that have not been used for longest, where there are very many."""
    files = list(folder.glob("*")) if folder.is_dir() else []
    if len(files) >= _MOST_FILES:
        for file in sorted(files, key=lambda file: file.stat().st_mtime)[: _MOST_FILES // 5]:
            file.unlink(missing_ok=True)


@functools.cache
def _circumstances() -> str:
    """All that a program follows from besides its function and arguments."""
    source = hashlib.sha256()
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        source.update(str(path.relative_to(root)).encode() + path.read_bytes())
    releases = [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    settings = [_setting(f"jax_{name}") for name in ("enable_x64", "default_matmul_precision", "numpy_dtype_promotion")]
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    # XLA's flags as it has read them, the generator of code among them.
    flags = xla_client.CompileOptions().SerializeAsString()
    machine = [sys.version, platform.platform(), _processor(), cores, flags]
    return repr([source.hexdigest(), releases, settings, machine])


def _processor() -> str:
    """The processor and what it can do: a program for another may hold instructions that this one lacks."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        return platform.processor()
    return repr(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
