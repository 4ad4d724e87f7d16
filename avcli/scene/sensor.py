"""What a real sensor does to a perfect picture: motion blur, lens colour, vignetting, exposure, noise, JPEG."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Sensor:
    """The effects and their strengths; the defaults change nothing.

    Attributes:
        exposure_ev: stops by which the light is multiplied.
        vignetting: how much light is lost at the corner that is farthest from the axis, 0..1, with the radius squared.
        aberration_px: how far red lies outside, and blue inside, of green at that corner.
        full_well_e: electrons of a white pixel, from which shot noise follows; 0 for none.
        read_noise: standard deviation of the noise of reading, in 1/255 of white.
        jpeg_quality: 1..100, 0 for none.
    """

    exposure_ev: float = 0.0
    vignetting: float = 0.0
    aberration_px: float = 0.0
    full_well_e: float = 0.0
    read_noise: float = 0.0
    jpeg_quality: int = 0

    def expose(self, rgb, centre, generator):
        """Apply the effects to a picture in the order in which light meets them.

        Args:
            rgb: (height, width, 3) uint8.
            centre: (x, y) px, where the optical axis meets the picture.
            generator: numpy Generator, for the noise.

        Returns:
            (height, width, 3) uint8.
        """
        if self == Sensor():
            return rgb
        if self.aberration_px:
            rgb = self._spread(rgb, centre)
        light = _LIGHT[rgb]
        if self.vignetting:
            light = light * (1 - self.vignetting * _corner_fraction(rgb.shape, centre) ** 2)[..., None]
        if self.exposure_ev:
            light = light * np.float32(2.0**self.exposure_ev)
        if self.full_well_e:
            noise = generator.standard_normal(light.shape, np.float32)
            light = light + noise * np.sqrt(np.maximum(light, 0) / np.float32(self.full_well_e))
        if self.read_noise:
            light = light + np.float32(self.read_noise / 255) * generator.standard_normal(light.shape, np.float32)
        picture = np.rint(255 * np.sqrt(np.clip(light, 0, 1))).astype(np.uint8)
        return self._compressed(picture) if self.jpeg_quality else picture

    def _spread(self, rgb, centre):
        import cv2

        height, width = rgb.shape[:2]
        farthest = _farthest((height, width), centre)
        channels = []
        for channel, sign in ((0, -1.0), (1, 0.0), (2, 1.0)):
            # A pixel takes what a ray of green at a smaller (red) or larger (blue) radius would have brought.
            scale = 1 + sign * self.aberration_px / farthest
            matrix = np.array([[scale, 0, centre[0] * (1 - scale)], [0, scale, centre[1] * (1 - scale)]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            plane = np.ascontiguousarray(rgb[..., channel])
            moved = cv2.warpAffine(plane, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
            channels.append(moved if sign else plane)
        return np.stack(channels, -1)

    def _compressed(self, rgb):
        import cv2

        _, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def blurred(pictures):
    """The picture of an open shutter: the mean light of pictures (each (height, width, 3) uint8)."""
    total = sum(_LIGHT[picture] for picture in pictures) / np.float32(len(pictures))
    return np.rint(255 * np.sqrt(total)).astype(np.uint8)


_LIGHT = ((np.arange(256) / 255) ** 2).astype(np.float32)  # the renderer's pictures have gamma 2


def _farthest(shape, centre):
    corners = np.array([[x, y] for x in (0, shape[1] - 1) for y in (0, shape[0] - 1)], float)
    return max(float(np.linalg.norm(corners - centre, axis=1).max()), 1e-9)


def _corner_fraction(shape, centre):
    """Distance of each pixel from the axis over that of the farthest corner, (height, width) float32."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    return (np.hypot(x - centre[0], y - centre[1]) / _farthest(shape, centre)).astype(np.float32)
