"""A study's tables: `study.csv` (a row per run and parameter), `runs.csv`, `summary.csv`, and Parquet; and its text."""

import csv
import importlib.util
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxcal.atomic import write_bytes, write_text
from jaxcal.studies.summary import StudyResult

# A table: columns of equal length, by name.
Table = dict[str, list[Any]]


def tidy_table(result: StudyResult) -> Table:
    """One row per run and parameter: which run, with which settings; value, 1-sigma and deviation in `unit`."""
    rows: list[dict[str, Any]] = []
    for row in result.rows:
        centre = result.centre(row["combination"])
        for block in result.blocks(row).values():
            apart, shown = block.minus(centre.get(block.name)), block.shown
            for k, label in enumerate(block.labels):
                sigma = math.nan if block.sigma is None else float(block.sigma[k])
                rows.append(
                    {
                        "index": row["index"],
                        "run": row["run"],
                        "label": row["label"],
                        **_settings(row),
                        "block": block.name,
                        "parameter": label,
                        "unit": block.units[k],
                        "value": float(shown[k]),
                        "sigma": sigma,
                        "deviation": float(apart[k]),
                        "in_sigmas": float(apart[k]) / sigma if sigma > 0 else math.nan,
                    }
                )
    return _columns(rows)


def run_table(result: StudyResult) -> Table:
    """One row per run: whether it worked, how long it took, and the corner noise of each camera, px."""
    rows = []
    for row in result.rows:
        noise = {f"{name} noise [px]": value for name, value in row.get("noise_px", {}).items()}
        facts = {key: row.get(key, "") for key in ("status", "converged", "warnings", "seconds", "error")}
        rows.append(
            {"index": row["index"], "run": row["run"], "label": row["label"], **_settings(row), **facts, **noise}
        )
    return _columns(rows)


def summary_table(result: StudyResult) -> Table:
    """One row per combination of settings and parameter; deviations from the reference, in `unit`."""
    return _columns(
        [
            {
                **{name: _cell(value) for name, value in p.settings.items()},
                "block": p.block,
                "parameter": p.name,
                "unit": p.unit,
                "runs": len(p.deviations),
                "mean": p.mean,
                "bias": p.bias,
                "std": p.std,
                **dict(zip(("q05", "q25", "median", "q75", "q95"), p.quantiles, strict=True)),
                "observed_sigma": p.observed_sigma,
                "stated_sigma": p.stated_sigma,
                "ratio": p.ratio,
                "rms_in_sigmas": p.rms_in_sigmas,
            }
            for p in result.parameters
        ]
    )


def write_tables(result: StudyResult, folder: Path) -> list[Path]:
    """Write all tables into `folder`, each atomically; the paths written. Parquet where pyarrow is installed."""
    written = []
    for name, table in (
        ("study", tidy_table(result)),
        ("runs", run_table(result)),
        ("summary", summary_table(result)),
    ):
        written.append(folder / f"{name}.csv")
        write_text(written[-1], _csv(table))
        if name == "study" and importlib.util.find_spec("pyarrow") is not None:
            written.append(folder / f"{name}.parquet")
            write_bytes(written[-1], _parquet(table))
    return written


def summary_text(result: StudyResult) -> str:
    """The summary for a terminal, ending with a newline."""
    count = sum(row["status"] == "ok" for row in result.rows)
    lines = [f"{result.study.kind}: {count} calibrations, {len(result.failed)} failed; against {result.against}", ""]
    settings: Mapping[str, Any] | None = None
    for p in result.parameters:
        if p.settings != settings:
            settings = p.settings
            if settings:
                lines += ["", ", ".join(f"{name} = {_cell(value)}" for name, value in settings.items())]
            lines.append(f"{'':40}{'runs':>6}{'bias':>12}{'observed':>12}{'stated':>12}{'ratio':>8}{'rms/sigma':>11}")
        label = f"{p.block} {p.name}" + (f" [{p.unit}]" if p.unit else "")
        numbers = f"{p.bias:12.4g}{p.observed_sigma:12.4g}{p.stated_sigma:12.4g}{p.ratio:8.2f}{p.rms_in_sigmas:11.2f}"
        lines.append(f"  {label:38}{len(p.deviations):6}{numbers}")
    if math.isfinite(result.pooled_ratio):
        lines += ["", f"observed over stated sigma, over all parameters: {result.pooled_ratio:.3f} rms"]
    lines += [f"failed: {row['label']}: {row['error']}" for row in result.failed[:5]]
    return "\n".join(lines) + "\n"


def _settings(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _cell(value) for name, value in row["settings"].items()}


def _cell(value: Any) -> Any:
    return value if isinstance(value, int | float | str | bool) or value is None else str(value)


def _columns(rows: Sequence[Mapping[str, Any]]) -> Table:
    names = list(dict.fromkeys(name for row in rows for name in row))
    return {name: [row.get(name) for row in rows] for name in names}


def _csv(table: Table) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    return text.getvalue()


def _parquet(table: Table) -> bytes:
    import pyarrow
    import pyarrow.parquet

    content = io.BytesIO()
    columns = {name: values if _uniform(values) else [str(value) for value in values] for name, values in table.items()}
    pyarrow.parquet.write_table(pyarrow.table(columns), content)
    return content.getvalue()


def _uniform(values: Sequence[Any]) -> bool:
    return len({type(value) for value in values if value is not None}) <= 1
