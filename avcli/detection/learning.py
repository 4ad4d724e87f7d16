"""The package's own network, or one that came of it, as something that learns: needs torch and onnx (avcli[train]).

Batch norms are folded in an ONNX file, so learning goes on without them, at a small rate. The graph of the file stays;
only the numbers of its convolutions change.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch.nn import functional as F

RATE = 1e-3
"""Largest learning rate."""

LEARNT = 0.5
"""How far the weights go from those that began to those that were learnt: on the way they know the film's people nearly
as well, and other people better (Wortsman et al., Robust fine-tuning of zero-shot models, CVPR 2022)."""

_IGNORED = {"Sigmoid", "MaxPool", "GreaterOrEqual", "Cast", "Concat"}
"""Operators that make a score of the logit; they have nothing to learn."""


@dataclass
class Progress:
    """Where learning stands: torch's states, in plain tensors, so that it can go on in another process."""

    step: int = 0
    model: dict[str, Any] = field(default_factory=dict)
    average: dict[str, Any] = field(default_factory=dict)
    optimizer: dict[str, Any] = field(default_factory=dict)
    badly: list[float] = field(default_factory=list)


class Graph(torch.nn.Module):
    """The network of an ONNX file whose head is "points".

    Args:
        model: content of the file.

    Attributes:
        proto: what it says.
        ends: the names of the maps of the score's logit and of the rest.

    Raises:
        ValueError: it has an operator that this project's networks do not have.
    """

    def __init__(self, model: bytes) -> None:
        super().__init__()
        self.proto = onnx.load_from_string(model)
        graph = self.proto.graph
        learnt = {name for node in graph.node if node.op_type == "Conv" for name in node.input[1:]}
        self._fixed = dict[str, torch.Tensor]()
        for constant in graph.initializer:
            value = torch.from_numpy(numpy_helper.to_array(constant).copy())
            if constant.name in learnt:
                self.register_parameter(constant.name, torch.nn.Parameter(value))
            else:
                self._fixed[constant.name] = value
        known = {"Conv", "Relu", "Add", "Sub", "Mul", "Resize", *_IGNORED}
        unknown = sorted({node.op_type for node in graph.node} - known)
        sigmoids = [node for node in graph.node if node.op_type == "Sigmoid"]
        if unknown or len(sigmoids) != 1 or graph.node[-1].op_type != "Concat":
            raise ValueError(f"not a network of this project: its graph has {', '.join(unknown) or 'another head'}")
        self.ends = sigmoids[0].input[0], graph.node[-1].input[1]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """RGB in [0, 1], (n, 3, h, w), to maps (n, 11, h/8, w/8): the score's logit, logs of distances, parts."""
        values: dict[str, Any] = {**self._fixed, **dict(self.named_parameters()), self.proto.graph.input[0].name: x}
        for node in self.proto.graph.node:
            given = [values.get(name) for name in node.input]
            if all(value is not None for name, value in zip(node.input, given, strict=True) if name):
                made = self.made(node, given)
                if made is not None:
                    values[node.output[0]] = made
        return torch.cat([values[name] for name in self.ends], dim=1)

    def made(self, node: Any, given: list[Any]) -> torch.Tensor | None:
        """What a node makes of its inputs; None: nothing that is learnt from."""
        options = {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute}
        match node.op_type:
            case "Conv":
                x, weight, bias = given
                return F.conv2d(x, weight, bias, options["strides"], options["pads"][:2], 1, options["group"])
            case "Relu":
                return F.relu(given[0])
            case "Add":
                return given[0] + given[1]
            case "Sub":
                return given[0] - given[1]
            case "Mul" if given[1].ndim == 0:
                return given[0] * given[1]
            case "Resize":
                return F.interpolate(given[0], scale_factor=2.0, mode="nearest")
        return None

    def content(self, slope: float, shift: float, metadata: dict[str, str]) -> bytes:
        """The ONNX file of the network as it is now, with the score's logit stretched and shifted, and metadata."""
        proto = onnx.ModelProto()
        proto.CopyFrom(self.proto)
        (score,) = (node for node in proto.graph.node if node.output[0] == self.ends[0])
        for constant in proto.graph.initializer:
            if constant.name in dict(self.named_parameters()):
                value = self.get_parameter(constant.name).detach().numpy()
                if constant.name in score.input[1:]:
                    value = value * np.float32(slope)
                    value = value + np.float32(shift) if constant.name == score.input[2] else value
                constant.CopyFrom(numpy_helper.from_array(value.astype(np.float32), constant.name))
        kept = {one.key: one.value for one in proto.metadata_props} | metadata
        del proto.metadata_props[:]
        for key, text in kept.items():
            proto.metadata_props.add(key=key, value=text)
        return proto.SerializeToString(deterministic=True)


def loss(maps: torch.Tensor, heat: Any, negative: Any, reach: Any, weight: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """CenterNet's focal loss (Zhou et al., 2019, eq. 1) of each picture (n,), and the boxes' GIoU (Rezatofighi, 2019).

    Both are per person of the batch.
    """
    logit = maps[:, 0]
    p = torch.sigmoid(logit)
    peak = heat == 1
    positive = -((1 - p) ** 2 * F.logsigmoid(logit)) * peak
    other = -((1 - heat) ** 4 * p**2 * F.logsigmoid(-logit) * negative) * ~peak
    scores = (positive + other).sum((1, 2)) / peak.sum().clamp(min=1)
    share = weight / weight.sum().clamp(min=1e-6)
    guess, true = maps[:, 1:5].clamp(-3, 4.5).exp(), reach.exp()
    inner, outer = torch.minimum(guess, true), torch.maximum(guess, true)
    overlap, hull = ((one[:, 0] + one[:, 2]) * (one[:, 1] + one[:, 3]) for one in (inner, outer))
    union = sum((one[:, 0] + one[:, 2]) * (one[:, 1] + one[:, 3]) for one in (guess, true)) - overlap
    giou = overlap / union - (hull - union) / hull
    return scores, ((1 - giou) * share).sum()


def learn(
    graph: Graph,
    draw: Callable[[int, np.random.Generator], tuple[np.ndarray, tuple[np.ndarray, ...]]],
    count: int,
    steps: int,
    seed: int,
    progress: Progress,
    batch: int = 8,
) -> Iterator[Progress]:
    """Let a network learn; it then holds weights between those before and the mean of the last ones, see `LEARNT`.

    Args:
        graph: the network.
        draw: gives a picture (h, w, 3) uint8 and its `lessons.targets`, by its number, changed at random.
        count: number of pictures.
        steps: batches.
        seed: of all chance.
        progress: where an earlier run stopped; an empty one begins.
        batch: pictures in a batch.

    Yields:
        The progress after each step.
    """
    torch.manual_seed(seed)
    graph.to(memory_format=torch.channels_last)  # a third quicker
    optimizer = torch.optim.AdamW(graph.parameters(), lr=RATE, weight_decay=0.02)
    before = {name: value.detach().clone() for name, value in graph.named_parameters()}
    average = {name: value.clone() for name, value in before.items()}
    if progress.step:
        graph.load_state_dict(progress.model)
        optimizer.load_state_dict(progress.optimizer)
        average = progress.average
    badly = np.array(progress.badly or [1.0] * count)
    for step in range(progress.step, steps):
        chance = np.random.default_rng([seed, step])
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / 30) * (0.02 + 0.49 * (1 + math.cos(math.pi * step / steps)))
        # What was learnt badly comes more often (hard example mining, Shrivastava et al., 2016): above all the false
        # people of the empty room.
        odds = np.sqrt(badly)
        drawn = chance.choice(count, batch, p=odds / odds.sum())
        pictures, maps = zip(*(draw(int(k), chance) for k in drawn), strict=True)
        images = torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2).float().div_(255)
        with torch.autocast("cpu", torch.bfloat16):
            guess = graph(images.contiguous(memory_format=torch.channels_last))
        scores, boxes = loss(guess.float(), *(torch.from_numpy(np.stack(one)) for one in zip(*maps, strict=True)))
        badly[drawn] = scores.detach().numpy() + 0.02
        optimizer.zero_grad(set_to_none=True)
        (scores.sum() + 2.0 * boxes).backward()
        torch.nn.utils.clip_grad_norm_(graph.parameters(), 10.0)
        optimizer.step()
        decay = min(0.99, (step + 1) / (step + 11))
        with torch.no_grad():
            for name, value in graph.named_parameters():
                average[name].lerp_(value, 1 - decay)
        yield Progress(step + 1, graph.state_dict(), average, optimizer.state_dict(), badly.tolist())
    graph.load_state_dict({name: value.lerp(average[name], LEARNT) for name, value in before.items()})
