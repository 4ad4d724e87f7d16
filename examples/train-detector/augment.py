"""Pictures to learn from, kept where the network learns, and shown otherwise each time: turned, in another size, light.

All is done for a whole batch at once, with torch, so that a graphics card does it where there is one.
"""

import math

import numpy as np
import torch
from generate import PAD, Sample
from torch.nn import functional as F
from worlds import BANDS, LONGEST

from avcli.detection.bands import BREADTH

SIDE = LONGEST
"""px, of the squares in which pictures are kept."""

HEIGHT, WIDTH = 448, 640
"""px, of what the network is shown."""

MOST = 24
"""People in one picture; those of whom least is seen are left out."""

SHORTEST = 480
"""px, the least length of a band of a square picture."""


class Memory:
    """Pictures and their people in one store of a fixed size, the oldest of which make room for new ones.

    Attributes:
        count: pictures in it.
        badly: how large the loss of each was last, (size,).
    """

    def __init__(self, size: int, device: torch.device):
        self.size, self.count, self._next, self._device = size, 0, 0, device
        empty = {
            "pictures": torch.zeros(size, 3, SIDE, SIDE, dtype=torch.uint8), "shown": torch.zeros(size, 2),
            "boxes": torch.zeros(size, MOST, 4), "parts": torch.zeros(size, MOST, 3, 2),
            "anchors": torch.zeros(size, MOST, 2), "visible": torch.full((size, MOST), -1.0),
        }  # fmt: skip
        self._kept = {name: value.to(device) for name, value in empty.items()}
        self.badly = torch.ones(size, device=device)

    def add(self, sample: Sample) -> None:
        """Keep a picture, of at most SIDE × SIDE px."""
        slot = self._next
        self._next, self.count = (slot + 1) % self.size, min(self.count + 1, self.size)
        height, width = sample.picture.shape[:2]
        best = np.argsort(-sample.visible)[:MOST]
        kept = self._kept
        picture = torch.from_numpy(np.ascontiguousarray(sample.picture)).to(self._device)
        kept["pictures"][slot] = PAD
        kept["pictures"][slot, :, :height, :width] = picture.permute(2, 0, 1)
        kept["shown"][slot] = torch.tensor([width, height], dtype=torch.float32)
        kept["visible"][slot] = -1
        for name in ("boxes", "parts", "anchors", "visible"):
            value = torch.from_numpy(np.asarray(getattr(sample, name), np.float32)[best])
            kept[name][slot, : len(best)] = value.to(self._device)
        self.badly[slot] = self.badly[: self.count].max()

    def drawn(self, count: int, sharpness: float = 0.5) -> torch.Tensor:
        """Numbers of `count` pictures, of odds badly^sharpness: hard examples come often (Shrivastava et al., 2016)."""
        odds = self.badly[: self.count].clamp(min=1e-3) ** sharpness
        return torch.multinomial(odds, count, replacement=count > self.count)

    def of(self, numbers: torch.Tensor) -> dict:
        return {name: value[numbers] for name, value in self._kept.items()}


def looked_at(taken: dict) -> tuple:
    """One look of the network at each picture of a batch, mirrored, turned and in other sizes at random.

    A square picture is turned by a right angle and made as long as a band may be; of it HEIGHT rows are shown, mostly
    those of the band across its middle. Others keep their way up, and are made smaller at times.

    Returns: pictures (n, 3, HEIGHT, WIDTH) float in [0, 1]; boxes, parts, anchors (px of these), visible.
    """
    pictures, shown = taken["pictures"], taken["shown"]
    n, device = len(pictures), pictures.device

    def uniform(low: float, high: float):
        return low + (high - low) * torch.rand(n, device=device)

    square = shown[:, 0] == shown[:, 1]
    smaller = torch.where(uniform(0, 1) < 0.4, uniform(0.75, 1), 1.0)
    scale = torch.where(square, uniform(SHORTEST, LONGEST) / shown[:, 0], smaller)
    quarters = torch.where(square, torch.randint(4, (n,), device=device), 0) * (math.pi / 2)
    mirror = torch.where(torch.rand(n, 2, device=device) < 0.5, -1.0, 1.0)
    cosine, sine = quarters.cos().round(), quarters.sin().round()
    turn = torch.stack([torch.stack([cosine, sine], 1), torch.stack([-sine, cosine], 1)], 1)
    turn = turn * mirror[:, :, None] * scale[:, None, None]
    size = (turn @ shown[:, :, None])[..., 0].abs()  # of the picture when it is turned and scaled
    # A window (left, top, width, height) of that, and where it is put in what the network sees.
    rows = torch.where(square & (uniform(0, 1) < BANDS), (BREADTH * size[:, 1]).round(), size[:, 1])
    first = ((size[:, 1] - rows) / 2).round()
    spare = HEIGHT - rows
    top = first - torch.where(spare >= 0, (uniform(0, 1) * (spare + 1)).floor().clamp(max=spare.clamp(min=0)),
                              -(uniform(0, 1) * (1 - spare)).floor())  # fmt: skip
    left = -((WIDTH - size[:, 0]) / 2).floor()
    shift = -torch.stack([left, top], 1) + size / 2 - (turn @ (shown[:, :, None] / 2))[..., 0]

    def moved(points):
        flat = points.reshape(n, -1, 2)
        return (flat @ turn.transpose(1, 2) + shift[:, None]).reshape(points.shape)

    v, u = torch.meshgrid(torch.arange(HEIGHT, device=device), torch.arange(WIDTH, device=device), indexing="ij")
    grid = torch.stack([u, v], -1).float().reshape(1, -1, 2) + 0.5
    back = torch.linalg.inv(turn)
    source = (grid - shift[:, None]) @ back.transpose(1, 2)
    made = F.grid_sample(pictures.float(), (source * (2 / SIDE) - 1).reshape(n, HEIGHT, WIDTH, 2),
                         padding_mode="border", align_corners=False)  # fmt: skip
    low = torch.stack([-left, first - top], 1).clamp(min=0)
    high = torch.minimum(torch.stack([size[:, 0] - left, first + rows - top], 1), grid.new_tensor([WIDTH, HEIGHT]))
    lit = ((grid > low[:, None]) & (grid < high[:, None])).all(-1).reshape(n, 1, HEIGHT, WIDTH)
    made = torch.where(lit, made, float(PAD)) / 255
    corners = moved(taken["boxes"].reshape(n, -1, 2, 2))
    boxes = torch.cat([corners.amin(2), corners.amax(2)], 2)
    clipped = torch.maximum(torch.minimum(boxes, high.repeat(1, 2)[:, None]), low.repeat(1, 2)[:, None])
    sides, whole = clipped[..., 2:] - clipped[..., :2], boxes[..., 2:] - boxes[..., :2]
    share = sides.prod(2) / whole.prod(2).clamp(min=1)
    visible = torch.where((taken["visible"] >= 0) & (share > 0.05), taken["visible"] * share, -1.0)
    anchors = torch.maximum(torch.minimum(moved(taken["anchors"]), clipped[..., 2:] - 0.5), clipped[..., :2] + 0.5)
    return made, clipped, moved(taken["parts"]), anchors, visible


def another_camera(pictures: torch.Tensor) -> torch.Tensor:
    """Pictures (n, 3, h, w) as cameras of other colours, contrast, sharpness and noise show them; some as they are."""
    n, device = len(pictures), pictures.device

    def chance(p: float):
        return (torch.rand(n, 1, 1, 1, device=device) < p).float()

    def normal(mean: float, sigma: float, channels: int = 1):
        return mean + sigma * torch.randn(n, channels, 1, 1, device=device)

    def uniform(low: float, high: float):
        return low + (high - low) * torch.rand(n, 1, 1, 1, device=device)

    bent = pictures.clamp(min=1e-4) ** normal(0, 0.35).exp()
    haze = uniform(0, 0.2)
    other = ((normal(0, 0.16, 3) + normal(-0.25, 0.45)).exp() * (bent + haze * (1 - bent))).clamp(0, 1)
    grey, colourful = other.mean(1, keepdim=True), uniform(0.15, 1.2)
    pictures = torch.lerp(pictures, (grey + colourful * (other - grey)).clamp(0, 1), chance(0.65))
    for group in torch.randperm(n, device=device)[: int(0.4 * n)].split(max(1, n // 16)):
        small = F.interpolate(pictures[group], scale_factor=float(torch.empty(()).uniform_(0.35, 0.9)), mode="area")
        pictures[group] = F.interpolate(small, size=pictures.shape[2:], mode="bilinear")
    noise = torch.randn_like(pictures) * (uniform(1, 8) / 255 * chance(0.3))
    return (pictures + noise).clamp(0, 1)
