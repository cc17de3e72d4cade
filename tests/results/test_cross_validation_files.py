"""What a cross-validation found survives the disk, belongs to one calibration, and gets its place in the report."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_calibration import make_calibration, make_cross_validation
from test_report import assert_sound

from jaxcal.cli import main
from jaxcal.errors import CalibrationError
from jaxcal.results import Calibration, load_cross_validation, save_cross_validation
from jaxcal.results.cross_validation import CrossValidation, Evidence


@pytest.fixture(scope="module")
def pair() -> Calibration:
    return make_calibration(2, False, frames=10)


@pytest.fixture(scope="module")
def found(pair: Calibration) -> CrossValidation:
    return make_cross_validation(pair, make_calibration(2, False, seed=1, frames=10))


def same(one: object, other: object) -> bool:
    """Equal, arrays bit by bit."""
    if dataclasses.is_dataclass(one):
        return type(one) is type(other) and all(
            same(getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(one)
        )
    if isinstance(one, tuple):
        return isinstance(other, tuple) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    return one == other


def test_what_is_saved_is_read(pair: Calibration, found: CrossValidation, tmp_path: Path) -> None:
    pair.save(tmp_path)
    assert load_cross_validation(tmp_path) is None
    save_cross_validation(found, tmp_path)
    again = load_cross_validation(tmp_path)
    assert same(again, found)
    assert again is not None
    assert again.text() == found.text()


@settings(max_examples=10, deadline=None)
@given(
    gain=st.floats(allow_nan=False),
    p=st.floats(0.0, 1.0),
    step=st.none() | st.integers(0, 9),
    value=st.none() | st.floats(allow_nan=False),
    note=st.text(),
)
def test_evidence_of_any_kind_is_read(
    gain: float, p: float, step: int | None, value: float | None, note: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("any")
    (folder / "calibration.npz").write_bytes(b"any")
    made = CrossValidation((), (Evidence("lens", note, gain, 3, p, gain, step, value),), (note,))
    save_cross_validation(made, folder)
    assert load_cross_validation(folder) == made


def test_what_is_about_another_calibration_is_not_shown(
    pair: Calibration, found: CrossValidation, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pair.save(tmp_path)
    save_cross_validation(found, tmp_path)
    make_calibration(2, False, seed=5, frames=10).save(tmp_path)
    assert load_cross_validation(tmp_path) is None
    assert "about an earlier calibration" in caplog.text


def test_damage_and_a_missing_calibration_are_named(pair: Calibration, found: CrossValidation, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="no such calibration"):
        save_cross_validation(found, tmp_path)
    pair.save(tmp_path)
    file = save_cross_validation(found, tmp_path)
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(CalibrationError, match="damaged"):
        load_cross_validation(tmp_path)


def test_the_report_shows_it_with_a_map_of_each_camera(
    pair: Calibration, found: CrossValidation, tmp_path: Path
) -> None:
    pair.save(tmp_path)
    save_cross_validation(found, tmp_path)
    done = CliRunner().invoke(main, ["report", str(tmp_path)])
    assert done.exit_code == 0, done.output
    text = (tmp_path / "report.html").read_text()
    page = assert_sound(text)
    assert page.sections[-2:] == ["cross-validation", "solution"]
    assert page.figures("cross-validation") == 2
    told = " ".join(words for _, words in page.texts)
    assert found.headline in told
    assert found.causes[0].sentence in told
    assert "cam0: halves in time" in told  # those that differ most
    assert "something was not tested" in told
