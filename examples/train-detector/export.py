"""Export checkpoints as the ONNX file that avdetect-video ships: python export.py CHECKPOINT... OUT.onnx [--judge N]

Of several checkpoints, of one training or of several that began with the same weights, the mean is taken. Batch norms
are folded, and the score is stretched and shifted so that it says how often such a detection is right on pictures of
other seeds than training had (Platt scaling, at the working point of best F1).

Source:
    M. Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022 (weights between two), and "Model soups",
    ICML 2022 (means of weights).
"""

import argparse
from pathlib import Path

import numpy as np
import onnx
import torch
from generate import HEIGHT, WIDTH
from judge import average_precision, judge, pictures_to_judge
from model import Detector, Exported
from onnx import TensorProto, helper, numpy_helper
from worlds import cut, read

from avcli.detection.agreement import platt


def folded(conv, norm) -> tuple:
    """Weight and bias of a convolution with its batch norm folded in."""
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    bias = torch.zeros(len(scale)) if conv.bias is None else conv.bias
    return conv.weight * scale[:, None, None, None], (bias - norm.running_mean) * scale + norm.bias


class Graph:
    """An ONNX graph of plain operators (opset 13) that is written node by node."""

    def __init__(self):
        self.nodes, self.constants, self.count = [], [], 0

    def constant(self, value) -> str:
        self.count += 1
        self.constants.append(numpy_helper.from_array(np.asarray(value), f"c{self.count}"))
        return f"c{self.count}"

    def node(self, kind: str, *inputs: str, **attributes) -> str:
        self.count += 1
        self.nodes.append(helper.make_node(kind, list(inputs), [f"n{self.count}"], **attributes))
        return f"n{self.count}"

    def conv(self, x: str, weight, bias, stride: int = 1, padding: int = 0, groups: int = 1) -> str:
        weight, bias = (self.constant(item.detach().numpy().astype(np.float32)) for item in (weight, bias))
        return self.node("Conv", x, weight, bias, strides=[stride] * 2, pads=[padding] * 4, group=groups)

    def unit(self, x: str, unit) -> str:
        conv, norm, _ = unit
        return self.node("Relu", self.conv(x, *folded(conv, norm), conv.stride[0], conv.padding[0]))

    def block(self, x: str, block) -> str:
        depthwise = block.depthwise
        y = self.conv(x, *folded(depthwise, block.norm), 1, 2, depthwise.groups)
        y = self.node("Relu", self.conv(y, block.widen.weight, block.widen.bias))
        return self.node("Add", x, self.conv(y, block.narrow.weight, block.narrow.bias))

    def blocks(self, x: str, blocks) -> str:
        for block in blocks:
            x = self.block(x, block)
        return x

    def doubled(self, x: str, lift) -> str:
        scales = self.constant(np.array([1, 1, 2, 2], np.float32))
        return self.node("Resize", self.conv(x, lift.weight, lift.bias), "", scales, mode="nearest",
                         nearest_mode="floor", coordinate_transformation_mode="asymmetric")  # fmt: skip


def to_onnx(detector: Detector, slope: float, shift: float, metadata: dict) -> bytes:
    """Write the detector as an ONNX model of open height and width."""
    graph = Graph()
    four, two = graph.constant(np.float32(4)), graph.constant(np.float32(2))
    x = graph.node("Sub", graph.node("Mul", "images", four), two)
    x = graph.blocks(graph.unit(x, detector.stem), detector.quarter)
    fine = graph.blocks(graph.unit(x, detector.eighth[0]), detector.eighth[1:])
    coarse = graph.blocks(graph.unit(fine, detector.sixteenth[0]), detector.sixteenth[1:])
    if detector.large:
        deepest = graph.blocks(graph.unit(coarse, detector.deepest[0]), detector.deepest[1:])
        coarse = graph.node("Add", coarse, graph.doubled(deepest, detector.deepest_lift))
    merged = graph.block(graph.node("Add", fine, graph.doubled(coarse, detector.lift)), detector.merge)
    merged = graph.unit(graph.blocks(merged, detector.finish), detector.heads[0])
    head = detector.heads[1]
    logit = graph.conv(merged, head.weight[:1] * slope, head.bias[:1] * slope + shift)
    score = graph.node("Sigmoid", logit)
    peak = graph.node("MaxPool", score, kernel_shape=[3, 3], strides=[1, 1], pads=[1, 1, 1, 1])
    is_peak = graph.node("Cast", graph.node("GreaterOrEqual", score, peak), to=TensorProto.FLOAT)
    score = graph.node("Mul", score, is_peak)
    rest = graph.conv(merged, head.weight[1:], head.bias[1:])
    graph.nodes.append(helper.make_node("Concat", [score, rest], ["people"], axis=1))
    made = helper.make_model(
        helper.make_graph(
            graph.nodes, "people from above",
            [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, "height", "width"])],
            [helper.make_tensor_value_info("people", TensorProto.FLOAT, [1, 11, "rows", "columns"])],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", 13)], ir_version=8, producer_name="avcli",
    )  # fmt: skip
    for key, value in metadata.items():
        made.metadata_props.add(key=key, value=value)
    onnx.checker.check_model(made)
    return made.SerializeToString()


def blended(states: list[dict], first: dict | None, towards: float) -> dict:
    """The mean of weights, or what is that far on the way to it from the `first`."""
    out = {}
    for name, value in states[-1].items():
        if value.dtype.is_floating_point:
            value = torch.stack([state[name].float() for state in states]).mean(dim=0)
            if first:
                value = first[name].float().lerp(value, towards)
        out[name] = value
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoints", type=Path, nargs="+")
    parser.add_argument("out", type=Path)
    parser.add_argument("--judge", type=int, default=200, help="pictures that the score is calibrated on")
    parser.add_argument("--weights", type=Path, help="save the weights alone, in half precision, for train.py --start")
    parser.add_argument("--seed", type=int, default=900_000, help="of those pictures")
    parser.add_argument("--panoramas", type=Path, help="photographed rooms for every second of them (backdrops.py)")
    parser.add_argument(
        "--worlds", type=Path, help="folder of further such pictures, which training has not seen (worlds.py)"
    )
    parser.add_argument("--towards", type=float, default=1.0, help="how far to go from --start to there")
    parser.add_argument("--start", type=Path, help="weights that the training began with, for --towards")
    parser.add_argument("--score", type=float, nargs=2, help="slope and shift of the score; else they are fitted")
    options = parser.parse_args()
    torch.set_num_threads(1)
    states = [torch.load(path, map_location="cpu") for path in options.checkpoints]
    first = torch.load(options.start, map_location="cpu") if options.start else None
    first = first and first.get("average", first)
    weights = blended([state["average"] for state in states], first, options.towards)
    detector = Detector("deepest_lift.weight" in weights).eval()
    detector.load_state_dict(weights)
    if options.weights:
        half = {k: v.half() if v.dtype.is_floating_point else v for k, v in weights.items()}
        torch.save(half, options.weights)
    stride, height = (32, 384) if detector.large else (16, 368)
    metadata = {"task": "detect", "head": "points", "names": "{0: 'person'}", "stride": str(stride), "iou": "0.5",
                "imgsz": f"[{height}, 640]"}  # fmt: skip
    samples = list(pictures_to_judge(options.seed, options.judge, panoramas=options.panoramas))
    if options.worlds:
        rng = np.random.default_rng(options.seed)
        samples += [cut(rng, one) for path in sorted(options.worlds.glob("[0-9]*[0-9].npz")) for one in read(path)]
    raw = judge(to_onnx(detector, 1.0, 0.0, metadata), samples, confidence=0.02)
    slope, shift = options.score or platt(raw.scores, raw.right > 0)
    steps = "+".join(str(state["step"]) for state in states)
    content = to_onnx(detector, slope, shift, metadata | {"steps": steps})
    options.out.write_bytes(content)
    with torch.no_grad():
        picture = torch.rand(1, 3, HEIGHT, WIDTH)
        wanted = Exported(detector, slope, shift)(picture).numpy()
    import onnxruntime

    got = onnxruntime.InferenceSession(content).run(None, {"images": picture.numpy()})[0]
    print(f"steps {steps}, {len(content)} bytes, torch and ONNX differ by {np.abs(wanted - got).max():.2g}")
    print(f"score: slope {slope:.3f}, shift {shift:.3f}; AP50 there {average_precision(raw):.3f}")


if __name__ == "__main__":
    main()
