"""Tests in a real browser: run where there is a Chromium, deselected, loudly, where there is none."""

import shutil

import pytest

_DESELECTED = pytest.StashKey[int]()
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def _chromium() -> str | None:
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "browser: opens pages in Chromium; deselected, loudly, where there is none")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if _chromium() is not None:
        return
    mine = [item for item in items if item.get_closest_marker("browser")]
    if mine:
        config.hook.pytest_deselected(items=mine)
        items[:] = [item for item in items if not item.get_closest_marker("browser")]
        config.stash[_DESELECTED] = len(mine)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    count = config.stash.get(_DESELECTED, 0)
    if count:
        terminalreporter.write_sep("!", f"{count} tests in a BROWSER deselected: install Chromium")


@pytest.fixture(scope="session")
def chromium() -> str:
    """The path of a Chromium."""
    path = _chromium()
    assert path is not None, "tests that use this fixture are marked browser"
    return path
