"""How jaxcal wants jax to be: double precision, programs kept on the disk, and the code generator that is quicker."""

import importlib.abc
import importlib.machinery
import os
import sys
from collections.abc import Sequence
from types import ModuleType

# XLA's newer generator of CPU code takes up to half as long again for this project's programs, which then run no
# faster, and once summed slices wrongly (calibration/equations.py). Releases that know the older one, as far as tested:
_FLAG, _FIRST_WITHOUT = "xla_cpu_use_fusion_emitters", (0, 11)


def configure_jax() -> None:
    """Configure jax, now where it is imported already, else as soon as somebody imports it.

    Importing jax takes a second, which `jaxcal --help` and commands that compute nothing need not wait for. To whoever
    imports jaxcal it makes no difference: there is no jax that is not configured.
    """
    if "jax" in sys.modules:
        _configure()
    else:
        sys.meta_path.insert(0, _ConfiguredJax())


class _ConfiguredJax(importlib.abc.MetaPathFinder):
    """Finds jax as everybody does, and has it configured once it is loaded."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """jax's spec, with a loader that configures it; None for every other module, which others find."""
        if name != "jax":
            return None
        # To be found is not to be imported: whoever asks only whether jax is there leaves this in place.
        others = [finder for finder in sys.meta_path if finder is not self]
        spec = next((s for finder in others if (s := finder.find_spec(name, path, target)) is not None), None)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_configure(module: ModuleType) -> None:
                load(module)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                    _configure()

            spec.loader.exec_module = load_and_configure  # of this one loader, which serves jax alone
        return spec


def _configure() -> None:
    import jax
    import platformdirs

    _choose_code_generator()
    # Estimation is in double precision; this is the one place that says so.
    jax.config.update("jax_enable_x64", True)
    # Compiled programs are kept between runs, unless the user has chosen a place or switched it off.
    if getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        jax.config.update("jax_compilation_cache_dir", platformdirs.user_cache_dir("jaxcal") + "/jax")
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def _choose_code_generator() -> None:
    """Set the flag for this process, unless the user's XLA_FLAGS have an opinion, or jax has compiled already.

    XLA reads its flags once, and from here on: XLA_FLAGS have to be set before jaxcal imports jax. The environment is
    as before afterwards: in a process with another jaxlib, to which an unknown flag is fatal, it must not be found.
    """
    import jaxlib.version
    from jaxlib import xla_client

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
