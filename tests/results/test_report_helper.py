"""A report that a second process helps to draw is the same page, also where that process cannot help."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import pytest
from synthetic_calibration import make_calibration

from jaxcal.cameras import PinholeRadtan
from jaxcal.child import Child, python_child
from jaxcal.results import Calibration, write_report
from jaxcal.results.report import helper as report_helper


@pytest.fixture
def helper() -> Iterator[Child]:
    with python_child("jaxcal.results.report.helper") as process:
        yield process


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return make_calibration(3, with_imu=False)


def page(calibration: Calibration, path: Path, helper: Child | None) -> str:
    write_report(calibration, path, helper=helper)
    return path.read_text()


def test_the_page_is_the_same_and_the_helper_drew(
    calibration: Calibration, helper: Child, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = page(calibration, tmp_path / "alone.html", None)

    def not_here(*_: object) -> None:
        raise AssertionError("drawn in this process")

    monkeypatch.setattr(report_helper, "residual_pictures", not_here)
    assert page(calibration, tmp_path / "helped.html", helper) == alone


def test_a_helper_that_was_killed_is_not_missed(calibration: Calibration, helper: Child, tmp_path: Path) -> None:
    helper.kill()
    helped = page(calibration, tmp_path / "helped.html", helper)
    assert helped == page(calibration, tmp_path / "alone.html", None)


def test_a_lens_that_cannot_be_sent_is_drawn_here(helper: Child, tmp_path: Path) -> None:
    class Local(PinholeRadtan):
        """Of this function alone: it cannot be pickled."""

        focal_note: str = eqx.field(static=True, default="")

    calibration = make_calibration(1, with_imu=False)
    (camera,) = calibration.cameras
    local = Local.from_focal(300.0, camera.image_size).with_parameters(camera.model.parameters)
    calibration = dataclasses.replace(calibration, cameras=(dataclasses.replace(camera, model=local),))
    helped = page(calibration, tmp_path / "helped.html", helper)
    assert helper.wait() != 0
    assert helped == page(calibration, tmp_path / "alone.html", None)
