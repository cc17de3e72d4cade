"""Shared fixtures: the real recordings, and loud deselection of their tests where they are absent."""

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from jaxcal.programs import forget_programs


def _data_folder() -> Path | None:
    value = os.environ.get("JAXCAL_DATA")
    return Path(value).resolve() if value else None


def pytest_configure(config: pytest.Config) -> None:
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
