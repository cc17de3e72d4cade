"""`jaxcal report`: the page of a saved calibration."""

from pathlib import Path

from click.testing import CliRunner

from jaxcal.cli import main


def test_what_cannot_be_reported_is_named(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["report", str(tmp_path)])
    assert result.exit_code == 1
    assert f"{tmp_path / 'calibration.npz'}: no such calibration" in result.output
