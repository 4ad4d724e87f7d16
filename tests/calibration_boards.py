"""Pictures of calibration boards through an exact lens, for the tests and benchmarks of avcalib."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avcli import pose
from avcli.calibration import fit
from avcli.calibration.drawing import draw, to_png
from avcli.calibration.pupil import from_pupil
from avcli.calibration.target import Board
from avcli.lens import KannalaBrandt, Lens

THESIS = KannalaBrandt(862.27, 862.70, 1049.47, 552.76, -0.0269, -0.0038, 0.0016, -0.0006)
"""The thesis's real camera, 1920 × 1080."""
HALF = KannalaBrandt(431.135, 431.35, 524.485, 276.13, -0.0269, -0.0038, 0.0016, -0.0006)
HALF_SIZE = (960, 540)
"""The same camera with pictures of half the size."""
BOARD = Board(6, 8, 0.095)
"""The thesis's board."""
FLAT = np.zeros(3)


@dataclass(frozen=True)
class Filmed:
    """Boards that stood before a camera: rotations (n, 3, 3) and translations (n, 3) m, board to camera."""

    rotations: np.ndarray
    translations: np.ndarray


def film(
    count: int,
    rng: np.random.Generator,
    *,
    lens: Lens = THESIS,
    board: Board = BOARD,
    size: tuple[int, int] = (1920, 1080),
    distance: tuple[float, float] = (0.35, 1.2),
    tilt: float = 0.7,
    shape: np.ndarray = FLAT,
    aim: tuple[Sequence[float], float] | None = None,
    margin: float = 6,
    whole: bool = True,
) -> Filmed:
    """Put boards at random before the camera, whole in the picture, aimed at random pixels (or within `aim`)."""
    width, height = size
    corners = fit.surface(board.points, shape, board.half_extent)
    outer = board.printed_m / 2
    rim = np.array([[sx * outer[0], sy * outer[1], 0] for sx in (-1, 1) for sy in (-1, 1)])
    rotations: list[np.ndarray] = []
    translations: list[np.ndarray] = []
    while len(rotations) < count:
        pixel = rng.uniform([0, 0], [width - 1, height - 1])
        if aim is not None:
            pixel = np.asarray(aim[0]) + aim[1] * rng.uniform(-1, 1, 2)
        ray = lens.unproject(pixel[None])[0]
        if not np.isfinite(ray).all():
            continue
        across = np.cross([0, 1, 0.01], ray)
        across /= np.linalg.norm(across)
        facing = np.stack([across, np.cross(ray, across), ray], -1)
        about, roll = rng.uniform(0, 2 * np.pi, 2)
        lean = rng.uniform(0, tilt) * np.array([np.cos(about), np.sin(about), 0])
        R = facing @ pose.rotation_from_vector(lean[None])[0] @ pose.rotation_from_vector(np.array([[0, 0, roll]]))[0]
        t = ray * rng.uniform(*distance)
        seen = lens.project((np.concatenate([corners, rim]) if whole else corners) @ R.T + t)
        inside = ((seen > margin) & (seen < np.array(size) - 1 - margin)).all(1)
        if inside.all() if whole else inside.sum() >= 8:
            rotations.append(R)
            translations.append(t)
    return Filmed(np.array(rotations), np.array(translations))


def exact(
    filmed: Filmed,
    *,
    lens: Lens = THESIS,
    board: Board = BOARD,
    shape: np.ndarray = FLAT,
    pupil: float = 0.0,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> fit.Observations:
    """The corners of filmed boards without a picture, with Gaussian noise in px; `pupil` m as in fit.Solution."""
    flat = fit.surface(board.points, shape, board.half_extent)
    pixels = np.concatenate(
        [
            lens.project(from_pupil(flat @ R.T + t, pupil)[0])
            for R, t in zip(filmed.rotations, filmed.translations, strict=True)
        ]
    )
    if rng is not None:
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
    n, m = len(filmed.rotations), len(flat)
    return fit.Observations(
        np.repeat(np.arange(n), m), np.tile(board.points, (n, 1)), pixels, np.ones(n * m), board.half_extent
    )


def texture(board: Board, per_square: int = 48) -> np.ndarray:
    """The printed board as a picture, a quiet border of one square around it: (height, width) float 0 or 1."""
    drawing = draw(board)
    square = 1000 * board.square_m
    left, top = (drawing.width_mm - board.columns * square) / 2, (drawing.height_mm - board.rows * square) / 2
    ink = np.ones(((board.rows + 2) * per_square, (board.columns + 2) * per_square), np.float32)
    scale = per_square / square
    for x, y, w, h in drawing.rectangles:
        a, b = np.rint(np.array([x - left, x + w - left]) * scale + per_square).astype(int)
        c, d = np.rint(np.array([y - top, y + h - top]) * scale + per_square).astype(int)
        if a >= per_square and c >= per_square and b <= ink.shape[1] - per_square and d <= ink.shape[0] - per_square:
            ink[c:d, a:b] = 0.0
    return ink


@functools.cache
def printed(board: Board) -> tuple[np.ndarray, float, np.ndarray]:
    """The page with the board as its PNG (height, width) float32 0 to 1, pixels per metre, and half its size (2,) m."""
    import cv2

    per_unit = 48 if board.kind == "charuco" else 80
    dpi = per_unit / board.square_m * 0.0254
    drawing = draw(board)
    page = cv2.imdecode(np.frombuffer(to_png(drawing, dpi), np.uint8), 0)
    half = np.array([drawing.width_mm, drawing.height_mm]) / 2000
    return page.astype(np.float32) / 255, round(dpi / 0.0254), half


def photograph(
    R: np.ndarray,
    t: np.ndarray,
    rng: np.random.Generator,
    *,
    lens: Lens = THESIS,
    board: Board = BOARD,
    size: tuple[int, int] = (1920, 1080),
    shape: np.ndarray = FLAT,
    blur: float = 0.8,
    noise: float = 3.0,
    oversample: int = 1,
) -> np.ndarray:
    """Photograph a board: (height, width) uint8, blurred by a Gaussian of `blur` px, with noise in grey levels.

    Every subpixel's ray is met with the (bowed) board exactly; squares are looked up in the board's own geometry, or,
    with markers, in its picture.
    """
    import cv2

    width, height = size
    reach = board.printed_m / 2 + board.square_m
    s = np.linspace(-1, 1, 30)
    rim = np.concatenate([np.stack([a * reach[0], b * reach[1], 0 * s], -1) for a, b in
                          ((s, s * 0 - 1), (s, s * 0 + 1), (s * 0 - 1, s), (s * 0 + 1, s))])  # fmt: skip
    seen = lens.project(rim @ R.T + t)
    low = np.floor(np.nanmin(seen, 0) - 6).astype(int).clip(0, [width - 2, height - 2])
    high = np.ceil(np.nanmax(seen, 0) + 6).astype(int).clip(low + 2, [width, height])
    if not np.isfinite(seen).all():
        low, high = np.zeros(2, int), np.array(size)
    x, y = np.arange(width), np.arange(height)
    picture = (90 + 25 * np.outer(np.cos(y / 51), np.sin(x / 37))).astype(np.float32)
    wide, high_px = (int(side) * oversample for side in high - low)
    u = low[0] + (np.arange(wide) + 0.5) / oversample - 0.5
    v = low[1] + (np.arange(high_px) + 0.5) / oversample - 0.5
    rays = lens.unproject(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)) @ R
    origin = -R.T @ t
    bx = by = np.zeros(len(rays))
    with np.errstate(invalid="ignore", divide="ignore"):
        for _ in range(1 if not shape[:2].any() else 6):
            z = shape[0] * (1 - (bx / board.half_extent[0]) ** 2) + shape[1] * (1 - (by / board.half_extent[1]) ** 2)
            along = (z - origin[2]) / rays[:, 2]
            along = np.where(along > 0, along, np.nan)
            bx, by = origin[0] + along * rays[:, 0], origin[1] + along * rays[:, 1]
    column = bx / board.square_m + board.columns / 2
    row = by / (1 + shape[2]) / board.square_m + board.rows / 2
    on = (column > -1) & (column < board.columns + 1) & (row > -1) & (row < board.rows + 1)
    if board.kind != "checkerboard":
        ink, per_m, half = printed(board)
        on = (np.abs(bx) < half[0]) & (np.abs(by) < half[1])
        place = [
            np.clip(np.nan_to_num((a + b) * per_m - 0.5, nan=-1), -1, 3e4) for a, b in zip((bx, by), half, strict=True)
        ]
        at = [a.reshape(high_px, wide).astype(np.float32) for a in place]
        white = cv2.remap(ink, *at, cv2.INTER_LINEAR, borderValue=1.0).ravel()
    else:
        white = _squares(column.reshape(high_px, wide), row.reshape(high_px, wide), board).ravel()
    patch = np.repeat(np.repeat(picture[low[1] : high[1], low[0] : high[0]], oversample, 0), oversample, 1)
    patch = np.where(on.reshape(patch.shape), 30 + 190 * white.reshape(patch.shape), patch)
    patch = cv2.GaussianBlur(patch.astype(np.float32), (0, 0), blur * oversample)
    patch = patch.reshape(high[1] - low[1], oversample, high[0] - low[0], oversample).mean((1, 3))
    picture[low[1] : high[1], low[0] : high[0]] = patch
    vignette = np.add.outer(((y - height / 2) / width) ** 2, ((x - width / 2) / width) ** 2).astype(np.float32)
    picture *= 1 - 0.5 * vignette
    picture += noise * rng.standard_normal(picture.shape, np.float32)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def photographs(
    filmed: Filmed,
    rng: np.random.Generator,
    *,
    lens: Lens = HALF,
    size: tuple[int, int] = HALF_SIZE,
    board: Board = BOARD,
    blur: float = 0.8,
    oversample: int = 1,
) -> list[np.ndarray]:
    """Photograph each of the boards; see `photograph`."""
    return [
        photograph(R, t, rng, lens=lens, size=size, board=board, blur=blur, oversample=oversample)
        for R, t in zip(filmed.rotations, filmed.translations, strict=True)
    ]


def jpeg(picture: np.ndarray) -> bytes:
    """A picture as a JPEG of good quality."""
    import cv2

    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()


def write_film(path: Path, pictures: Sequence[np.ndarray], each: int = 1, fps: float = 2.0) -> Path:
    """Write grey pictures of HALF_SIZE as a video (MJPG), `each` frames of every one; return its path."""
    import cv2

    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, HALF_SIZE)
    for picture in pictures:
        for _ in range(each):
            writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def _squares(column: np.ndarray, row: np.ndarray, board: Board) -> np.ndarray:
    """How white each subpixel is, edges weighed by the area on either side of them."""
    with np.errstate(invalid="ignore", divide="ignore"):

        def step(distance: np.ndarray, width: np.ndarray) -> np.ndarray:
            return np.clip(distance / width, -0.5, 0.5)

        width = [np.hypot(*np.gradient(a)) for a in (column, row)]
        black = sign = np.ones_like(column)
        for a, w, count in ((column, width[0], board.columns), (row, width[1], board.rows)):
            nearest = np.clip(np.round(a), 1, count - 1)
            sign = sign * 2 * step(a - nearest, w) * np.where(nearest % 2 == 0, 1.0, -1.0)
            black = black * (0.5 + step(a, w)) * (0.5 + step(count - a, w))
        white = 1 - black * (0.5 + 0.5 * sign)
    return np.nan_to_num(white, nan=1.0)


def field_error(
    found: Lens,
    true: Lens = THESIS,
    size: tuple[int, int] = (1920, 1080),
    step: float = 20,
    theta_max: float = np.inf,
) -> tuple[float, float]:
    """Mean and largest difference of two lenses over the picture, px, after the rotation that suits best."""
    width, height = size
    pixels = np.stack(np.meshgrid(np.arange(0.0, width, step), np.arange(0.0, height, step)), -1).reshape(-1, 2)
    rays = true.unproject(pixels)
    seen = np.isfinite(rays).all(1) & (np.arccos(np.clip(rays[:, 2], -1, 1)) <= theta_max)
    pixels, rays = pixels[seen], rays[seen]
    for _ in range(10):
        projected, by_point, _ = found.project_jacobian(rays)
        good = np.isfinite(projected).all(1)
        by_turn = -by_point[good] @ pose.cross_matrix(rays[good])
        turn = np.linalg.lstsq(by_turn.reshape(-1, 3), (pixels - projected)[good].ravel(), rcond=None)[0]
        rays = rays @ pose.rotation_from_vector(turn[None])[0].T
    error = np.linalg.norm(pixels - found.project(rays), axis=1)
    return float(np.nanmean(error)), float(np.nanmax(error)) if np.isfinite(error).all() else np.inf
