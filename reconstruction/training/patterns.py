"""Pictures of calibration boards in front of cluttered backgrounds, as textures to be moved before a camera."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

# An AprilGrid tag of the family 36h11 is 6 data bits wide, with Kalibr's two-bit border on either side.
_TAG_BITS = 10
_TAG_COUNT = 587
_PLAIN_BELOW = 40.0  # texels; on smaller shapes shades and clouds would not be seen


@dataclass(frozen=True)
class Pattern:
    """A board with its surroundings.

    `texture` (H, W) float32 reflectance, black 0 to white 1, its edges exactly between texels; `corners` (N, 2) texel
    coordinates (column, row; the centre of the first texel is (0, 0)) of the board's corners; `size` (columns, rows)
    of corners for a checkerboard, None for an AprilGrid; `middle` (2,) texel coordinates of the board's middle;
    `extent` (2,) width and height in texels of the board without its margin.
    """

    texture: Float[np.ndarray, "height width"]
    corners: Float[np.ndarray, "n 2"]
    size: tuple[int, int] | None
    middle: Float[np.ndarray, "2"]
    extent: Float[np.ndarray, "2"]


def checkerboard(rng: np.random.Generator, columns: int, rows: int, cell_texels: int, surround: int) -> Pattern:
    """A checkerboard of `columns` x `rows` INNER corners; `surround` texels of background on each side."""
    parity = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2
    board = np.kron(parity, np.ones((cell_texels, cell_texels))).astype(np.float32)
    inner = np.stack(np.meshgrid(np.arange(1, columns + 1), np.arange(1, rows + 1)), axis=-1).reshape(-1, 2)
    margin = int(cell_texels * rng.uniform(0.4, 1.5))
    return _placed(rng, board, inner * float(cell_texels), (columns, rows), margin, surround)


def aprilgrid(rng: np.random.Generator, columns: int, rows: int, bit_texels: int, surround: int) -> Pattern:
    """Kalibr's AprilGrid of `columns` x `rows` tags with random ids, 2 or 3 bits apart, black squares between."""
    gap = int(rng.choice([2, 3]))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pitch = _TAG_BITS + gap
    bits = np.ones((rows * pitch + gap, columns * pitch + gap), dtype=np.float32)
    corners = []
    for row in range(rows + 1):
        for column in range(columns + 1):
            top, left = row * pitch, column * pitch
            bits[top : top + gap, left : left + gap] = 0.0
            if row < rows and column < columns:
                tag = dictionary.generateImageMarker(int(rng.integers(_TAG_COUNT)), _TAG_BITS, borderBits=2)
                top, left = top + gap, left + gap
                bits[top : top + _TAG_BITS, left : left + _TAG_BITS] = np.asarray(tag) / 255.0
                corners += [(left + dx, top + dy) for dy in (0, _TAG_BITS) for dx in (0, _TAG_BITS)]
    board = np.kron(bits, np.ones((bit_texels, bit_texels), dtype=np.float32))
    margin = int(bit_texels * rng.uniform(2, 6))
    return _placed(rng, board, np.array(corners) * float(bit_texels), None, margin, surround)


def charuco(rng: np.random.Generator, columns: int, rows: int, cell_texels: int, surround: int) -> Pattern:
    """A ChArUco board of `columns` x `rows` inner corners: a checkerboard with a marker in each white square."""
    pattern = checkerboard(rng, columns, rows, cell_texels, surround)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    side = int(cell_texels * rng.uniform(0.6, 0.8))
    inset = (cell_texels - side) // 2
    left, top = (pattern.middle - pattern.extent / 2 + 0.5).astype(int)
    for row in range(rows + 1):
        for column in range(columns + 1):
            if (row + column) % 2:  # white, as `checkerboard` colours it
                marker = dictionary.generateImageMarker(int(rng.integers(250)), side)
                y, x = top + row * cell_texels + inset, left + column * cell_texels + inset
                pattern.texture[y : y + side, x : x + side] *= np.asarray(marker, dtype=np.float32) / 255.0
    return pattern


def circle_grid(rng: np.random.Generator, columns: int, rows: int, cell_texels: int, surround: int) -> Pattern:
    """`columns` x `rows` black discs on white, in rows or in staggered rows; the corners are the discs' centres."""
    staggered = rng.random() < 0.5
    radius = int(cell_texels * rng.uniform(0.2, 0.35))
    board = np.ones((rows * cell_texels, (columns + 1) * cell_texels), dtype=np.float32)
    centres = [
        (int((column + 0.5 + 0.5 * (staggered and row % 2)) * cell_texels), int((row + 0.5) * cell_texels))
        for row in range(rows)
        for column in range(columns)
    ]
    for centre in centres:
        cv2.circle(board, centre, radius, 0.0, -1, cv2.LINE_AA)
    return _placed(rng, board, np.array(centres) + 0.5, None, int(0.3 * cell_texels), surround)


def picture(rng: np.random.Generator, side: int) -> Pattern:
    """A picture of the world at large, `side` x `side` texels: dead leaves, of no board.

    Shapes that cover each other, their sizes distributed as the inverse cube, have the statistics of natural images
    (Lee, Mumford, Huang 2001). Here discs and rotated rectangles, plain, shaded or cloudy.
    """
    image = background(rng, side, side)
    smallest, largest = 4.0, side / 4.0
    for _ in range(int(rng.integers(300, 1500))):
        # Inverse cumulative distribution of r^-3 between both sizes.
        radius = (smallest**-2 - rng.random() * (smallest**-2 - largest**-2)) ** -0.5
        centre = rng.uniform(0, side, 2)
        shade = float(rng.beta(0.8, 0.8))
        if radius < _PLAIN_BELOW:
            _leaf(rng, image, centre, radius, shade)
            continue
        mask = np.zeros((side, side), dtype=np.uint8)
        _leaf(rng, mask, centre, radius, 255.0)
        left, top, width, height = cv2.boundingRect(mask)
        part = (slice(top, top + height), slice(left, left + width))
        inside = mask[part] > 0
        image[part][inside] = _surface(rng, shade, height, width)[inside]
    middle = np.array([(side - 1) / 2, (side - 1) / 2])
    return Pattern(image.clip(0.0, 1.0), np.zeros((0, 2)), None, middle, np.full(2, side / 3))


def _leaf(
    rng: np.random.Generator, image: np.ndarray, centre: Float[np.ndarray, "2"], radius: float, shade: float
) -> None:
    """A disc or a rotated rectangle, drawn into the image."""
    if rng.random() < 0.5:
        cv2.circle(image, (int(centre[0]), int(centre[1])), int(radius), shade, -1)
        return
    sides = (2.0 * radius, 2.0 * radius * float(rng.uniform(0.2, 1.0)))
    box = cv2.boxPoints(((float(centre[0]), float(centre[1])), sides, float(rng.uniform(0, 90))))
    cv2.fillConvexPoly(image, box.astype(np.int32), shade)


def _surface(rng: np.random.Generator, shade: float, height: int, width: int) -> Float[np.ndarray, "height width"]:
    """A plain grey, with clouds on half of the surfaces, in uneven light."""
    surface = np.full((height, width), shade, dtype=np.float32)
    if rng.random() < 0.5:
        cells = int(rng.integers(3, 24))
        coarse = rng.normal(size=(cells, cells)).astype(np.float32)
        surface += rng.uniform(0.0, 0.2) * np.asarray(
            cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        )
    return surface * _shading(rng, height, width)


def _placed(
    rng: np.random.Generator,
    board: Float[np.ndarray, "h w"],
    corners: Float[np.ndarray, "n 2"],
    size: tuple[int, int] | None,
    margin: int,
    surround: int,
) -> Pattern:
    """The board with a white margin on a background; `corners` in texel edges of the board's own upper left."""
    height, width = board.shape
    texture = background(rng, height + 2 * (margin + surround), width + 2 * (margin + surround))
    left = top = surround
    texture[top : top + height + 2 * margin, left : left + width + 2 * margin] = 1.0
    left, top = left + margin, top + margin
    texture[top : top + height, left : left + width] = board
    texture *= _shading(rng, *texture.shape)
    origin = np.array([left, top]) - 0.5  # the edge before texel k lies at k - 1/2
    extent = np.array([width, height], dtype=np.float64)
    return Pattern(texture, corners + origin, size, origin + extent / 2, extent)


def background(rng: np.random.Generator, height: int, width: int) -> Float[np.ndarray, "height width"]:
    """Clutter behind the board: plain grey, clouds of two sizes, and sometimes rectangles and lines."""
    level = rng.uniform(0.02, 0.7)
    image = np.full((height, width), level, dtype=np.float32)
    for cells, amount in ((4, 0.35), (16, 0.25)):
        coarse = rng.normal(size=(cells, cells)).astype(np.float32)
        clouds = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))
        image += (amount * rng.uniform(0, 1) * level) * clouds
    for _ in range(int(rng.integers(0, 12)) if rng.random() < 0.6 else 0):
        first, second = (tuple(int(v) for v in rng.uniform(0, (width, height))) for _ in range(2))
        shade = float(rng.uniform(0, 0.9))
        if rng.random() < 0.5:
            cv2.rectangle(image, first, second, shade, -1)
        else:
            cv2.line(image, first, second, shade, int(rng.integers(2, 30)))
    return image.clip(0.0, 0.95)


def _shading(rng: np.random.Generator, height: int, width: int) -> Float[np.ndarray, "height width"]:
    """Uneven light: a gentle slope across the board, at most 1."""
    slope = rng.uniform(-0.15, 0.15, 2)
    across = np.add.outer(slope[1] * np.linspace(-0.5, 0.5, height), slope[0] * np.linspace(-0.5, 0.5, width))
    return (1.0 - np.abs(slope).sum() / 2 + across).astype(np.float32)
