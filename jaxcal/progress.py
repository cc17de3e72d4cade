"""How long work reports its progress: one callback, so that the library never talks to a terminal."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")

# progress(stage, done, total): called often, from one thread; `stage` is a short text such as "detect cam0".
Progress = Callable[[str, int, int], None]


def no_progress(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def track(items: Iterable[Item], stage: str, total: int, progress: Progress) -> Iterator[Item]:
    """Pass `items` through and report after each one."""
    progress(stage, 0, total)
    for done, item in enumerate(items, start=1):
        yield item
        progress(stage, done, total)
