"""`jaxcal target`: a printable board, and the target.yaml that describes it."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from jaxcal.targets import Target

# Options that only some kinds have; the others refuse them.
_ONLY = {
    "spacing": ("aprilgrid",),
    "first_id": ("aprilgrid", "charuco"),
    "col_size": ("checkerboard",),
    "asymmetric": ("circlegrid",),
    "diameter": ("circlegrid",),
    "marker_size": ("charuco",),
    "dictionary": ("charuco",),
    "legacy": ("charuco",),
}


@click.command()
@click.option("--type", "kind", type=click.Choice(["aprilgrid", "checkerboard", "circlegrid", "charuco"]))
@click.option("--rows", type=int, help="Rows of tags, INNER corners, circles, or ChArUco squares.")
@click.option("--cols", type=int, help="Columns, likewise.")
@click.option("--size", type=float, help="Edge of a tag or square, or distance between circles; metres.")
@click.option("--spacing", type=float, help="aprilgrid: gap between tags as a fraction of --size.")
@click.option("--first-id", type=int, help="aprilgrid, charuco: id of the first tag or marker (0).")
@click.option("--col-size", type=float, help="checkerboard: width of the squares where it is not --size; metres.")
@click.option("--asymmetric", is_flag=True, default=None, help="circlegrid: every second row is shifted.")
@click.option("--diameter", type=float, help="circlegrid: of the circles; metres (half of --size).")
@click.option("--marker-size", type=float, help="charuco: edge of a marker; metres (3/4 of --size).")
@click.option("--dictionary", help="charuco: name of OpenCV's dictionary, such as DICT_5X5_100.")
@click.option("--legacy", is_flag=True, default=None, help="charuco: the pattern of OpenCV before 4.6.")
@click.option(
    "--from",
    "source",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Draw what this target.yaml says, in place of --type and the rest.",
)
@click.option("--page", default="auto", show_default=True, help="auto, A4 .. A0, letter, or a size in mm: 600x400.")
@click.option(
    "--out",
    "--output",
    "-o",
    "outputs",
    required=True,
    multiple=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="File to draw, .pdf or .svg; may be given twice. The .yaml is written beside the first.",
)
@click.pass_context
def target(ctx: click.Context, source: Path | None, page: str, outputs: tuple[Path, ...], **fields: object) -> None:
    """Draw a board, true to size, and write its target.yaml.

    \b
    jaxcal target --type aprilgrid --rows 6 --cols 6 --size 0.03 --spacing 0.3 --out board.pdf
    jaxcal target --type checkerboard --rows 6 --cols 9 --size 0.025 --page A4 --out board.svg
    jaxcal target --type circlegrid --rows 11 --cols 4 --size 0.02 --asymmetric --out board.pdf
    jaxcal target --type charuco --rows 5 --cols 7 --size 0.035 --dictionary DICT_5X5_100 --out board.pdf
    jaxcal target --from three_boards.yaml --page A3 --out boards.pdf

    Print at 100 % and measure the ruler at the lower edge. A checkerboard with rows + columns odd, and any board with
    tags, has one way up; others look the same upside down, which several cameras cannot tell apart.
    """
    from jaxcal.targets import load_target
    from jaxcal.targets.drawing import draw_target

    given = {name: value for name, value in fields.items() if value is not None}
    if source is not None and given:
        raise click.UsageError(f"--from draws a file; leave out {', '.join(map(_option, given))}.", ctx)
    board = load_target(source) if source is not None else _board(ctx, given)
    for path in outputs:
        for name, part in _parts(path, board):
            sheet = draw_target(part, name, page)
            click.echo(f"{name}: {sheet.page}, {sheet.width_mm:g} x {sheet.height_mm:g} mm; print at 100 %")
    if source is None:
        written = outputs[0].with_suffix(".yaml")
        _write_yaml(written, board)
        click.echo(f"{written}: describes it, for --target")


def _parts(path: Path, board: "Target") -> list[tuple[Path, "Target"]]:
    """A file for each board: numbered where there are several."""
    if len(board.boards) == 1:
        return [(path, board)]
    return [(path.with_stem(f"{path.stem}-{number}"), part) for number, part in enumerate(board.boards)]


def _board(ctx: click.Context, given: dict) -> "Target":
    from jaxcal.targets import AprilGrid, Charuco, Checkerboard, CircleGrid

    kind = given.pop("kind", None)
    needed = ["rows", "cols", "size", *{"aprilgrid": ["spacing"], "charuco": ["dictionary"]}.get(kind, [])]
    missing = [*([] if kind else ["type"]), *(name for name in needed if name not in given)]
    if missing:
        hint = " OpenCV's name of it, such as DICT_5X5_100." if "dictionary" in missing else ""
        raise click.UsageError(f"missing {', '.join(map(_option, missing))}.{hint}", ctx)
    for name in given:
        if kind not in _ONLY.get(name, (kind,)):
            raise click.UsageError(f"a {kind} has no {_option(name)}.", ctx)
    rows, cols, size = given["rows"], given["cols"], given["size"]
    if kind == "aprilgrid":
        return AprilGrid(rows, cols, size, given["spacing"], given.get("first_id", 0))
    if kind == "checkerboard":
        return Checkerboard(rows, cols, size, given.get("col_size"))
    if kind == "circlegrid":
        return CircleGrid(rows, cols, size, given.get("asymmetric", False), given.get("diameter"))
    marker_size = given.get("marker_size", 0.75 * size)
    return Charuco(
        rows, cols, size, marker_size, given["dictionary"], given.get("legacy", False), given.get("first_id", 0)
    )


def _option(name: str) -> str:
    return "--type" if name == "kind" else "--" + name.replace("_", "-")


def _write_yaml(path: Path, board: "Target") -> None:
    import yaml

    from jaxcal.atomic import write_bytes

    write_bytes(path, yaml.safe_dump(board.to_yaml(), sort_keys=False).encode())
