"""The report's own ticks stand where matplotlib's would, with the same labels."""

import io
import re

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from jaxcal.results.report.drawing import image_panel, panel, to_svg
from jaxcal.results.report.ticks import draw_ticks


def _texts(figure: Figure) -> list[str]:
    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg")
    found = re.findall(r"<text.*?</text>", buffer.getvalue(), re.DOTALL)
    return sorted(re.sub(r"<[^>]*>|\s", "", text) for text in found)


@given(
    low=st.floats(-1e3, 1e3),
    span=st.floats(1e-4, 1e4),
    log=st.booleans(),
    rows=st.integers(1, 3),
)
@settings(
    max_examples=25, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate]
)  # shrinking takes minutes
def test_the_labels_are_those_that_matplotlib_draws(low: float, span: float, log: bool, rows: int) -> None:
    def drawn() -> Figure:
        figure, rows_of_axes = panel(rows)
        for axes in rows_of_axes:
            axes.plot([0.0, 3.0], [1.0, 1.0 + span] if log else [low, low + span])
            axes.set_yscale("log" if log else "linear")
            if log:
                axes.yaxis.set_minor_locator(NullLocator())
        return figure

    expected = _texts(drawn())
    ours = drawn()
    draw_ticks(ours, "#020202", "#030303", 8.0)
    assert _texts(ours) == expected
    assert len(expected) > rows


def test_ticks_stand_at_their_values() -> None:
    figure, axes = image_panel((640, 480))
    draw_ticks(figure, "#020202", "#030303", 8.0)
    places = {text.get_text(): text.get_position() for text in axes.texts}
    assert places["200"] in {(200.0, 0.0), (0.0, 200.0)}
    across = [line for line in axes.lines if line.get_marker() == 3]
    np.testing.assert_allclose(across[0].get_xdata(), [0.0, 200.0, 400.0, 600.0])


@pytest.mark.parametrize("rows", [1, 3])
def test_axes_that_share_x_keep_its_labels_below_the_lowest(rows: int) -> None:
    figure, several = panel(rows)
    for axes in several:
        axes.plot([10.0, 20.0], [0.0, 0.5])
    assert to_svg(figure, "p").count(">20<") == 1
    assert [any(text.get_text() == "20" for text in axes.texts) for axes in several] == [False] * (rows - 1) + [True]
