"""Every code block of README and pages is used here.

Run whole: all python blocks, save that the calls in `_no_long_work` (calibrations, simulation) are only held against
their signatures; `jaxcal target` and `jaxcal convert`. Read by the real readers: all yaml blocks. Parsed by the real
parsers, with every option and argument, and not run: all other `jaxcal` commands, and scripts of `experiments/`. Only
looked at: `pip install` (its extras must exist) and the words of the shell in `_SHELL`.
"""

import argparse
import os
import re
import runpy
import sys
import tomllib
import types
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from code_blocks import ROOT, Block, blocks, commands, furnish, stand_in, synthetic, touch

import jaxcal
import jaxcal.calibration
import jaxcal.simulation
from jaxcal.cli import main
from jaxcal.imu import imu_model
from jaxcal.job_options import job_options
from jaxcal.recording.imu import load_noise
from jaxcal.results import load_camchain
from jaxcal.studies import load_study

_LANGUAGES = ("bash", "python", "yaml", "text")
_RUN_WHOLE = ("target", "convert")
_SHELL = ("cat", "export", "grep", "head", "ls", "printf")


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rig")
    furnish(folder)
    return folder


@pytest.fixture
def room(furnished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of a block: all that it names is there."""
    for path in furnished.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("JAXCAL_DATA", str(tmp_path / "recordings"))
    return tmp_path


def test_every_block_has_a_language_that_is_tested_here() -> None:
    assert len(blocks("python")) > 8
    assert len(blocks("bash")) > 20
    wrong = [str(block) for block in blocks() if block.kind not in _LANGUAGES and not block.kind.startswith("{")]
    assert not wrong


# --- bash ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", blocks("bash"), ids=str)
def test_commands_are_understood(block: Block, room: Path) -> None:
    found = list(commands(block.code))
    assert found
    for words in found:
        check_command(words)


def check_command(words: list[str]) -> None:
    program, rest = words[0], [os.path.expandvars(word) for word in words[1:]]
    if program == "jaxcal":
        if rest[0] in _RUN_WHOLE and all(Path(word).exists() for word in rest if word.startswith("out/")):
            done = CliRunner().invoke(main, rest)
            assert done.exit_code == 0, done.output
        else:
            parse_click(main, rest)
    elif program == "python":
        parse_script(rest)
    elif program == "pip":
        check_install(rest)
    else:
        assert program in _SHELL, f"{program}: no test knows what to do with it"


def parse_click(command: click.Command, words: list[str]) -> None:
    """All options and arguments, as when the command is run."""
    context = click.Context(command)
    while isinstance(command, click.Group):
        inner = command.get_command(context, words[0])
        assert inner is not None, f"jaxcal {words[0]}: no such command"
        command, words = inner, words[1:]
    command.make_context(command.name, list(words))


class _Parsed(Exception):
    """The script has read its arguments."""


def parse_script(words: list[str]) -> None:
    """A script's or module's own parser reads the arguments; then it is stopped."""
    if words[:2] == ["-m", "reconstruction"]:  # the same command by another door
        parse_click(main, ["reconstruct", *words[2:]])
        return
    if words[:2] in (["-m", "pytest"], ["-m", "sphinx"]):
        return
    original = argparse.ArgumentParser.parse_args

    def parse(self: argparse.ArgumentParser, *given: object, **named: object) -> None:
        original(self, *given, **named)  # pyright: ignore[reportArgumentType, reportCallIssue]
        raise _Parsed

    is_module = words[0] == "-m"
    name, arguments = (words[1], words[2:]) if is_module else (words[0], words[1:])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse)
        patch.setattr(sys, "argv", [name, *arguments])
        patch.syspath_prepend(str(ROOT / "experiments"))
        start = (lambda: runpy.run_module(name, run_name="__main__")) if is_module else _script(name)
        with pytest.raises(_Parsed):
            start()


def _script(name: str) -> Callable[[], object]:
    return lambda: runpy.run_path(str(ROOT / name), run_name="__main__")


def check_install(words: list[str]) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert words[0] == "install"
    named = re.search(r"\[([\w,]+)\]", words[-1])
    assert named is None or set(named[1].split(",")) <= set(extras)
    assert words[-1].partition("[")[0] in (".", "jaxcal")


@pytest.mark.parametrize(
    "wrong",
    [
        "jaxcal calibrate rig.yaml --ouput out/",
        "jaxcal calibrat rig.yaml",
        "jaxcal detect --target board.yaml",
        "jaxcal calibrate-cameras --models --out out/",
        "python experiments/view_selection.py --no-such-option",
        'pip install "jaxcal[none]"',
        "rm out/",
    ],
)
def test_a_mistake_in_a_command_is_seen(wrong: str, room: Path) -> None:
    (words,) = commands(wrong)
    with pytest.raises((click.UsageError, AssertionError, SystemExit)):
        check_command(words)


def test_commands_are_taken_apart() -> None:
    code = 'A=1 jaxcal info "a b" --json > out.json   # a remark\ncat x | grep "a|b" && ls\njaxcal detect \\\n  d\n'
    assert list(commands(code)) == [
        ["jaxcal", "info", "a b", "--json"],
        ["cat", "x"],
        ["grep", "a|b"],
        ["ls"],
        ["jaxcal", "detect", "d"],
    ]


# --- yaml ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", blocks("yaml"), ids=str)
def test_yaml_is_read(block: Block, room: Path) -> None:
    content = yaml.safe_load(block.code)
    file = room / "block.yaml"
    file.write_text(block.code)
    if "cameras" in content:
        read_rig(block, file, content)
    elif "kind" in content:
        assert load_study(file).kind == content["kind"]
    elif "target_type" in content:
        assert jaxcal.load_target(file).points.shape[1] == 3
    elif "gyroscope_noise_density" in content:
        assert load_noise(file).gyro_noise_density > 0
    else:
        assert [camera.name for camera in load_camchain(file)] == list(content)


def read_rig(block: Block, file: Path, content: dict) -> None:
    """rig.yaml, with the files that it names, the models and the arguments of its job."""
    for entry in [*content["cameras"], *content.get("imus", []), content.get("imu", {}), content]:
        for key in ("events", "frames", "detections", "data", "noise", "target"):
            if isinstance(entry.get(key), str):
                touch(os.path.expandvars(entry[key]), file.parent)
    write_models(block, file.parent)
    rig = jaxcal.load_rig(file)
    assert [camera.name for camera in rig.cameras] == [camera["name"] for camera in content["cameras"]]
    for camera in rig.cameras:
        jaxcal.camera_model(camera.model)
    for imu in rig.imus:
        imu_model(imu.model)
    job = jaxcal.calibrate_camera_imu if rig.imus else jaxcal.calibrate_cameras
    job_options(job, rig.calibration, "calibration", file.parent, rig.target)


def write_models(block: Block, folder: Path) -> None:
    """The page's own camera model, in the file that the page has it saved as."""
    for other in blocks("python"):
        if other.page == block.page and "(jaxcal.CameraModel)" in other.code:
            (folder / "mymodels.py").write_text(other.code)


# --- python ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", sorted({block.page for block in blocks("python")}), ids=lambda page: page.stem)
def test_python_runs(page: Path, room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page, one after another in one module."""
    _no_long_work(monkeypatch)
    module = types.ModuleType("page_of_the_docs")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    # "One window of events", in the README's words.
    module.__dict__.update(x=np.arange(100), y=np.arange(100), t_us=np.arange(100) * 300, p=np.arange(100) % 2 == 0)
    for block in blocks("python"):
        if block.page == page:
            exec(compile(block.code, str(block), "exec"), module.__dict__)


def _no_long_work(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, with_imu in (("calibrate_cameras", False), ("calibrate_camera_imu", True)):
        stand_in(
            monkeypatch, jaxcal, name, lambda detections, with_imu=with_imu, **_: synthetic(len(detections), with_imu)
        )
    stand_in(monkeypatch, jaxcal.simulation, "write_recording", lambda rig, folder, **_: Path(folder) / "rig.yaml")
    stand_in(
        monkeypatch,
        jaxcal.calibration,
        "held_back_residuals",
        lambda calibration, detections, **_: [np.zeros_like(d.pixels) for d in detections],
    )
