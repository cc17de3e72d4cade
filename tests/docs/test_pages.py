"""The pages keep what they promise: links lead somewhere, figures are ours and small, tables are those of the code."""

import importlib
import itertools
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import click
import numpy as np
import pytest
from code_blocks import DOCS, PAGES, ROOT, synthetic

import jaxcal
from jaxcal.cli import main

FIGURES = DOCS / "figures"


def script(name: str) -> ModuleType:
    sys.path.insert(0, str(ROOT / "experiments"))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(ROOT / "experiments"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_inside_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if not link.startswith("http"):
            assert (page.parent / link.partition("#")[0]).exists(), link


def test_every_page_is_in_the_table_of_contents() -> None:
    listed = re.findall(r"^(?:course/)?\w+$", (DOCS / "index.md").read_text(), re.MULTILINE)
    pages = {str(page.relative_to(DOCS).with_suffix("")) for page in DOCS.rglob("*.md")} - {"index"}
    assert pages <= set(listed)


def test_each_page_of_the_course_ends_with_the_question_of_the_next() -> None:
    pages = sorted((DOCS / "course").glob("*.md"))
    for page, following in itertools.pairwise(pages):
        end = page.read_text().rstrip().rsplit("\n\n", 1)[1]
        assert re.match(r"\*\*[^*]*\?\*\*", end), page
        assert f"({following.name})" in end


def test_figures_are_small_used_and_made_by_the_script() -> None:
    made = script("docs_figures").figures(Path("unused"))
    there = {path.stem: path for path in FIGURES.iterdir()}
    assert set(there) == set(made)
    texts = "".join(page.read_text() for page in PAGES)
    for name, path in there.items():
        assert path.stat().st_size <= 100_000
        assert f"figures/{path.name}" in texts, name


def test_every_output_of_the_course_was_filled_in() -> None:
    for page in (DOCS / "course").glob("*.md"):
        text = page.read_text()
        for found in re.findall(r"<!-- output[^>]*-->\n(.*?)<!-- /output -->", text, re.DOTALL):
            assert found.startswith("```text\n"), page
        # What the script would run and fill in is all of them.
        markers = len(re.findall(r"^<!-- output", text, re.MULTILINE))
        assert len(list(script("docs_outputs")._BLOCK.finditer(text))) == markers


def test_a_part_of_an_output_is_the_part_asked_for() -> None:
    part_of = script("docs_outputs").part_of
    assert part_of("a\nb\nc\nd", "") == "a\nb\nc\nd"
    assert part_of("a\nb\nc\nd", ': from "b" lines 2') == "...\nb\nc\n..."
    assert part_of("a\nb", ': from "a" lines 9') == "a\nb"
    with pytest.raises(RuntimeError, match="no line"):
        part_of("a\nb", ': from "x" lines 1')
    with pytest.raises(RuntimeError, match="expected nothing"):
        part_of("a\nb", ": lines 1")


# --- against the code ------------------------------------------------------------------------------------------------


def test_every_public_name_is_in_the_reference() -> None:
    text = (DOCS / "api.md").read_text()
    documented = set(re.findall(r"auto(?:function|class|exception):: (\w+)", text))
    assert set(jaxcal.__all__) - {"__version__"} <= documented


@pytest.mark.parametrize("command", ["calibrate-cameras", "calibrate-imu-camera"])
def test_options_of_kalibr_are_accepted(command: str) -> None:
    text = (DOCS / "coming_from_kalibr.md").read_text()
    section = text.split(f"## Options of `{command}`")[1].split("\n## ")[0]
    named = set(re.findall(r"`(--[\w-]+)", section))
    found = main.get_command(click.Context(main), command)
    assert found is not None
    known = {name for parameter in found.params for name in parameter.opts}
    assert len(named) > 15
    assert named <= known
    # And none of those that have nothing to do here is left out.
    hidden = {p.opts[0] for p in found.params if isinstance(p, click.Option) and p.hidden}
    assert hidden <= named | {"--dont-show-report", "--show-extraction"}


def test_the_file_format_is_the_one_that_is_written(tmp_path: Path) -> None:
    text = (DOCS / "file_format.md").read_text()
    synthetic(2, True).save(tmp_path)
    with np.load(tmp_path / "calibration.npz") as arrays:
        meta = json.loads(arrays["meta"].tobytes())
        names = set(arrays)
    assert f"| `version` | {meta['version']} |" in text
    for key in meta:
        assert f"`{key}`" in text
    for key in [*meta["cameras"][0], *meta["imu"]]:
        assert f"`{key}`" in text
    for name in names - {"meta"}:
        last = name.rpartition(".")[2]
        listed = f"`{re.sub('^cam[0-9]', 'camK', name)}`" in text or f"`.{last}`" in text
        assert listed or name.startswith("imu."), name
