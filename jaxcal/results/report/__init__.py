"""The HTML report of a calibration."""

from jaxcal.results.report.page import write_report

__all__ = ["write_report"]
