"""Shared fixtures: the real recordings, and loud deselection of their tests where they are absent."""

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from jaxlib import xla_client

from jaxcal.programs import forget_programs

_VARIABLE = "XLA_FLAGS"
_FEW_PASSES = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "

# Most of the suite's time is XLA's compiler at work on programs that run once or twice; with fewer passes the suite
# took 25 minutes in place of 31. Set here, and so inherited by pytest-xdist's processes, in which XLA has read it
# before they come to this file (as it has here: a run in one process compiles as usual).
if not os.environ.get(_VARIABLE, "").startswith(_FEW_PASSES):
    os.environ[_VARIABLE] = _FEW_PASSES + os.environ.get(_VARIABLE, "")


def _compile_as_usual_in_other_processes() -> None:
    """What a test starts as a process of its own (the main job, the command line) compiles as a user's does."""
    xla_client.CompileOptions()  # XLA reads the variable when it is first asked, and never again
    os.environ[_VARIABLE] = os.environ[_VARIABLE].removeprefix(_FEW_PASSES)


def _data_folder() -> Path | None:
    value = os.environ.get("JAXCAL_DATA")
    return Path(value).resolve() if value else None


def pytest_configure(config: pytest.Config) -> None:
    if not config.getoption("numprocesses", None):  # this process runs tests
        _compile_as_usual_in_other_processes()
    folder = _data_folder()
    if folder is not None and not folder.is_dir():
        raise pytest.UsageError(f"JAXCAL_DATA is {folder}, which is not a folder.")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    _slow_files_first(items)
    if _data_folder() is not None:
        return
    real = [item for item in items if item.get_closest_marker("real_data")]
    if real:
        config.hook.pytest_deselected(items=real)
        items[:] = [item for item in items if not item.get_closest_marker("real_data")]
        config.stash[_DESELECTED] = len(real)


def _slow_files_first(items: list[pytest.Item]) -> None:
    """Files stay whole, those with most slow tests in front: a long file that comes last leaves the other process idle
    (pytest-xdist's own order, by the number of tests of any kind, has them last)."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


_DESELECTED = pytest.StashKey[int]()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    count = config.stash.get(_DESELECTED, 0)
    if count:
        terminalreporter.write_sep("!", f"{count} tests on REAL DATA deselected: set JAXCAL_DATA to the data folder")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real recordings."""
    folder = _data_folder()
    assert folder is not None, "tests that use this fixture are marked real_data"
    return folder


@pytest.fixture(scope="module", autouse=True)
def _forget_programs() -> Iterator[None]:
    """Let go of a module's compiled programs: a process that keeps those of all modules runs out of memory maps, and
    XLA then crashes while it compiles."""
    yield
    forget_programs()
    jax.clear_caches()
