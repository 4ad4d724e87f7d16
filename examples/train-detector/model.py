"""The embedded detector: a small fully convolutional network that marks people at their torsos, and its loss."""

import torch
from torch import nn
from torch.nn import functional as F

STRIDE = 8


class Depthwise(torch.autograd.Function):
    """A depthwise convolution (weights (c, 1, k, k), maps (n, c, h, w)) whose weights' gradient is reckoned in float32.

    In bfloat16 PyTorch needs half of a processor's training time for that gradient, and in float32 a third of it.
    """

    @staticmethod
    def forward(context, x, weight):
        context.save_for_backward(x, weight)
        return F.conv2d(x, weight, padding=weight.shape[2] // 2, groups=len(weight))

    @staticmethod
    def backward(context, gradient):
        x, weight = context.saved_tensors
        around, groups = weight.shape[2] // 2, len(weight)
        of_x = F.conv2d(gradient, weight.flip(2, 3), padding=around, groups=groups)
        of_weight = torch.ops.aten.convolution_backward(
            gradient.float(), x.float(), weight.float(), None, [1, 1], [around] * 2, [1, 1], False, [0, 0], groups,
            [False, True, False],
        )[1]  # fmt: skip
        return of_x, of_weight.to(weight.dtype)


class Block(nn.Module):
    """A residual block after ConvNeXt (Liu et al., 2022): depthwise 5 × 5, then two pointwise layers."""

    def __init__(self, channels: int):
        super().__init__()
        self.depthwise = nn.Conv2d(channels, channels, 5, padding=2, groups=channels, bias=False)
        self.norm = nn.BatchNorm2d(channels)
        self.widen = nn.Conv2d(channels, 2 * channels, 1)
        self.narrow = nn.Conv2d(2 * channels, channels, 1)

    def forward(self, x):
        if self.training and torch.is_autocast_enabled("cpu"):
            y = Depthwise.apply(x.bfloat16(), self.depthwise.weight.bfloat16())
        else:
            y = self.depthwise(x)
        return x + self.narrow(F.relu(self.widen(self.norm(y))))


def _conv(inputs: int, outputs: int, size: int, stride: int = 1, padding: int = 0) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, padding, bias=False), nn.BatchNorm2d(outputs), nn.ReLU()
    )


def _added(channels: int, count: int) -> list[Block]:
    """Blocks that change nothing until they have learnt something."""
    blocks = [Block(channels) for _ in range(count)]
    for block in blocks:
        nn.init.zeros_(block.narrow.weight)
        nn.init.zeros_(block.narrow.bias)
    return blocks


class Detector(nn.Module):
    """RGB in [0, 1], (n, 3, h, w), to maps (n, 11, h/8, w/8).

    The maps: logit of a torso being in this cell; logs of the distances, in cells, to the left, top, right and bottom
    of the box; offsets, in cells, of torso, head and foot (x, y each). The large one has more blocks, and looks at a
    32nd of the size as well; before training it says what the small one says whose weights it is given.
    """

    def __init__(self, large: bool = False):
        super().__init__()
        more = int(large)
        self.stem = _conv(3, 32, 6, 4, 1)
        self.quarter = nn.Sequential(*_added(32, more))
        self.eighth = nn.Sequential(_conv(32, 64, 3, 2, 1), Block(64), Block(64), *_added(64, 2 * more))
        blocks = [Block(96) for _ in range(4)]
        self.sixteenth = nn.Sequential(_conv(64, 96, 3, 2, 1), *blocks, *_added(96, 2 * more))
        if large:
            self.deepest = nn.Sequential(_conv(96, 192, 3, 2, 1), *(Block(192) for _ in range(4)))
            self.deepest_lift = nn.Conv2d(192, 96, 1)
            nn.init.zeros_(self.deepest_lift.weight)
            nn.init.zeros_(self.deepest_lift.bias)
        self.lift = nn.Conv2d(96, 64, 1)
        self.merge = Block(64)
        self.finish = nn.Sequential(*_added(64, more))
        self.heads = nn.Sequential(_conv(64, 64, 1), nn.Conv2d(64, 11, 1))
        nn.init.zeros_(self.heads[1].bias)
        with torch.no_grad():
            self.heads[1].bias[0] = -4.0
            self.heads[1].bias[1:5] = 1.3

    @property
    def large(self) -> bool:
        return len(self.quarter) > 0

    def begin_with(self, weights: dict) -> None:
        """Take over weights, of the same size or of the small one."""
        lacking, unknown = self.load_state_dict({name: value.float() for name, value in weights.items()}, strict=False)
        if unknown or (lacking and not self.large):
            raise ValueError(f"these are not the weights of a detector: {[*unknown, *lacking][:3]}")

    def forward(self, x):
        fine = self.eighth(self.quarter(self.stem(x * 4 - 2)))
        coarse = self.sixteenth(fine)
        if self.large:
            coarse = coarse + _doubled(self.deepest_lift(self.deepest(coarse)))
        return self.heads(self.finish(self.merge(fine + _doubled(self.lift(coarse)))))


def _doubled(x):
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


class Exported(nn.Module):
    """The detector as it is shipped: scores shifted so that 0.5 is the working point, and 0 but at their peaks."""

    def __init__(self, detector: Detector, slope: float, shift: float):
        super().__init__()
        self.detector, self.slope, self.shift = detector, slope, shift

    def forward(self, x):
        maps = self.detector(x)
        score = torch.sigmoid(self.slope * maps[:, :1] + self.shift)
        peak = F.max_pool2d(score, 3, 1, 1)
        score = score * (score >= peak).to(score.dtype)
        return torch.cat([score, maps[:, 1:]], dim=1)


def targets(boxes, parts, anchors, visible, height: int, width: int) -> tuple:
    """Maps to learn for n pictures: heat, weights of the negatives, regression (n, 10, h, w), its weight, (n, h, w).

    boxes (n, p, 4), parts (n, p, 3, 2): torso, head, foot, NaN where unknown, anchors (n, p, 2), all px;
    visible (n, p), below 0 where there is nobody. A person of whom less than a fifth is seen is neither learnt nor held
    against the network. Where people overlap, a cell belongs to whose torso it is nearest to.
    """
    device = boxes.device
    v = (torch.arange(height // STRIDE, device=device) + 0.5)[:, None]
    u = (torch.arange(width // STRIDE, device=device) + 0.5)[None, :]
    x0, y0, x1, y1 = (boxes / STRIDE)[..., None, None].unbind(2)
    area = ((x1 - x0) * (y1 - y0)).clamp(min=0)
    there = (visible >= 0)[..., None, None]
    learnt = there & (visible >= 0.2)[..., None, None] & (area >= 1.5)
    around = (v > y0 - 1) & (v < y1 + 1) & (u > x0 - 1) & (u < x1 + 1)
    negative = 1.0 - (around & there & ~learnt).any(1).float()
    spot = anchors[..., None, None] / STRIDE
    x = torch.minimum(torch.maximum(spot[:, :, 0], x0 + 0.5), x1 - 0.5).floor().clamp(0, width // STRIDE - 1)
    y = torch.minimum(torch.maximum(spot[:, :, 1], y0 + 0.5), y1 - 0.5).floor().clamp(0, height // STRIDE - 1)
    sigma = (0.12 * area.sqrt()).clamp(min=0.7)
    blob = torch.exp(-((u - x - 0.5) ** 2 + (v - y - 0.5) ** 2) / (2 * sigma**2)) * learnt
    heat = blob.amax(1)
    own = (u == x + 0.5) & (v == y + 0.5) & learnt
    fit = torch.where((blob > 0.4) & (u > x0) & (u < x1) & (v > y0) & (v < y1), blob, -1.0)
    # Of two with the same torso's cell it is the one of whom more is seen.
    fit = torch.where(own, 2 + visible[..., None, None], fit)
    best, owner = fit.max(1)
    weight = torch.where(best > 0, best.clamp(max=1), 0.0)
    owner = owner.flatten(1)[..., None]
    x0, y0, x1, y1 = (boxes / STRIDE).gather(1, owner.expand(-1, -1, 4)).unflatten(1, heat.shape[1:]).unbind(-1)
    reach = [(side.clamp(min=0.15)).log() for side in (u - x0, v - y0, x1 - u, y1 - v)]
    points = (parts / STRIDE).flatten(2).gather(1, owner.expand(-1, -1, 6)).unflatten(1, heat.shape[1:])
    offsets = [points[..., k] - (u, v)[k % 2] for k in range(6)]
    regression = torch.stack([*reach, *offsets], 1)
    return heat, negative, torch.where((weight > 0)[:, None], regression, 0.0), weight


def loss(maps, heat, negative, regression, weight) -> tuple:
    """CenterNet's focal loss (Zhou et al., 2019, eq. 1) of each picture (n,), GIoU of the boxes and L1 of the parts.

    All are per person of the batch.
    """
    logit = maps[:, 0]
    p = torch.sigmoid(logit)
    peak = heat == 1
    people = peak.sum().clamp(min=1)
    positive = -((1 - p) ** 2 * F.logsigmoid(logit)) * peak
    other = -((1 - heat) ** 4 * p**2 * F.logsigmoid(-logit) * negative) * ~peak
    scores = (positive + other).sum((1, 2))
    share = weight / weight.sum().clamp(min=1e-6)
    guess, true = maps[:, 1:5].clamp(-3, 4.5).exp(), regression[:, :4].exp()
    inner = torch.minimum(guess, true)
    outer = torch.maximum(guess, true)
    overlap = (inner[:, 0] + inner[:, 2]) * (inner[:, 1] + inner[:, 3])
    hull = (outer[:, 0] + outer[:, 2]) * (outer[:, 1] + outer[:, 3])
    area = [(box[:, 0] + box[:, 2]) * (box[:, 1] + box[:, 3]) for box in (guess, true)]
    union = area[0] + area[1] - overlap
    giou = overlap / union - (hull - union) / hull
    scale = area[1].clamp(min=1).sqrt()
    boxes = ((1 - giou) * share).sum()
    known = ~regression[:, 4:].isnan()
    away = torch.where(known, maps[:, 5:] - regression[:, 4:].nan_to_num(), 0.0).abs()
    points = (away.mean(1) / scale * share).sum()
    return scores / people, boxes, points
