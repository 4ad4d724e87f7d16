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


class Detector(nn.Module):
    """RGB in [0, 1], (n, 3, h, w), to maps (n, 11, h/8, w/8).

    The maps: logit of a torso being in this cell; logs of the distances, in cells, to the left, top, right and bottom
    of the box; offsets, in cells, of torso, head and foot (x, y each).
    """

    def __init__(self):
        super().__init__()
        self.stem = _conv(3, 32, 6, 4, 1)
        self.eighth = nn.Sequential(_conv(32, 64, 3, 2, 1), Block(64), Block(64))
        self.sixteenth = nn.Sequential(_conv(64, 96, 3, 2, 1), Block(96), Block(96), Block(96), Block(96))
        self.lift = nn.Conv2d(96, 64, 1)
        self.merge = Block(64)
        self.heads = nn.Sequential(_conv(64, 64, 1), nn.Conv2d(64, 11, 1))
        nn.init.zeros_(self.heads[1].bias)
        with torch.no_grad():
            self.heads[1].bias[0] = -4.0
            self.heads[1].bias[1:5] = 1.3

    def forward(self, x):
        fine = self.eighth(self.stem(x * 4 - 2))
        coarse = self.lift(self.sixteenth(fine))
        fine = self.merge(fine + F.interpolate(coarse, scale_factor=2.0, mode="nearest"))
        return self.heads(fine)


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
    """Maps to learn for one picture: heat, weights of the negatives, regression (10, h, w), its weight; (h, w) each.

    A person of whom less than a fifth is seen is neither learnt nor held against the network.
    """
    rows, columns = height // STRIDE, width // STRIDE
    heat, negative = torch.zeros(rows, columns), torch.ones(rows, columns)
    regression, weight = torch.zeros(10, rows, columns), torch.zeros(rows, columns)
    v, u = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
    for box, part, spot, seen in sorted(zip(boxes, parts, anchors, visible, strict=True), key=lambda item: item[3]):
        x0, y0, x1, y1 = (float(value) / STRIDE for value in box)
        if seen < 0.2 or (x1 - x0) * (y1 - y0) < 1.5:
            negative[(v > y0 - 1) & (v < y1 + 1) & (u > x0 - 1) & (u < x1 + 1)] = 0.0
            continue
        x, y = float(spot[0]) / STRIDE, float(spot[1]) / STRIDE
        x, y = min(max(x, x0 + 0.5), x1 - 0.5), min(max(y, y0 + 0.5), y1 - 0.5)
        column, row = min(max(int(x), 0), columns - 1), min(max(int(y), 0), rows - 1)
        sigma = max(0.12 * ((x1 - x0) * (y1 - y0)) ** 0.5, 0.7)
        blob = torch.exp(-((u - column - 0.5) ** 2 + (v - row - 0.5) ** 2) / (2 * sigma**2))
        heat = torch.maximum(heat, blob)
        here = (blob > 0.4) & (blob >= weight) & (u > x0) & (u < x1) & (v > y0) & (v < y1)
        here[row, column] = True
        reach = torch.stack([u - x0, v - y0, x1 - u, y1 - v]).clamp(min=0.15).log()
        offsets = [(float(part[k, axis]) / STRIDE) - (u, v)[axis] for k in range(3) for axis in (0, 1)]
        values = torch.cat([reach, torch.stack(offsets)])
        regression[:, here] = values[:, here]
        weight[here] = blob[here]
    return heat, negative, regression, weight


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
    points = ((maps[:, 5:] - regression[:, 4:]).abs().mean(1) / scale * share).sum()
    return scores / people, boxes, points
