"""What is said of errors that are no independent noise."""

import numpy as np

from jaxcal.calibration.outcome import sentences_on_errors
from jaxcal.calibration.redundancy import Redundancy

INDEPENDENT = Redundancy(np.ones(3), 1.0, 0.0)
ALIKE = Redundancy(np.ones(3), 2.0, 0.4)


def test_what_sigmas_allow_for_is_said_where_it_is_much() -> None:
    names = ["events", "blurred", "clean"]
    (sentence,) = sentences_on_errors(names, [INDEPENDENT] * 3, [9.0, 36.0, 1.0])
    assert sentence.startswith("blurred: ")
    assert "6.0 times" in sentence


def test_views_that_count_less_are_always_named() -> None:
    (sentence,) = sentences_on_errors(["cam0"], [ALIKE], [2.0])
    assert "correlation 0.40" in sentence
    assert "count less" in sentence
