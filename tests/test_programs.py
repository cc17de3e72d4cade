"""Programs that outlive the process: found again, the same, and never taken for one another."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal import programs
from jaxcal.cameras import CameraModel, DoubleSphere, PinholeRadtan
from jaxcal.cameras.refit import _equations
from jaxcal.results.rays import _look_through

RNG = np.random.default_rng(0)
RAYS = np.concatenate([RNG.uniform(-0.4, 0.4, (50, 2)), np.ones((50, 1))], axis=1)
PIXELS = RNG.uniform(0.0, 400.0, (50, 2))
NUMBERS = (300.0, 301.0, 320.0, 240.0), (-0.1, 0.02, 1e-3, -1e-3)
LENS = PinholeRadtan.create(*NUMBERS)


class OfTheUser(PinholeRadtan):
    """A lens whose source is not jaxcal's."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> Iterator[Path]:
    before = getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    programs.forget_programs()
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)
    programs.forget_programs()


def equations(lens: CameraModel = LENS, count: int = 50) -> list[np.ndarray]:
    found = _equations(lens, jnp.asarray(RAYS[:count]), jnp.asarray(PIXELS[:count]), jnp.ones(count))
    return [np.asarray(part) for part in found]


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def same(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def never(*_: object) -> None:
    raise AssertionError("a program was made anew")


def test_a_program_is_found_again_and_is_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = equations()
    assert len(files(folder)) == 1
    # Only now: what jax's own cache has, as of a program that took long to compile, is not stored.
    plain = jax.jit(_equations.__wrapped__)(LENS, RAYS, PIXELS, jnp.ones(50))  # pyright: ignore[reportFunctionMemberAccess]
    assert same(made, [np.asarray(part) for part in plain])
    programs.forget_programs()
    monkeypatch.setattr(programs, "_make", never)
    assert same(equations(), made)
    # Once it is there, a file that vanishes is not missed.
    for path in folder.iterdir():
        path.unlink()
    assert same(equations(), made)


@pytest.mark.parametrize("content", [b"", b"no program", "truncated"])
def test_a_damaged_file_is_made_anew(folder: Path, content: bytes | str) -> None:
    made = equations()
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if isinstance(content, str) else content)
    programs.forget_programs()
    assert same(equations(), made)
    assert len(path.read_bytes()) > len(whole) // 2


def test_other_shapes_settings_and_lenses_are_other_programs(folder: Path) -> None:
    equations()
    equations(count=40)
    one = files(folder)
    assert len(one) == 2
    equations(LENS.with_parameters(LENS.parameters + 1.0))
    assert files(folder) == one  # other numbers are the same program
    eucm = DoubleSphere.from_focal(300.0, (640, 480))
    _look_through(eucm, jnp.asarray(PIXELS))
    _look_through(LENS, jnp.asarray(PIXELS))
    assert len(files(folder)) == 4


def test_a_users_lens_works_and_is_not_stored(folder: Path) -> None:
    lens = OfTheUser.create(*NUMBERS)
    assert same(equations(lens), equations())
    assert len(files(folder)) == 1


def test_nothing_is_stored_where_that_is_switched_off(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(programs.VARIABLE, "0")
    off = equations()
    assert not files(folder)
    monkeypatch.delenv(programs.VARIABLE)
    assert same(equations(), off)
    assert len(files(folder)) == 1


def test_inside_of_another_program_it_is_a_part_of_that() -> None:
    def cost(parameters: jax.Array) -> jax.Array:
        return _equations(LENS.with_parameters(parameters), jnp.asarray(RAYS), jnp.asarray(PIXELS), jnp.ones(50))[0]

    _, gradient, _ = equations()
    np.testing.assert_allclose(jax.jit(jax.grad(cost))(LENS.parameters), gradient, rtol=1e-9)


def test_another_process_finds_them(tmp_path: Path) -> None:
    script = """
import numpy as np
from jaxcal import programs
from jaxcal.cameras import PinholeRadtan
from jaxcal.results.rays import rays_through
made, make = [], programs._make
def counted(function, *rest):
    made.append(function.__name__)
    return make(function, *rest)
programs._make = counted
rays, _ = rays_through(PinholeRadtan.from_focal(300.0, (640, 480)), np.full((7, 2), 100.0))
print(made, rays.tobytes().hex())
"""
    environment = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "PATH": "", "HOME": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    assert first.stdout.startswith("['_look_through'] ")
    assert second.stdout == first.stdout.replace("['_look_through']", "[]")


def test_room_is_made_by_removing_what_was_not_used_for_longest(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir()
    for age in range(10):
        path = folder / str(age)
        path.write_bytes(b"x")
        os.utime(path, (1e9 - age, 1e9 - age))
    monkeypatch.setattr(programs, "_MOST_FILES", 10)
    equations()
    assert {"0", "7"} <= files(folder)
    assert not files(folder) & {"8", "9"}
