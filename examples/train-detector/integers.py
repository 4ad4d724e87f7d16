"""The network in integers: python integers.py OUT.onnx --minutes 15 (on one core; --kept FILE: go on from there)

Activations are rounded to 8 bits, weights to 7, so that processors without VNNI do not overflow. The rounded network
learns to say what the one in floats says of rendered pictures, without labels, at a small rate; rounding passes the
gradient on. Input are the bytes of a picture, (1, height, width, 3). The maps of the two last convolutions stay floats.

Source:
    B. Jacob et al., "Quantization and training of neural networks for efficient integer-arithmetic-only inference",
    CVPR 2018.
"""

import argparse
import math
import time
from pathlib import Path

import cv2
import numpy as np
import onnx
import torch
from judge import pictures_to_judge
from onnx import TensorProto, helper, numpy_helper

from avcli.detection.learning import Graph
from avcli.detection.network import own_model

OWN = "com.microsoft"
"""Domain of onnxruntime's own operators."""

LEVELS, WEIGHT = 255, 63
"""Steps of an activation, and the largest rounded weight."""

SEED, PICTURES, SIDE, BATCH = 812_000, 360, 320, 8
RATE = 1.2e-5
LEAST, TAIL = 0.01, 1e-5
"""Weight of cells without people; and share of the values beyond each end of a range."""

Ranges = dict[str, tuple[float, float]]


class _Rounding(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, low, high):
        step = (high - low) / LEVELS
        zero = round(-low / step)
        ctx.save_for_backward((x >= low) & (x <= high))
        return (torch.clamp(torch.round(x / step) + zero, 0, LEVELS) - zero) * step

    @staticmethod
    def backward(ctx, gradient):
        return gradient * ctx.saved_tensors[0], None, None


def _steps(weight):
    return weight.detach().abs().amax((1, 2, 3), keepdim=True).clamp(min=1e-8) / WEIGHT


class Rounded(Graph):
    """The network with rounded weights and activations; while it has no ranges, in floats, and it watches for them."""

    def __init__(self, content: bytes, ranges: Ranges | None = None):
        super().__init__(content)
        nodes = self.proto.graph.node
        users = {name: [node for node in nodes if name in node.input] for node in nodes for name in node.output}
        self.made_by = {node.output[0]: node for node in nodes}
        self.relus = {node.input[0]: node.output[0] for node in nodes if node.op_type == "Relu"}
        self.rounded = [
            node.output[0]
            for node in nodes
            if node.op_type in ("Conv", "Add", "Relu", "Sub")
            and node.output[0] not in self.ends
            and not (node.op_type == "Conv" and [user.op_type for user in users[node.output[0]]] == ["Relu"])
        ]
        self.ranges = ranges
        self.watched: dict[str, list[list[float]]] = {name: [] for name in self.rounded}

    def made(self, node, given):
        """What a node makes of its inputs, rounded."""
        name = node.output[0]
        if self.ranges and node.op_type == "Conv" and name not in self.ends:
            step = _steps(given[1])
            given = [given[0], given[1] + (torch.round(given[1] / step) * step - given[1]).detach(), given[2]]
        value = super().made(node, given)
        if value is None or name not in self.watched:
            return value
        if self.ranges:
            return _Rounding.apply(value, *self.ranges[name])
        some = value.flatten()[torch.randint(value.numel(), (200_000,))]
        self.watched[name].append([float(torch.quantile(some, q)) for q in (TAIL, 1 - TAIL)])
        return value

    def found_ranges(self) -> Ranges:
        """The ranges of what was watched, with a level at 0; the input's are those of bytes."""
        ranges = {}
        for name, ends in self.watched.items():
            low, high = min(np.quantile(ends, 0.2, axis=0)[0], 0.0), np.quantile(ends, 0.8, axis=0)[1]
            if name == self.rounded[0]:
                low, high = self.made_of_input(0.0), self.made_of_input(1.0)
            step = (high - low) / LEVELS
            zero = round(-low / step)
            ranges[name] = (-zero * step, (LEVELS - zero) * step)
        return ranges

    def made_of_input(self, value: float) -> float:
        """What the first two nodes make of a value of the input: a factor, then a difference."""
        factor, less = (numpy_helper.to_array(one).item() for one in self.proto.graph.initializer[:2])
        return value * factor - less

    def content_in_integers(self) -> bytes:
        """The ONNX file: maps are bytes, with their channels last, in onnxruntime's own operators on integers."""
        assert self.ranges
        proto = onnx.ModelProto()
        proto.CopyFrom(self.proto)
        weights = {name: value.detach().numpy() for name, value in self.named_parameters()}
        graph = _Integers(self.ranges)
        source, first = proto.graph.input[0], self.rounded[0]
        graph.blocks(source.name, first)
        for node in self.proto.graph.node[2:]:
            out, options = node.output[0], {one.name: helper.get_attribute_value(one) for one in node.attribute}
            if node.op_type == "Conv" and out not in self.ends:
                weight, bias = (weights[name] for name in node.input[1:])
                if node.input[0] == first:  # no level of a byte is 0 there
                    bias = bias + weight.sum((1, 2, 3)) * (self.made_of_input(0.0) - self.ranges[first][0])
                    weight, options = _in_blocks(weight), options | {"strides": [4, 1], "pads": [1, 0, 1, 0]}
                to = out if out in self.ranges else self.relus[out]
                graph.conv(node.input[0], to, weight, bias, options)
            elif node.op_type == "Resize":
                (add,) = (one for one in self.proto.graph.node if out in one.input)
                graph.doubled(node.input[0], out, like=next(name for name in add.input if name != out))
            elif node.op_type == "Add":
                graph.add(*node.input, out)
            elif out == self.ends[0]:
                parts = [weights[name] for end in self.ends for name in self.made_by[end].input[1:]]
                graph.heads(node.input[0], self.ends, np.concatenate(parts[::2]), np.concatenate(parts[1::2]))
            elif node.op_type not in ("Conv", "Relu"):
                graph.nodes.append(node)
        del proto.graph.node[:], proto.graph.initializer[:]
        proto.graph.node.extend(graph.nodes)
        proto.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in graph.constants.items())
        source.CopyFrom(helper.make_tensor_value_info(source.name, TensorProto.UINT8, [1, "height", "width", 3]))
        proto.opset_import.append(helper.make_opsetid(OWN, 1))
        return proto.SerializeToString(deterministic=True)


class _Integers:
    """Nodes and constants of a network whose maps are bytes, (1, h, w, channels).

    onnxruntime finds few of these operators by itself in a graph of quantizations, and copies in between.
    """

    def __init__(self, ranges: Ranges):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, np.ndarray] = {}
        steps = {name: (high - low) / LEVELS for name, (low, high) in ranges.items()}
        self.levels = {name: (step, round(-ranges[name][0] / step)) for name, step in steps.items()}

    def node(self, kind: str, inputs: list[str], *out: str, **options) -> None:
        self.nodes.append(helper.make_node(kind, inputs, list(out), **options))

    def constant(self, name: str, value, kind: type) -> str:
        self.constants[name] = np.asarray(value, kind)
        return name

    def level(self, name: str) -> list[str]:
        """Step and zero of the bytes of a map."""
        step, zero = self.levels[name]
        return [self.constant(f"{name}_step", step, np.float32), self.constant(f"{name}_zero", zero, np.uint8)]

    def blocks(self, picture: str, out: str) -> None:
        """A picture (1, h, w, 3), one column moved, as blocks (1, h, w / 4 + 1, 12) of four columns."""
        pads = self.constant("margin", [0, 0, 1, 0, 0, 0, 3, 0], np.int64)
        self.node("Pad", [picture, pads, self.level(out)[1]], f"{out}_wide")
        self.node("Reshape", [f"{out}_wide", self.constant("blocks", [0, 0, -1, 12], np.int64)], out)

    def conv(self, x: str, out: str, weight: np.ndarray, bias: np.ndarray, options: dict) -> None:
        """A convolution, and its rectifier where the least of the bytes is 0."""
        own = _steps(torch.from_numpy(weight)).numpy().ravel()
        whole = self.constant(f"{out}_weight", np.rint(weight / own[:, None, None, None]), np.int8)
        scale = self.constant(f"{out}_scale", own, np.float32)
        zero = self.constant(f"{out}_zeros", np.zeros(len(own)), np.int8)
        start = self.constant(f"{out}_bias", np.rint(bias / (own * self.levels[x][0])), np.int32)
        inputs = [x, *self.level(x), whole, scale, zero, *self.level(out), start]
        self.node("QLinearConv", inputs, out, domain=OWN, channels_last=1, **options)

    def add(self, one: str, other: str, out: str) -> None:
        inputs = [one, *self.level(one), other, *self.level(other), *self.level(out)]
        self.node("QLinearAdd", inputs, out, domain=OWN)

    def doubled(self, x: str, out: str, like: str) -> None:
        """Each column and row twice, to the size of another map."""
        self.levels[out] = self.levels[x]
        single = self.constant("single", [0, 0, 0, 1, -1], np.int64)
        rows = self.constant("rows", [0, 0, 1, -1, self.constants[f"{x}_weight"].shape[0]], np.int64)
        self.node("Reshape", [x, single], f"{out}_single")
        self.node("Concat", [f"{out}_single"] * 2, f"{out}_columns", axis=3)
        self.node("Reshape", [f"{out}_columns", rows], f"{out}_rows")
        self.node("Concat", [f"{out}_rows"] * 2, f"{out}_both", axis=2)
        self.node("Shape", [like], f"{out}_size")
        self.node("Reshape", [f"{out}_both", f"{out}_size"], out)

    def heads(self, x: str, ends: tuple[str, str], weight: np.ndarray, bias: np.ndarray) -> None:
        """The maps that stay floats, (1, channels, h, w): the first one, and the others."""
        self.node("DequantizeLinear", [x, *self.level(x)], f"{x}_read")
        self.node("MatMul", [f"{x}_read", self.constant("heads", weight[:, :, 0, 0].T, np.float32)], "products")
        self.node("Transpose", ["products"], "logits", perm=[0, 3, 1, 2])
        self.node("Add", ["logits", self.constant("heads_bias", bias[:, None, None], np.float32)], "maps")
        self.node("Split", ["maps", self.constant("parts", [1, len(bias) - 1], np.int64)], *ends, axis=1)


def _in_blocks(weight: np.ndarray) -> np.ndarray:
    """Weights (n, 3, 6, 6) of columns -1 to 4 as weights (n, 12, 6, 2) of blocks of four columns, one column moved."""
    columns = np.pad(weight, ((0, 0), (0, 0), (0, 0), (0, 2))).reshape(*weight.shape[:3], 2, 4)
    return columns.transpose(0, 4, 1, 2, 3).reshape(len(weight), 12, 6, 2)


def batch(rng: np.random.Generator, pictures: np.ndarray) -> torch.Tensor:
    """Some parts of pictures in other sizes, turned, mirrored, in another light and noisy."""
    parts = []
    for _ in range(BATCH):
        picture = pictures[rng.integers(len(pictures))]
        side = min(int(SIDE * rng.uniform(0.5, 1.6)), *picture.shape[:2])
        y, x = (rng.integers(0, whole - side + 1) for whole in picture.shape[:2])
        how = cv2.INTER_AREA if side > SIDE else cv2.INTER_LINEAR
        part = cv2.resize(np.ascontiguousarray(picture[y : y + side, x : x + side]), (SIDE, SIDE), interpolation=how)
        part = np.rot90(part, rng.integers(4))[:, :: rng.choice([1, -1])].astype(np.float32)
        if rng.random() < 0.7:
            part = part * rng.uniform(0.6, 1.5) * rng.uniform(0.85, 1.15, 3) + rng.uniform(-20, 20)
        if rng.random() < 0.3:
            part = part + rng.normal(0, rng.uniform(2, 12), part.shape)
        parts.append(np.clip(np.rint(part), 0, 255).transpose(2, 0, 1) / 255)
    return torch.from_numpy(np.ascontiguousarray(np.stack(parts), dtype=np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--kept", type=Path, default=Path("integers.pt"), help="where the weights are kept")
    options = parser.parse_args()
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    pictures = np.stack([sample.picture for sample in pictures_to_judge(SEED, PICTURES, effects=True)])
    teacher, learner = Graph(own_model(floats=True)), Rounded(own_model(floats=True))
    if options.kept.exists():
        weights, learner.ranges = torch.load(options.kept)
        learner.load_state_dict(weights)
    else:
        with torch.no_grad():
            for _ in range(12):
                learner(batch(rng, pictures))
        learner.ranges = learner.found_ranges()
    optimizer = torch.optim.Adam(learner.parameters(), lr=RATE)
    begin, step = time.time(), 0
    while (done := (time.time() - begin) / 60 / options.minutes) < 1:
        optimizer.param_groups[0]["lr"] = RATE * min(1, step / 20) * (1 + math.cos(math.pi * done)) / 2
        seen = batch(rng, pictures)
        with torch.no_grad():
            wanted = teacher(seen)
        off, person = (learner(seen) - wanted).abs(), torch.sigmoid(wanted[:, :1])
        score = (off[:, :1] * (person + LEAST + 2 * LEAST * (wanted[:, :1] > -7))).sum() / (person + LEAST).sum()
        boxes = (off[:, 1:] * person).sum() / person.sum() / 10
        optimizer.zero_grad()
        (score + boxes).backward()
        torch.nn.utils.clip_grad_norm_(learner.parameters(), 1.0)
        optimizer.step()
        step += 1
        if step % 100 == 0:
            print(f"{step}: score {float(score):.4f}, boxes {float(boxes):.4f}", flush=True)
    torch.save((learner.state_dict(), learner.ranges), options.kept)
    options.out.write_bytes(learner.content_in_integers())


if __name__ == "__main__":
    main()
