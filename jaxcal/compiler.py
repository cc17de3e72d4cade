"""Which of XLA's code generators compiles for the CPU: the one that is quicker by a third, and right."""

import os

import jaxlib.version
from jaxlib import xla_client

# XLA's newer generator of CPU code takes up to half as long again for this project's programs, which then run no
# faster, and once summed slices wrongly (calibration/equations.py). Releases that know the older one, as far as tested:
_FLAG, _FIRST_WITHOUT = "xla_cpu_use_fusion_emitters", (0, 11)


def choose_code_generator() -> None:
    """Set the flag for this process, unless the user's XLA_FLAGS have an opinion, or jax has compiled already.

    XLA reads its flags once, and from here on: XLA_FLAGS have to be set before jaxcal is imported. The environment is
    as before afterwards: in a process with another jaxlib, to which an unknown flag is fatal, it must not be found.
    """
    release = tuple(int(part) for part in jaxlib.version.__version__.split(".")[:2])
    before = os.environ.get("XLA_FLAGS")
    if release >= _FIRST_WITHOUT or _FLAG in (before or ""):
        return
    os.environ["XLA_FLAGS"] = f"{before or ''} --{_FLAG}=false".strip()
    try:
        xla_client.CompileOptions()  # reads them
    finally:
        if before is None:
            del os.environ["XLA_FLAGS"]
        else:
            os.environ["XLA_FLAGS"] = before
