"""Outlines of the black cells of a grid of rectangles: closed loops that can be filled as one."""

import numpy as np

# Directions along the grid's lines, anticlockwise: right, up, left, down; as (column, row) steps.
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))


def outlines(x_lines: np.ndarray, y_lines: np.ndarray, black: np.ndarray) -> list[np.ndarray]:
    """Loops (K, 2) around the black cells, the last point joined to the first; black lies to the left of each edge.

    `x_lines` (n + 1,), `y_lines` (m + 1,), `black` (m, n) bool, row 0 lowest. Filled together by the nonzero rule, the
    loops cover exactly the black cells: outer ones run anticlockwise, holes clockwise. Cells that touch at a corner
    only get loops of their own.
    """
    edges = _edges(np.pad(black, 1))
    loops = []
    while edges:
        start = next(iter(edges))
        node, direction = start
        corners: list[tuple[int, int]] = []
        while (node, direction) in edges:
            edges.discard((node, direction))
            node = (node[0] + _STEPS[direction][0], node[1] + _STEPS[direction][1])
            # Left first: at a node where two black cells touch, the loop stays with its own cell.
            following = next(turn for turn in (1, 0, 3, 2) if turn == 2 or (node, (direction + turn) % 4) in edges)
            if following == 2:
                corners.append(node)
                break
            if following != 0:
                corners.append(node)
            direction = (direction + following) % 4
        loops.append(_without_straight_start(corners))
    return [np.stack([x_lines[loop[:, 0]], y_lines[loop[:, 1]]], axis=1) for loop in loops]


def _edges(padded: np.ndarray) -> set[tuple[tuple[int, int], int]]:
    """Edges between black and white, as (node (column, row) they start from, direction), black to their left."""
    inner = padded[1:-1, 1:-1]
    sides = {
        0: inner & ~padded[:-2, 1:-1],  # the lower side runs right
        1: inner & ~padded[1:-1, 2:],  # the right side up
        2: inner & ~padded[2:, 1:-1],  # the upper side left
        3: inner & ~padded[1:-1, :-2],  # the left side down
    }
    start = {0: (0, 0), 1: (1, 0), 2: (1, 1), 3: (0, 1)}
    edges = set()
    for direction, cells in sides.items():
        for row, col in np.argwhere(cells):
            edges.add(((int(col) + start[direction][0], int(row) + start[direction][1]), direction))
    return edges


def _without_straight_start(corners: list[tuple[int, int]]) -> np.ndarray:
    """The loop's corners, without the node where the walk began if its edges run straight on there."""
    loop = np.array(corners)
    before, after = np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0)
    cross = (loop - before)[:, 0] * (after - loop)[:, 1] - (loop - before)[:, 1] * (after - loop)[:, 0]
    return loop[cross != 0]
