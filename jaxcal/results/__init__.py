"""Results: the `Calibration`, its files and its report."""

from typing import TYPE_CHECKING, Any

from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration, TargetShape
from jaxcal.results.compare import compare
from jaxcal.results.cross_validation import CrossValidation
from jaxcal.results.cross_validation_files import load_cross_validation, save_cross_validation
from jaxcal.results.difference import RigDifference
from jaxcal.results.files import load_calibration, save_calibration
from jaxcal.results.interchange import CalibratedRig, read_calibration, rig_of, write_calibration
from jaxcal.results.kalibr import CamchainCamera, load_camchain
from jaxcal.results.projection_uncertainty import ProjectionUncertainty, projection_uncertainty
from jaxcal.results.text import results_text
from jaxcal.results.verdict import Verdict, judge
from jaxcal.results.whiteness import ResidualStatistics, residual_statistics

if TYPE_CHECKING:
    from jaxcal.results.report import write_report

__all__ = [
    "CalibratedRig",
    "Calibration",
    "CamchainCamera",
    "CameraCalibration",
    "CrossValidation",
    "ImuCalibration",
    "ProjectionUncertainty",
    "ResidualStatistics",
    "RigDifference",
    "TargetShape",
    "Verdict",
    "compare",
    "judge",
    "load_calibration",
    "load_camchain",
    "load_cross_validation",
    "projection_uncertainty",
    "read_calibration",
    "residual_statistics",
    "results_text",
    "rig_of",
    "save_calibration",
    "save_cross_validation",
    "write_calibration",
    "write_report",
]


def __getattr__(name: str) -> Any:
    # The report needs matplotlib; a calibration does not.
    if name == "write_report":
        from jaxcal.results.report import write_report

        return write_report
    raise AttributeError(f"module 'jaxcal.results' has no attribute '{name}'")
