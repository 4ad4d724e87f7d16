"""What a real sensor does to a perfect picture: motion blur, lens, light, noise, sharpening, time stamp and JPEG."""

from collections.abc import Sequence
from datetime import datetime, timedelta

import numpy as np

from avcli.scene.settings import Effects

_SHARPENED_PX = 1.0  # standard deviation of the blur whose difference sharpening adds
_BEGIN = datetime(2025, 1, 1, 9)

_SETTLING_S = 0.65  # of white balance: libcamera's goes 5 % of the way in each of 30 frames a second (rpi.awb, "speed")
_TOLERATED, _SETTLED = 0.05, 0.005  # change of a gain, as a logarithm, that starts white balance, and at which it stops
_STOP = np.log(2.0)
_TINT = 0.2  # of that, green against red and blue: the lamps of random worlds differ by .14 of it, the sky by .09
_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of the light, ITU-R BT.709


class WhiteBalance:
    """What a camera holds for the colour of the light: the mean of what is lit and not clipped is grey.

    It is grey-world (G. Buchsbaum, "A spatial processor model for object colour perception", 1980), within the lights
    that a camera knows: a wooden room stays brown. The camera has run for long when a film begins. Then it follows
    slowly, and only where the light has changed: in a room where nothing happens, the gains do not change at all.

    Args:
        stops: by which red is balanced against blue, at most.
    """

    def __init__(self, stops: float) -> None:
        self._stops = stops
        self._seen: np.ndarray | None = None  # the picture of which `_wanted` is
        self._wanted = self._held = np.zeros(3, np.float32)  # logarithms of the gains
        self._gains = np.ones(3, np.float32)
        self._moves = False
        self._time: float | None = None

    def gains(self, rgb: np.ndarray, time: float) -> np.ndarray:
        """Take one more picture into account.

        Args:
            rgb: (height, width, 3) uint8, as it is drawn.
            time: s, later than that of the picture before.

        Returns:
            (3,) float32 by which the light of each channel is multiplied, so that the mean colour keeps its luma;
            the same array as before where nothing changes.
        """
        if not self._stops:
            return self._gains
        if rgb is not self._seen:
            self._seen, self._wanted = rgb, _wanted(rgb, self._stops)
        left, way = self._wanted - self._held, np.float32(1)
        if self._time is not None:
            self._moves = bool(np.abs(left).max() > (_SETTLED if self._moves else _TOLERATED))
            way = np.float32(-np.expm1((self._time - time) / _SETTLING_S) if self._moves else 0)
        if way:
            self._held = self._held + way * left
            self._gains = np.exp(self._held)
        self._time = time
        return self._gains


def _wanted(rgb: np.ndarray, stops: float) -> np.ndarray:
    """Logarithms (3,) float32 of the gains that balance a picture; 0 where all is dark or clipped."""
    step = max(1, min(rgb.shape[:2]) // 128)  # a camera's statistics are of a coarse grid too
    some = rgb[::step, ::step].reshape(-1, 3)
    most = some.max(1)
    some = some[(most > 36) & (most < 249)]
    if not len(some):
        return np.zeros(3, np.float32)
    mean = np.maximum(_LIGHT[some].mean(0), np.float32(1e-3))
    red, green, blue = np.log(mean)
    warm = np.clip(red - blue, -stops * _STOP, stops * _STOP)
    tint = np.clip(green - (red + blue) / 2, -stops * _STOP * _TINT, stops * _STOP * _TINT)
    gains = np.array([tint / 3 - warm / 2, -2 * tint / 3, tint / 3 + warm / 2], np.float32)
    return gains - np.log(mean * np.exp(gains) @ _LUMA / (mean @ _LUMA))


def expose(
    rgb: np.ndarray,
    effects: Effects,
    centre: tuple[float, float],
    generator: np.random.Generator,
    time: float = 0.0,
    gains: np.ndarray | None = None,
) -> np.ndarray:
    """Apply a sensor's effects to a picture, in the order in which light meets them.

    Args:
        rgb: (height, width, 3) uint8.
        effects: which, and how strong.
        centre: (x, y) px, where the optical axis meets the picture.
        generator: of the noise.
        time: s, for the time stamp.
        gains: (3,) of the white balance, which follows a film; None: those of this picture alone.

    Returns:
        (height, width, 3) uint8.
    """
    if effects == Effects():
        return rgb
    if effects.aberration_px:
        rgb = _spread(rgb, effects.aberration_px, centre)
    if effects.white_balance:
        gains = WhiteBalance(effects.white_balance).gains(rgb, time) if gains is None else gains
        light = _balanced(rgb, gains)
    else:
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


def _balanced(rgb: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """The light (height, width, 3) float32 of a picture times gains (3,); what the drawing has clipped stays white."""
    import cv2

    light = _LIGHT[:, None]
    return np.asarray(cv2.LUT(rgb, np.minimum(light * (gains + (1 - gains) * light**8), 1)[None]))


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
