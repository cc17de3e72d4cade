"""Modules imported when they are first asked for, and quickly."""

import gc
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


def attribute_of(module: str, name: str) -> Any:
    """What `module`, imported now if it was not, calls `name`."""
    with collection_paused():
        return getattr(importlib.import_module(module), name)


@contextmanager
def collection_paused() -> Iterator[None]:
    """No cyclic garbage collection meanwhile.

    Importing jax, scipy and their like makes hundreds of thousands of objects, all of which stay; collections in
    between look at every one of them again and find nothing, for a sixth of the time. Afterwards all objects are of the
    oldest generation, as they would be by now: else the next two collections would look at all of them, as young ones.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            if not gc.get_freeze_count():  # what somebody has frozen stays so
                gc.freeze()
                gc.unfreeze()
            gc.enable()
