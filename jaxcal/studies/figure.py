"""Box plots of a study: how far every parameter is from the reference, run by run, beside the sigmas stated."""

import io
from pathlib import Path

import numpy as np

from jaxcal.atomic import write_bytes
from jaxcal.errors import CalibrationError
from jaxcal.studies.summary import ParameterSummary, StudyResult

PICTURES = (".png", ".svg", ".pdf")
_COLOURS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")
_MOST_COLUMNS = 4


def write_figure(result: StudyResult, path: Path) -> None:
    """Draw one panel per block and unit: a box (quartiles, whiskers at 5 and 95 %) per parameter and combination of
    settings, over bars of twice the sigma stated. Raises CalibrationError for a suffix that is no picture's, and when
    there is nothing to draw."""
    from matplotlib.figure import Figure

    if path.suffix not in PICTURES:
        raise CalibrationError(f"{path}: pictures end in .png, .svg or .pdf. Name it so.")
    panels = _panels(result)
    if not panels:
        raise CalibrationError("the study has no parameters to draw: no calibration succeeded.")
    columns = min(len(panels), _MOST_COLUMNS)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.6 * columns, 2.9 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for panel, ((block, unit), summaries) in zip(axes, panels.items(), strict=False):
        _draw(panel, block, unit, summaries)
    for panel in axes[len(panels) :]:
        panel.set_axis_off()
    combinations = result.study.combinations
    if len(combinations) > 1:
        handles = [_patch(_COLOURS[k % len(_COLOURS)]) for k in range(len(combinations))]
        names = [", ".join(f"{name} {value}" for name, value in settings.items()) for settings in combinations]
        figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 3), fontsize="small")
    figure.suptitle(f"{result.study.kind}: deviation from {result.against}; grey: 2 sigma stated", fontsize="medium")
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix[1:], dpi=150)
    write_bytes(path, content.getvalue())


def _panels(result: StudyResult) -> dict[tuple[str, str], list[list[ParameterSummary]]]:
    """Per block and unit, the summaries of each combination of settings."""
    combinations = result.study.combinations
    panels: dict[tuple[str, str], list[list[ParameterSummary]]] = {}
    for p in result.parameters:
        if np.isfinite(p.deviations).any():
            lists = panels.setdefault((p.block, p.unit), [[] for _ in combinations])
            lists[combinations.index(dict(p.settings))].append(p)
    return panels


def _draw(axes, block: str, unit: str, summaries: list[list[ParameterSummary]]) -> None:
    labels = list(dict.fromkeys(p.name for of_one in summaries for p in of_one))
    width = 0.8 / len(summaries)
    axes.axhline(0.0, color="#888888", linewidth=0.8)
    for k, of_one in enumerate(summaries):
        for p in of_one:
            x = labels.index(p.name) - 0.4 + width * (k + 0.5)
            if np.isfinite(p.stated_sigma):
                axes.bar(x, 4 * p.stated_sigma, width, bottom=-2 * p.stated_sigma, color="#000000", alpha=0.12)
            values = p.deviations[np.isfinite(p.deviations)]
            colour = _COLOURS[k % len(_COLOURS)]
            if len(values) < 4:
                axes.plot(np.full(len(values), x), values, "o", color=colour, markersize=3.5)
                continue
            box = axes.boxplot(
                [values], positions=[x], widths=0.7 * width, whis=(5, 95), patch_artist=True, manage_ticks=False,
                flierprops={"markersize": 2, "markeredgecolor": colour}, medianprops={"color": "black"},
            )  # fmt: skip
            box["boxes"][0].set(facecolor=colour, alpha=0.7)
    axes.set_xticks(range(len(labels)), labels, rotation=0 if len(labels) < 5 else 30, fontsize="small")
    axes.set_xlim(-0.6, len(labels) - 0.4)
    axes.set_title(block, fontsize="medium")
    axes.set_ylabel(f"deviation [{unit}]" if unit else "deviation", fontsize="small")
    axes.tick_params(axis="y", labelsize="small")


def _patch(colour: str):
    from matplotlib.patches import Patch

    return Patch(facecolor=colour, alpha=0.7)
