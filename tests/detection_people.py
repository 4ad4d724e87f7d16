"""People of ellipsoids, cast into a depth picture ray by ray: a known answer that nothing in the package has made."""

import numpy as np

from avcli.detection.view import View
from avcli.lens import KannalaBrandt
from avcli.pose import camera_pose

# centre (forward, left, up) m, half axes m, and how much of the step's swing tilts the part
PARTS = [
    ((0.0, 0.0, 1.64), (0.10, 0.08, 0.12), 0.0),
    ((0.0, 0.0, 1.24), (0.12, 0.20, 0.31), 0.0),
    ((0.0, 0.0, 0.93), (0.12, 0.17, 0.14), 0.0),
    ((0.0, 0.25, 1.10), (0.05, 0.05, 0.33), -1.0),
    ((0.0, -0.25, 1.10), (0.05, 0.05, 0.33), 1.0),
    ((0.0, 0.09, 0.45), (0.08, 0.08, 0.47), 1.0),
    ((0.0, -0.09, 0.45), (0.08, 0.08, 0.47), -1.0),
]
KB8 = (862.27, 862.70, 1049.47, 552.76, -0.0269, -0.0038, 0.0016, -0.0006)


def ceiling_view(scale: int = 4, position=(2.33, 2.33, 2.50), stride: int = 1, lens=None) -> View:
    """The thesis's camera, `scale` times smaller than 1920 × 1080 so that a picture is cast quickly."""
    fx, fy, cx, cy, *k = KB8
    shift = (scale - 1) / 2
    lens = lens or KannalaBrandt(fx / scale, fy / scale, (cx - shift) / scale, (cy - shift) / scale, *k)
    return View(lens, camera_pose(position, [90.0, 0.0, 0.0]), (1920 // scale, 1080 // scale), stride=stride)


def cast(view: View, people=(), size=(4.66, 4.66)) -> np.ndarray:
    """Radial depth (h, w) m of an empty room with people (x, y, yaw rad, swing rad, height m); 0 without a ray."""
    rays = view.rays.astype(float)
    depth = np.full(rays.shape[:2], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, wall in ((2, 0.0), (0, 0.0), (0, size[0]), (1, 0.0), (1, size[1])):
            t = (wall - view.origin[axis]) / rays[..., axis]
            depth = np.where(t > 0, np.minimum(depth, t), depth)
        for x, y, yaw, swing, height in people:
            scale = height / 1.76
            for centre, half, share in PARTS:
                depth = np.minimum(
                    depth, _ellipsoid(view.origin, rays, (x, y, 0.0), yaw, share * swing, centre, half, scale)
                )
    return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)


def _ellipsoid(origin, rays, foot, yaw, tilt, centre, half, scale):
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    c, s = np.cos(tilt), np.sin(tilt)
    lean = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    pivot = np.array([0.0, centre[1], centre[2] + half[2]])  # limbs swing about their upper ends
    middle = pivot + lean @ (np.array(centre) - pivot)
    to_unit = (turn @ lean).T / (np.array(half)[:, None] * scale)
    start = to_unit @ (origin - (np.array(foot) + turn @ middle * scale))
    ray = rays @ to_unit.T
    a, b, c = (ray**2).sum(-1), ray @ start, start @ start - 1.0
    root = b**2 - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
