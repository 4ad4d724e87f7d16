"""A calibrated camera in a room: pixels to rays and points to pixels, both in the room's frame."""

from functools import cached_property

import numpy as np

from avcli.lens import Lens
from avcli.pose import angle_from_axis

_SD_BEYOND = 0.2
"""Standard deviation of a ray's angle beyond the trusted one, as a fraction of the angle beyond it. Lenses fitted to
the inner half, two thirds and four fifths of the angles of three fisheyes (derlunz, dyfcalid, fish_1 of py-OCamCalib)
were off by up to 0.02 of it at 5 degrees, 0.1 at 10, 0.24 at 15."""


class View:
    """A camera that stands still in a room.

    Args:
        lens: a lens of avcli.lens.
        T_room_camera: (4, 4) rigid transform from the camera's frame to the room's.
        size: (width, height) px.
        theta_max: largest angle from the optical axis at which the lens is valid, rad.
        stride: distance of the samples of `rays`, px.
        theta_trusted: rad, largest angle up to which the rays are known well.
        circle: (x, y, radius) px, of what the lens lights of the picture; None: all of it.
    """

    def __init__(
        self,
        lens: Lens,
        T_room_camera: np.ndarray,
        size: tuple[int, int],
        theta_max: float = np.pi,
        stride: int = 4,
        *,
        theta_trusted: float = np.pi,
        circle: tuple[float, float, float] | None = None,
    ):
        self.theta_trusted, self.circle = theta_trusted, circle
        self.lens, self.size, self.stride, self.theta_max = lens, size, stride, min(theta_max, np.pi)
        T_room_camera = np.asarray(T_room_camera, float)
        self.rotation, self.origin = T_room_camera[:3, :3], T_room_camera[:3, 3]
        self._cos_max = np.cos(self.theta_max) - 1e-12

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points (n, 3), m in the room, to pixels (n, 2); NaN where the lens cannot see them."""
        return self.lens.project((np.asarray(points, float) - self.origin) @ self.rotation)

    @cached_property
    def below(self) -> np.ndarray | None:
        """The pixel (2,) of the point below the camera; None where the lens does not see it."""
        pixel = self.project((self.origin - [0.0, 0.0, 1.0])[None])[0]
        return pixel if np.isfinite(pixel).all() else None

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Turn pixels (n, 2) into unit rays (n, 3) in the room's frame; NaN where a pixel has none."""
        pixels = np.asarray(pixels, float)
        rays = self.lens.unproject(pixels)
        seen = (rays[:, 2] >= self._cos_max) & self.lights(pixels)
        return np.where(seen[:, None], rays, np.nan) @ self.rotation.T

    def lights(self, pixels: np.ndarray) -> np.ndarray:
        """Tell which pixels (n, 2) lie where light would reach a picture without borders."""
        if self.circle is None:
            return np.ones(len(pixels), bool)
        x, y, radius = self.circle
        return np.hypot(pixels[:, 0] - x, pixels[:, 1] - y) <= radius

    def direction_sd(self, points: np.ndarray) -> np.ndarray:
        """Standard deviation (n,), rad, of the direction to points (n, 3), m in the room, for the lens alone.

        Returns:
            0 up to the angle that is trusted; what is farther from the axis is extrapolated.
        """
        away = (np.asarray(points, float) - self.origin) @ self.rotation
        return _SD_BEYOND * np.maximum(angle_from_axis(away) - self.theta_trusted, 0.0)

    def inside(self, pixels: np.ndarray) -> np.ndarray:
        """Tell which pixels (n, 2) lie on the picture where light reaches it; NaN does not."""
        width, height = self.size
        x, y = pixels[:, 0], pixels[:, 1]
        return (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5) & self.lights(pixels)

    def sampled(self, picture: np.ndarray) -> np.ndarray:
        """Return the samples (h, w) of a full-size picture (height, width) that belong to `rays`."""
        first = self.stride // 2
        return picture[first :: self.stride, first :: self.stride]

    def radial_depth(self, picture: np.ndarray, step: float, kind: str = "radial") -> np.ndarray:
        """Turn a depth picture into metres along each sample's ray.

        Args:
            picture: (height, width) of whole steps; 0 and the type's largest number stand for "nothing measured".
            step: m.
            kind: "radial", or "z" where the picture holds depth along the optical axis.

        Returns:
            (h, w) float32 m; 0 where nothing was measured or the pixel has no ray.
        """
        steps = self.sampled(picture)
        depth = steps * np.float32(step)
        depth[steps == np.iinfo(picture.dtype).max] = 0.0
        if kind == "z":
            with np.errstate(divide="ignore", invalid="ignore"):
                depth = np.where(self.cosines > 0.01, depth / self.cosines, 0.0)
        return np.nan_to_num(depth, nan=0.0, posinf=0.0)

    def sample_indices(self, pixels: np.ndarray) -> np.ndarray:
        """Return the (column, row) (n, 2) of the sample nearest to each pixel (n, 2)."""
        width, height = self.size
        first = self.stride // 2
        last = [(width - 1 - first) // self.stride, (height - 1 - first) // self.stride]
        return np.clip(np.rint((pixels - first) / self.stride).astype(int), 0, last)

    def sample_pixels(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and columns (n,), px of the full picture, of samples in these rows and columns (n,)."""
        first = self.stride // 2
        return first + self.stride * rows, first + self.stride * columns

    @cached_property
    def rays(self) -> np.ndarray:
        """Unit rays (h, w, 3) float32 of every `stride`-th pixel, in the room's frame; NaN where a pixel has none."""
        width, height = self.size
        first = self.stride // 2
        u, v = np.meshgrid(np.arange(first, width, self.stride), np.arange(first, height, self.stride))
        rays = self.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        return rays.reshape(*u.shape, 3).astype(np.float32)

    @cached_property
    def light(self) -> np.ndarray | None:
        """Which pixels (height, width) bool the lens lights; None: all."""
        if self.circle is None:
            return None
        columns, rows = np.meshgrid(np.arange(self.size[0]), np.arange(self.size[1]))
        return self.inside(np.column_stack([columns.ravel(), rows.ravel()]).astype(float)).reshape(rows.shape)

    def lit(self, picture: np.ndarray, grey: int) -> np.ndarray:
        """A picture (height, width, 3) uint8 with a level of grey in place of what the lens does not light."""
        return picture if self.light is None else np.where(self.light[..., None], picture, np.uint8(grey))

    @cached_property
    def cosines(self) -> np.ndarray:
        """Cosine (h, w) float32 of each sample's angle from the optical axis: depth along it over radial depth."""
        return self.rays @ self.rotation[:, 2].astype(np.float32)

    @cached_property
    def solid_angles(self) -> np.ndarray:
        """Solid angle (h, w) float32 sr that each sample of `rays` stands for; 0 where a pixel has no ray."""
        rays = self.rays.astype(float)
        across, down = np.gradient(rays, axis=1), np.gradient(rays, axis=0)
        angles = np.linalg.norm(np.cross(across, down), axis=2)
        return np.nan_to_num(angles).astype(np.float32)
