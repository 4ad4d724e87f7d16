"""What a real sensor does to a perfect picture: motion blur, lens, light, noise, sharpening, time stamp and JPEG."""

from collections.abc import Sequence
from datetime import datetime, timedelta

import numpy as np

from avcli.scene.settings import Effects

_SHARPENED_PX = 1.0  # standard deviation of the blur whose difference sharpening adds
_BEGIN = datetime(2025, 1, 1, 9)


def expose(
    rgb: np.ndarray, effects: Effects, centre: tuple[float, float], generator: np.random.Generator, time: float = 0.0
) -> np.ndarray:
    """Apply a sensor's effects to a picture, in the order in which light meets them.

    Args:
        rgb: (height, width, 3) uint8.
        effects: which, and how strong.
        centre: (x, y) px, where the optical axis meets the picture.
        generator: of the noise.
        time: s, for the time stamp.

    Returns:
        (height, width, 3) uint8.
    """
    if effects == Effects():
        return rgb
    if effects.aberration_px:
        rgb = _spread(rgb, effects.aberration_px, centre)
    light = _LIGHT[rgb]
    if effects.blur_px:
        light = _softened(light, effects.blur_px)
    if effects.vignetting:
        light = light * (1 - effects.vignetting * _corner_fraction(rgb.shape, centre) ** 2)[..., None]
    if effects.exposure_ev:
        light = light * np.float32(2.0**effects.exposure_ev)
    if effects.full_well_e:
        noise = generator.standard_normal(light.shape, np.float32)
        light = light + noise * np.sqrt(np.maximum(light, 0) / np.float32(effects.full_well_e))
    if effects.read_noise:
        light = light + np.float32(effects.read_noise / 255) * generator.standard_normal(light.shape, np.float32)
    picture = np.sqrt(np.clip(light, 0, 1))
    if effects.sharpening:
        fine = picture - _softened(picture, _SHARPENED_PX)
        picture = np.clip(picture + np.float32(effects.sharpening) * fine, 0, 1)
    picture = np.rint(255 * picture).astype(np.uint8)
    if effects.time_stamp:
        _stamp(picture, time)
    return _compressed(picture, effects.jpeg_quality) if effects.jpeg_quality else picture


def _spread(rgb: np.ndarray, aberration_px: float, centre: tuple[float, float]) -> np.ndarray:
    """Magnify red and shrink blue about the centre, by aberration_px at the farthest corner."""
    import cv2

    height, width = rgb.shape[:2]
    farthest = _farthest((height, width), centre)
    channels = []
    for channel, sign in ((0, -1.0), (1, 0.0), (2, 1.0)):
        # A pixel takes what a ray of green at a smaller (red) or larger (blue) radius would have brought.
        scale = 1 + sign * aberration_px / farthest
        matrix = np.array([[scale, 0, centre[0] * (1 - scale)], [0, scale, centre[1] * (1 - scale)]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        plane = np.ascontiguousarray(rgb[..., channel])
        moved = cv2.warpAffine(plane, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        channels.append(moved if sign else plane)
    return np.stack(channels, -1)


def _softened(picture: np.ndarray, sigma: float) -> np.ndarray:
    """A picture (height, width, 3) float32 blurred by a Gaussian of sigma px."""
    import cv2

    return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))


def _stamp(picture: np.ndarray, time: float) -> None:
    """Write date and time into the upper left corner, white with a dark rim; the scene begins at `_BEGIN`."""
    import cv2

    size = picture.shape[0] / 720
    text = f"{_BEGIN + timedelta(seconds=time):%Y-%m-%d %H:%M:%S}"
    strip = picture[: round(60 * size) + 1]
    letters = np.zeros(strip.shape[:2], np.uint8)
    place, thickness = (round(20 * size), round(40 * size)), max(1, round(2 * size))
    cv2.putText(letters, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, 255, thickness, cv2.LINE_AA)
    # Not a second, bolder text: its letters are wider and stand elsewhere.
    rim = cv2.dilate(letters, np.ones((2 * max(1, round(1.5 * size)) + 1,) * 2, np.uint8))
    for colour, cover in ((20.0, rim), (245.0, letters)):
        share = cover[..., None] / np.float32(255)
        strip[:] = np.rint(strip + share * (colour - strip)).astype(np.uint8)


def _compressed(rgb: np.ndarray, quality: int) -> np.ndarray:
    import cv2

    _, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None  # it was encoded a line above
    return np.ascontiguousarray(decoded[..., ::-1])


def blurred(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Average the light of pictures, (height, width, 3) uint8 each, as an open shutter does; the same shape."""
    total = sum(_LIGHT[picture] for picture in pictures) / np.float32(len(pictures))
    return np.rint(255 * np.sqrt(total)).astype(np.uint8)


_LIGHT = ((np.arange(256) / 255) ** 2).astype(np.float32)  # the renderer's pictures have gamma 2


def _farthest(shape: tuple[int, ...], centre: tuple[float, float]) -> float:
    corners = np.array([[x, y] for x in (0, shape[1] - 1) for y in (0, shape[0] - 1)], float)
    return max(float(np.linalg.norm(corners - centre, axis=1).max()), 1e-9)


def _corner_fraction(shape: tuple[int, ...], centre: tuple[float, float]) -> np.ndarray:
    """Distance of each pixel from the axis over that of the farthest corner, (height, width) float32."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    return (np.hypot(x - centre[0], y - centre[1]) / _farthest(shape, centre)).astype(np.float32)
