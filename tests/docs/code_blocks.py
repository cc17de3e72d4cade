"""Code blocks of the README and the pages: finding them, and a folder that holds what they name."""

import inspect
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import jaxcal
from jaxcal.recording.places import split_place

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "jaxcal" / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
_BLOCK = re.compile(r"^```(?P<kind>[^\n]*)\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """One fenced block: the page, the number of its first line, its language, its text."""

    page: Path
    line: int
    kind: str
    code: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(kind: str | None = None) -> list[Block]:
    """All fenced blocks, or those of one language."""
    found = []
    for page in PAGES:
        text = page.read_text()
        for match in _BLOCK.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            found.append(Block(page, line, match["kind"], match["code"]))
    return [block for block in found if kind in (None, block.kind)]


def commands(code: str) -> Iterator[list[str]]:
    """The simple commands of a bash block as words, without comments, assignments and redirections."""
    for line in code.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        words: list[str] = []
        for word in [*lexer, ";"]:
            if word not in ("&&", "|", ";"):
                words.append(word)
                continue
            if ">" in words:
                words = words[: words.index(">")]
            while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
                words.pop(0)
            if words:
                yield words
            words = []


# --- what the blocks find around them --------------------------------------------------------------------------------


def synthetic(cameras: int, with_imu: bool) -> jaxcal.Calibration:
    """A calibration made up by the tests of the results' room."""
    sys.path.insert(0, str(ROOT / "tests" / "results"))
    try:
        from synthetic_calibration import make_calibration
    finally:
        sys.path.pop(0)
    return make_calibration(cameras, with_imu, frames=30)


def furnish(folder: Path) -> None:
    """The files that the blocks name, as small as they may be."""
    made = synthetic(2, True)
    made.save(folder / "out")
    made.save(folder / "last_month")
    synthetic(1, False).save(folder / "lens")
    for number, camera in enumerate(made.cameras):
        camera.detections.save(folder / f"cam{number}.npz")
        camera.detections.save(folder / f"cam{number}.detections.npz")
    for name in ("target.yaml", "board.yaml", "april.yaml"):
        (folder / name).write_text(yaml.safe_dump(made.target.to_yaml()))
    (folder / "imu.yaml").write_text(yaml.safe_dump(NOISE))
    (folder / "imu0").mkdir()
    times = (np.arange(50) * 5_000_000).tolist()
    rows = [f"{t},0,0,0,0,0,9.81" for t in times]
    (folder / "imu0" / "data.csv").write_text("\n".join(["#timestamp [ns],w,w,w,a,a,a", *rows]) + "\n")


NOISE = {
    "accelerometer_noise_density": 2e-3,
    "accelerometer_random_walk": 3e-3,
    "gyroscope_noise_density": 1.7e-4,
    "gyroscope_random_walk": 2e-5,
}


def touch(named: str, folder: Path) -> None:
    """Something at the path that a rig.yaml names, where nothing is: a file where the name has a suffix."""
    path, _ = split_place(str(folder / named))
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.name == "target.yaml":
        path.write_text(yaml.safe_dump(jaxcal.AprilGrid(6, 6, 0.088, 0.3).to_yaml()))
    elif path.name == "imu.yaml":
        path.write_text(yaml.safe_dump(NOISE))
    elif path.suffix:
        path.touch()
    else:
        path.mkdir()


def stand_in(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, answer: Callable[..., Any]) -> None:
    """Put a function in the place of one that would take long; a call must still fit the real one's signature."""
    signature = inspect.signature(getattr(owner, name))

    def called(*arguments: Any, **named: Any) -> Any:
        bound = signature.bind(*arguments, **named)
        for model in bound.arguments.get("models") or ():
            jaxcal.camera_model(model)
        return answer(**bound.arguments)

    monkeypatch.setattr(owner, name, called)
