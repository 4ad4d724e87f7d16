"""Real rooms behind drawn people: photographs all round (equirectangular panoramas) as a ceiling camera would see them.

The bodies of `generate.py` and of the renderer are good enough to find people by; their rooms are too tidy. So chairs,
shelves, machines and windows come from photographs without people, whose licence has to permit it.
"""

from pathlib import Path

import cv2
import numpy as np

from avcli.pose import camera_pose

SIDE = 1024
"""px, width of a panorama that is kept."""


def _read(path: Path) -> np.ndarray:
    """A panorama (SIDE / 2, SIDE, 3) uint8 RGB; one of high dynamic range is exposed by its median (Reinhard, 2002)."""
    picture = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
    picture = cv2.resize(picture, (SIDE, SIDE // 2), interpolation=cv2.INTER_AREA)[..., ::-1]
    if picture.dtype != np.uint8:
        light = picture * (0.25 / max(float(np.median(picture)), 1e-4))
        picture = np.clip(255 * (light / (1 + light)) ** (1 / 2.2), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(picture)


class Backdrops:
    """Pictures of real rooms by random cameras.

    Args:
        folder: of panoramas (*.hdr, *.jpg, *.png) without people.
    """

    def __init__(self, folder: Path):
        paths = sorted(path for path in folder.iterdir() if path.suffix in (".hdr", ".jpg", ".png"))
        if not paths:
            raise FileNotFoundError(f"{folder}: no panoramas")
        self.panoramas = [_read(path) for path in paths]

    def __call__(self, rng: np.random.Generator, rays: np.ndarray, height: float, walls: np.ndarray) -> np.ndarray:
        """See a room along rays.

        Half of the rooms are laid on a box, floor and walls where the drawn room has them, and seen from the ceiling;
        of the others only the direction counts, upright or in any attitude.

        Args:
            rays: (h, w, 3) unit vectors in the room, NaN where the lens sees nothing.
            height: of the camera, m.
            walls: distances (4,) of the walls at +x, -x, +y, -y, m.

        Returns:
            Picture (2 h, 2 w, 3) float32 in 0 to 1, black where the lens sees nothing.
        """
        h, w = rays.shape[:2]
        # NaN spreads by half a cell when rays are interpolated; a direction need not have length 1.
        fine = cv2.resize(rays.astype(np.float32), (2 * w, 2 * h), interpolation=cv2.INTER_LINEAR)
        kind = rng.random()
        if kind < 0.5:
            with np.errstate(divide="ignore", invalid="ignore"):
                top = rng.uniform(0.1, 1.0)  # the ceiling above the camera
                reach = np.minimum.reduce(
                    [
                        np.where(fine[..., 0] > 0, walls[0], -walls[1]) / fine[..., 0],
                        np.where(fine[..., 1] > 0, walls[2], -walls[3]) / fine[..., 1],
                        np.where(fine[..., 2] > 0, top, -height) / fine[..., 2],
                    ]
                )
            stood = [rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), rng.uniform(1.0, 1.7) - height]
            fine = fine * reach[..., None] - np.array(stood, np.float32)
        turn = rng.uniform(0, 360)
        if kind > 0.75:
            fine = (
                fine
                @ camera_pose([0, 0, 0], [rng.uniform(0, 180), turn, rng.uniform(0, 360)]).astype(np.float32)[:3, :3]
            )
        sight = np.isfinite(fine).all(axis=2)
        fine[~sight] = 1.0
        azimuth = (np.arctan2(fine[..., 1], fine[..., 0]) * (SIDE / (2 * np.pi)) + turn * (SIDE / 360)) % SIDE
        polar = np.arctan2(np.hypot(fine[..., 0], fine[..., 1]), fine[..., 2]) * (SIDE / (2 * np.pi))
        panorama = self.panoramas[rng.integers(len(self.panoramas))]
        seen = cv2.remap(
            panorama, azimuth.astype(np.float32), polar.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        seen[~sight] = 0
        return seen.astype(np.float32) * np.float32(1 / 255)

    def furnished(
        self, rng: np.random.Generator, rays: np.ndarray, height: float, walls: np.ndarray, size
    ) -> np.ndarray:
        """A room as `__call__` sees it, (height, width, 3) for size (width, height), and pieces of others in it.

        The pieces are blobs of a person's size that are no people.
        """
        picture = cv2.resize(self(rng, rays, height, walls), size, interpolation=cv2.INTER_LINEAR)
        w, h = size
        mask = np.zeros((h, w), np.uint8)
        for _ in range(rng.integers(0, 6)):
            middle, half, turn = rng.uniform([0, 0], [w, h]), rng.uniform(8, 50, 2), rng.uniform(0, 360)
            if rng.random() < 0.5:
                cv2.ellipse(mask, (tuple(map(float, middle)), tuple(map(float, 2 * half)), turn), 1, -1)
            else:
                corners = middle + rng.uniform(-1, 1, (int(rng.integers(3, 8)), 2)) * half
                cv2.fillPoly(mask, [cv2.convexHull(corners.astype(np.float32)).astype(np.int32)], 1)
        if mask.any():
            part = rng.integers(SIDE // 4, SIDE // 2)
            x, y = rng.integers(SIDE - part), rng.integers(SIDE // 2 - part + 1)
            piece = self.panoramas[rng.integers(len(self.panoramas))][y : y + part, x : x + part]
            piece = cv2.resize(piece, size).astype(np.float32) * np.float32(rng.uniform(0.4, 1.3) / 255)
            blend(picture, piece, mask)
        return picture


def blend(picture: np.ndarray, other: np.ndarray, mask: np.ndarray) -> None:
    """Put another picture into a picture (h, w, 3), in place, where the mask (h, w) is 1, with soft edges."""
    soft = cv2.blur(mask.astype(np.float32), (3, 3))[..., None]
    picture += (other - picture) * soft


def stamped(rng: np.random.Generator, picture: np.ndarray) -> None:
    """Write a line of letters and digits, as recorders do, into a picture (h, w, 3), in place."""
    letters = "".join(rng.choice(list("0123456789:-/. CAMPMch"), int(rng.integers(4, 24))))
    h, w = picture.shape[:2]
    spot = int(rng.uniform(0, 0.8 * w)), int(rng.choice([rng.uniform(8, 30), h - rng.uniform(4, 30)]))
    ink = np.zeros((h, w), np.uint8)
    thick = int(rng.integers(1, 3))
    cv2.putText(ink, letters, spot, int(rng.integers(0, 6)), rng.uniform(0.3, 0.9), 255, thick, cv2.LINE_AA)
    picture += (np.float32(rng.random() < 0.8) - picture) * (ink.astype(np.float32) / 255)[..., None]


def dimmed(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """A picture (h, w, 3) in another light: darker, of another colour, with dark corners, a line of text."""
    h, w = picture.shape[:2]
    out = picture * (np.float32(np.exp(rng.uniform(-0.9, 0.3))) * rng.uniform(0.8, 1.2, 3).astype(np.float32))
    if rng.random() < 0.5:
        y, x = np.mgrid[:h, :w].astype(np.float32)
        far = ((x - rng.uniform(0.4, 0.6) * w) ** 2 + (y - rng.uniform(0.2, 0.8) * h) ** 2) / (0.5 * w) ** 2
        out /= (1 + np.float32(rng.uniform(0, 1.2)) * far * far)[..., None]
    if rng.random() < 0.3:
        stamped(rng, out)
    return out


def floor_coloured(
    rng: np.random.Generator, picture: np.ndarray, mask: np.ndarray, boxes: np.ndarray, parts: np.ndarray
) -> np.ndarray:
    """A picture whose people wear, now and then, trousers of the colour of what is behind them.

    Real boxes end at the shirt otherwise, since legs that hardly differ from the floor are rare among random colours.

    Args:
        picture: (h, w, 3) uint8.
        mask: (h, w), 1 where a person is seen.
        boxes, parts: (n, 4), (n, 3, 2) px, see `generate.Sample`.
    """
    h, w = mask.shape
    out = picture.copy()
    for box, (torso, _, foot) in zip(boxes, parts, strict=True):
        low, high = np.maximum(box[:2], 0).astype(int), np.minimum(np.ceil(box[2:]), [w, h]).astype(int)
        axis = foot - torso
        long = float(np.hypot(*axis))
        if rng.random() > 0.35 or (high - low).min() < 8 or long < 6:
            continue
        edge = int(0.15 * (high - low).max()) + 2
        x0, y0 = np.maximum(low - edge, 0)
        x1, y1 = np.minimum(high + edge, [w, h])
        v, u = np.mgrid[y0:y1, x0:x1] + 0.5
        along = ((u - torso[0]) * axis[0] + (v - torso[1]) * axis[1]) / long**2
        start = rng.uniform(-0.1, 0.3) if rng.random() < 0.75 else -9.0
        below = (along > start) & (along < (rng.uniform(0.75, 0.95) if rng.random() < 0.6 else 9.0))
        here, seen = out[y0:y1, x0:x1], mask[y0:y1, x0:x1] > 0
        inside = (u > low[0]) & (u < high[0]) & (v > low[1]) & (v < high[1])
        legs, floor = below & seen & inside, ~seen & (along > start)
        if legs.sum() < 12 or floor.sum() < 12:
            continue
        light = cv2.blur(here, (3, 3)).mean(axis=2, dtype=np.float32) + 12
        folds = np.clip(light / light[legs].mean(), 0.5, 1.8) ** rng.uniform(0.2, 1.0)
        cloth = np.median(here[floor], axis=0) * np.exp(rng.normal(0, 0.05, 3) + rng.normal(0, 0.18))
        worn, whole = (cv2.blur(part.astype(np.float32), (3, 3)) for part in (legs, seen))
        soft = np.where(seen, worn / np.maximum(whole, 1e-3), 0) * rng.uniform(0.7, 1)  # sharp where the body ends
        here[:] = np.clip(here + (folds[..., None] * cloth - here) * soft[..., None], 0, 255)
    return out
