"""Studies: many calibrations, to see how far results repeat. `load_study` or `Study`, then `run_study`."""

from jaxcal.studies.run import StudyResult, load_result, run_study
from jaxcal.studies.spec import Study, load_study

__all__ = ["Study", "StudyResult", "load_result", "load_study", "run_study"]
