"""People in a colour picture by an ONNX network: this project's own, or any YOLO export."""

import ast
import copy
import os
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import onnxruntime

PAD = 114
"""Grey level around a letterboxed picture, as ultralytics and YOLOX pad."""

MOST = 300
"""Most people reported in one picture."""

REACH_PX = 16
"""px of the network's input: a change reaches the network's output up to this far around it."""

CONTEXT = 6
"""Cells of the network's coarsest layer: the context that it needs around that."""

WHOLE = 0.6
"""Share of the input above which it is cheaper to look at all of it."""

_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
"""Types of inputs. Bytes, [1, height, width, 3], are those of a picture, as for this project's network in integers."""

PARTS = ("torso", "head", "foot")

STRIDES = ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32), (16, 32))
"""Strides, px, of the grids of places that YOLO's families look at: the usual one, P6, P2, and tiny."""


class ModelError(ValueError):
    """The file is not an ONNX model, or its output is not a person detection."""


@dataclass(frozen=True)
class Boxes:
    """People in a picture.

    Attributes:
        boxes: (n, 4) [x0, y0, x1, y1] px of the picture; may reach over its border.
        scores: (n,) from 0 to 1, in falling order.
        parts: (n, 3, 2) px of torso, head and foot; None if the network does not give them.
        turned: (n, 5) [x, y, width, height, turn]: middle and size, px, of boxes whose axes are turned (rad, from x
            towards y) as the people stand; None if only `boxes` is known.
    """

    boxes: np.ndarray
    scores: np.ndarray
    parts: np.ndarray | None = None
    turned: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.boxes)

    def take(self, which: np.ndarray) -> "Boxes":
        """Return some of the people, by a mask (n,) or by indices."""
        parts, turned = (None if item is None else item[which] for item in (self.parts, self.turned))
        return Boxes(self.boxes[which], self.scores[which], parts, turned)


@dataclass(frozen=True)
class Letterbox:
    """How a picture is fitted into a network's input: scaled by `scale`, then moved by `shift` (2,) px."""

    scale: float
    shift: np.ndarray
    size: tuple[int, int]

    @classmethod
    def fit(cls, picture: tuple[int, int], size: tuple[int, int], *, centred: bool = True) -> "Letterbox":
        """Fit a picture (width, height) into an input (width, height), in its middle or its top left corner."""
        scale = min(size[0] / picture[0], size[1] / picture[1])
        spare = np.array([size[0] - round(picture[0] * scale), size[1] - round(picture[1] * scale)])
        return cls(scale, spare // 2 if centred else np.zeros(2, int), size)

    def apply(self, picture: np.ndarray) -> np.ndarray:
        """Scale and pad a picture (height, width, 3) uint8."""
        import cv2

        width, height = round(picture.shape[1] * self.scale), round(picture.shape[0] * self.scale)
        if (width, height) == self.size == picture.shape[1::-1]:
            return picture
        out = np.full((self.size[1], self.size[0], 3), PAD, np.uint8)
        into = out[self.shift[1] : self.shift[1] + height, self.shift[0] : self.shift[0] + width]
        times = picture.shape[1] // width
        if (height, width) == picture.shape[:2]:
            into[:] = picture
        elif times % 2 and (times * height, times * width) == picture.shape[:2]:  # bilinearly it is the middle pixel
            middle = picture[times // 2 :, times // 2 :]
            cv2.resize(middle, None, into, 1 / times, 1 / times, cv2.INTER_NEAREST)
        else:
            cv2.resize(picture, (width, height), into, interpolation=cv2.INTER_LINEAR)
        return out

    def to_input(self, points: np.ndarray) -> np.ndarray:
        """Map points (..., 2) px of the picture, corner-based, to the input."""
        return points * self.scale + self.shift

    def to_picture(self, points: np.ndarray) -> np.ndarray:
        """Map points (..., 2) px of the input to the picture."""
        return (points - self.shift) / self.scale


class Network:
    """A person detector in ONNX, ready to run on the CPU.

    Args:
        model: the content of an ONNX file.
        size: (width, height) px of the input where the model leaves it open; None takes the shape of `picture`, and the
            longer side that the model's metadata say, else 640.
        confidence: least score of a person.
        iou: two boxes that overlap more than this are one person; None takes what the metadata say, else 0.7.
        threads: threads of the inference; more than one pays only on an idle machine.
        picture: (width, height) px of the pictures.

    Raises:
        ModelError: the file is not an ONNX model, or its output is none of the known detection heads.
    """

    def __init__(
        self,
        model: bytes,
        size: tuple[int, int] | None = None,
        confidence: float = 0.5,
        iou: float | None = None,
        threads: int = 1,
        picture: tuple[int, int] = (16, 9),
    ):
        self._session = _open(model, threads)
        self.confidence = confidence
        source = self._session.get_inputs()
        if len(source) != 1 or len(source[0].shape) != 4 or source[0].type not in _TYPES:
            raise ModelError(
                "expected one input [1, 3, height, width] of floats, found "
                + ", ".join(f"{item.name} {item.shape} {item.type}" for item in source)
            )
        self._name, self._type = source[0].name, _TYPES[source[0].type]
        self._expected = list(source[0].shape)  # batch, channels, height, width
        if self._type is np.uint8:
            self._expected.insert(1, self._expected.pop())
        self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        task = self.metadata.get("task", "detect")
        if task != "detect":
            raise ModelError(f"a model for the task {task!r}; expected 'detect'")
        self.iou = _overlap(self.metadata.get("iou")) if iou is None else iou
        self.names = _names(self.metadata.get("names"))
        self.size = self._input_size(size, picture)
        self._open = not any(isinstance(side, int) for side in self._expected[2:])
        self._maps: np.ndarray | None = None
        self._shape: tuple | None = None
        outputs = self._run(np.zeros((self.size[1], self.size[0], 3), np.uint8), bgr=False)
        self.head = find_head([output.shape for output in outputs], self.size, self.names, self.metadata)

    @property
    def learnt_wide(self) -> bool:
        """Whether it takes inputs of any size, and has learnt from wide pictures, not from those of one room."""
        return self.head.kind == "points" and self._open and self.metadata.get("parts") != "unknown"

    def resized(self, size: tuple[int, int]) -> "Network":
        """Return the same model for an input of another size (width, height) px, whose sides it must leave open."""
        other = copy.copy(self)
        other.size, other._maps, other._shape = self._input_size(size, size), None, None
        return other

    def detect(self, picture: np.ndarray, regions: np.ndarray | None = None) -> Boxes:
        """Find the people in a picture.

        Args:
            picture: (height, width, 3) uint8 RGB.
            regions: (n, 4) [x0, y0, x1, y1] px that hold all that has changed since the last call, if it was of a
                picture of this size; None: the whole picture. A network of this project then looks at them and a margin
                only, and repeats what it found in the rest. A YOLO export looks at the whole picture.
        """
        yolox = self.head.kind == "yolox"
        fit = Letterbox.fit((picture.shape[1], picture.shape[0]), self.size, centred=not yolox)
        if self.head.kind == "points":
            outputs = [self._maps_of(fit.apply(picture), picture.shape, fit, regions)]
        else:
            outputs = self._run(fit.apply(picture), bgr=yolox)
        boxes, scores, parts = decode(outputs, self.head, self.size, self.confidence)
        if self.metadata.get("parts") == "unknown":  # it learnt boxes alone
            parts = None
        if self.head.kind != "end2end":
            keep = suppress(boxes, scores, self.iou)
            boxes, scores, parts = boxes[keep], scores[keep], None if parts is None else parts[keep]
        boxes = fit.to_picture(boxes.reshape(-1, 2, 2)).reshape(-1, 4)[:MOST]
        return Boxes(boxes, scores[:MOST], None if parts is None else fit.to_picture(parts[:MOST]))

    def _maps_of(self, image: np.ndarray, shape: tuple, fit: Letterbox, regions: np.ndarray | None) -> np.ndarray:
        """The maps (1, 11, h, w) of an input, of which only what the regions reach is computed anew."""
        cores, maps = [], self._maps if self._shape == shape and regions is not None and self._open else None
        if maps is not None and regions is not None:
            cores = _cells(fit.to_input(regions.reshape(-1, 2, 2)).reshape(-1, 4), self.size, self._step)
        crops = [_wider(core, self.size, self._step) for core in cores]
        if maps is None or sum(map(_area, crops)) > WHOLE * self.size[0] * self.size[1]:
            self._maps, self._shape = self._run(image, bgr=False)[0], shape
            return self._maps
        stride = self.size[0] // maps.shape[3]
        for core, (left, top, right, bottom) in zip(cores, crops, strict=True):
            new = self._run(np.ascontiguousarray(image[top:bottom, left:right]), bgr=False)[0]
            x0, y0, x1, y1 = (side // stride for side in core)
            maps[:, :, y0:y1, x0:x1] = new[
                :, :, y0 - top // stride : y1 - top // stride, x0 - left // stride : x1 - left // stride
            ]
        return maps

    def _run(self, picture: np.ndarray, *, bgr: bool) -> list[np.ndarray]:
        try:
            return self._session.run(None, {self._name: _tensor(picture, self._type, bgr=bgr)})
        except Exception as error:  # onnxruntime raises RuntimeError's children of many names
            raise ModelError(f"the model cannot be run: {_first_line(error)}") from None

    def _input_size(self, wanted: tuple[int, int] | None, picture: tuple[int, int]) -> tuple[int, int]:
        batch, channels, height, width = self._expected
        if (isinstance(channels, int) and channels != 3) or (isinstance(batch, int) and batch != 1):
            raise ModelError(f"expected an input [1, 3, height, width], found {self._expected}")
        if isinstance(width, int) and isinstance(height, int):
            return width, height
        if wanted is None:
            longest = self._longest() / max(picture)
            wanted = round(picture[0] * longest), round(picture[1] * longest)
        step = self._step
        return max(-(-wanted[0] // step), 1) * step, max(-(-wanted[1] // step), 1) * step

    @property
    def _step(self) -> int:
        """The side of a cell of the coarsest layer, px, as the model's metadata say; 32 where they do not."""
        try:
            return max(int(float(self.metadata.get("stride", 32))), 1)
        except (ValueError, OverflowError):
            return 32

    def _longest(self) -> int:
        """The longer side of the input that the model's metadata say, px; 640 where they do not."""
        try:
            stated = ast.literal_eval(self.metadata["imgsz"])
            longest = int(stated if isinstance(stated, int) else max(stated[0], stated[1]))
        except (KeyError, ValueError, SyntaxError, TypeError, IndexError):
            return 640
        return longest if 0 < longest <= 4096 else 640


def own_model(*, floats: bool = False) -> bytes:
    """The content of the package's own ONNX file: in integers, or in `floats`, in which a network can learn."""
    name = "people.onnx" if floats else "people-integers.onnx"
    return (resources.files("avcli.detection") / name).read_bytes()


def _tensor(picture: np.ndarray, kind: type, *, bgr: bool) -> np.ndarray:
    """A picture (height, width, 3) uint8 as an input: its bytes, RGB from 0 to 1, or for YOLOX BGR from 0 to 255."""
    import cv2

    if kind is np.uint8:
        return np.ascontiguousarray(picture[None])
    tensor = np.empty((1, 3, *picture.shape[:2]), kind)
    tensor[0] = cv2.split(picture)[:: -1 if bgr else 1]
    if not bgr:
        tensor *= kind(1 / 255)
    return tensor


def _cells(regions: np.ndarray, size: tuple[int, int], step: int) -> list[list[int]]:
    """Regions (n, 4) px of the input and their reach in whole cells, of `step` px; one where margins meet."""
    low = np.maximum(np.floor((regions[:, :2] - REACH_PX) / step) * step, 0)
    high = np.minimum(np.ceil((regions[:, 2:] + REACH_PX) / step) * step, size)
    cores = np.column_stack([low, high]).astype(int).tolist()
    at = 0
    while at < len(cores):
        one = cores[at]
        for other in cores[at + 1 :]:
            both = [*np.minimum(one[:2], other[:2]).tolist(), *np.maximum(one[2:], other[2:]).tolist()]
            apart = _area(_wider(one, size, step)) + _area(_wider(other, size, step))
            if _area(_wider(both, size, step)) <= apart:
                cores.remove(other)
                cores[at], at = both, -1
                break
        at += 1
    return cores


def _wider(core: list[int], size: tuple[int, int], step: int) -> list[int]:
    (x0, y0, x1, y1), more = core, CONTEXT * step
    return [max(x0 - more, 0), max(y0 - more, 0), min(x1 + more, size[0]), min(y1 + more, size[1])]


def _area(box: list[int]) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def _open(model: bytes, threads: int) -> "onnxruntime.InferenceSession":
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # else it keeps a record of each run on disk
    import onnxruntime

    if model.startswith(b"version https://git-lfs"):
        raise ModelError("a git-lfs pointer instead of the model; fetch the model with git lfs pull")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ModelError(f"not an ONNX model that can be read: {_first_line(error)}") from None


def _first_line(error: Exception) -> str:
    return " ".join(str(error).strip().split("\n")[0].split())[:200]


def _overlap(text: str | None) -> float:
    try:
        value = float(text or 0.7)
    except ValueError:
        value = np.nan
    return value if 0 <= value <= 1 else 0.7


def _names(text: str | None) -> list[str] | None:
    """Class names in the order of their index, from a model's metadata."""
    try:
        value = ast.literal_eval(text or "")
        if isinstance(value, dict):
            value = [value[index] for index in range(len(value))]
        return [str(name).lower() for name in value]
    except (ValueError, SyntaxError, TypeError, KeyError):
        return None


@dataclass(frozen=True)
class Head:
    """What a network's first output holds.

    kind is "v8" (boxes, then one score a class), "v5" (an objectness before the classes), "yolox" (as v5, in units of
    the grid), "end2end" (corners, score, class; suppressed already) or "points" (this project's own maps). strides, px,
    are those of the grids that its rows belong to.
    """

    kind: str
    person: int
    transposed: bool = False
    strides: tuple[int, ...] = STRIDES[0]


def find_head(shapes: list[tuple], size: tuple[int, int], names: list[str] | None, metadata: dict) -> Head:
    """Recognize a detection head by the shape of its output, the input's size and the names of the classes.

    Raises:
        ModelError: the head is not known, or it has no class for people.
    """
    if metadata.get("head") == "points":
        return Head("points", 0)
    head, shape = None, tuple(shapes[0])
    if len(shapes) == 1 and len(shape) == 3 and shape[0] == 1:
        layouts = (_yolo_head(*shape[1:], size, strides, names) for strides in STRIDES)
        suppressed = metadata.get("end2end") == "True"
        head = _end2end(*shape[1:], size, names, suppressed=suppressed) or next(filter(None, layouts), None)
    if head is None:
        found = ", ".join(str(list(item)) for item in shapes)
        raise ModelError(f"not a known detection head: the outputs are {found}, the classes {len(names or ())}")
    return head


def _places(size: tuple[int, int], strides: tuple[int, ...]) -> int:
    """Places on all the grids of an input (width, height) px."""
    return sum(-(-size[0] // stride) * -(-size[1] // stride) for stride in strides)


def _end2end(rows: int, width: int, size: tuple[int, int], names: list[str] | None, *, suppressed: bool) -> Head | None:
    grids = {times * _places(size, strides) for strides in STRIDES for times in (1, 3)}
    if width == 6 and rows <= 1000 and (suppressed or rows not in grids):
        return Head("end2end", _person(names, len(names or ()) or 80))
    return None


def _yolo_head(
    rows: int, width: int, size: tuple[int, int], strides: tuple[int, ...], names: list[str] | None
) -> Head | None:
    """Recognize a YOLO head by its rows and columns, one of which must count the places of these grids."""
    places = _places(size, strides)
    grids = places, 3 * places
    if rows not in grids and width not in grids:
        return None
    transposed = width not in grids
    count, fields = (rows, width) if transposed else (width, rows)
    if names:
        if fields not in (4 + len(names), 5 + len(names)):
            return None
        boxes_only = fields == 4 + len(names)
    else:
        boxes_only = not transposed or (count == places and fields == 84)  # the likely layout
    kind = "v8" if boxes_only else "yolox" if count == places else "v5"
    classes = fields - (4 if boxes_only else 5)
    return Head(kind, _person(names, classes), transposed, strides) if classes >= 1 else None


def _person(names: list[str] | None, classes: int) -> int:
    if classes == 1 or names is None:
        return 0
    for name in ("person", "people", "human", "pedestrian"):
        if name in names:
            return names.index(name)
    raise ModelError(f"the model has no class 'person', only {', '.join(names[:8])}{'…' if len(names) > 8 else ''}")


def decode(outputs: list[np.ndarray], head: Head, size: tuple[int, int], confidence: float) -> tuple:
    """Read the people out of a network's outputs.

    Args:
        outputs: as the network gave them.
        head: what they hold.
        size: (width, height) px of the input.
        confidence: least score; what is not finite is dropped.

    Returns:
        Boxes (n, 4) [x0, y0, x1, y1] px of the input; scores (n,), falling; and parts (n, 3, 2) px or None.
    """
    output = outputs[0][0]
    with np.errstate(over="ignore", invalid="ignore"):  # a row that is not finite is dropped below
        boxes, scores, parts = _rows(output, head, size, confidence)
        keep = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        keep &= (scores >= confidence) & np.isfinite(scores)
    if parts is not None:
        keep &= np.isfinite(parts).all(axis=(1, 2))
    kept = np.flatnonzero(keep)
    kept = kept[np.argsort(-scores[kept], kind="stable")]
    return boxes[kept], np.clip(scores[kept], 0.0, 1.0), None if parts is None else parts[kept]


def _rows(
    output: np.ndarray, head: Head, size: tuple[int, int], confidence: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Boxes, scores and parts of all of an output's rows, whatever is in them."""
    if head.kind == "points":
        return _decode_points(output, size, confidence)
    output = output.astype(np.float64)
    if head.kind == "end2end":
        return output[:, :4], np.where(np.rint(output[:, 5]) == head.person, output[:, 4], 0.0), None
    rows = output if head.transposed else output.T
    centre, extent = rows[:, :2], rows[:, 2:4]
    scores = rows[:, 4 + head.person] if head.kind == "v8" else rows[:, 4] * rows[:, 5 + head.person]
    if head.kind == "yolox":
        centre, extent = _from_grid(centre, extent, size, head.strides)
    return np.concatenate([centre - extent / 2, centre + extent / 2], axis=1), scores, None


def _from_grid(
    centre: np.ndarray, extent: np.ndarray, size: tuple[int, int], grids: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """YOLOX's raw output: centres in cells from their own cell, log extents (Ge et al., 2021, arXiv 2107.08430)."""
    finite = centre[np.isfinite(centre)]
    if finite.size and np.abs(finite).max() > max(size) / 8:
        return centre, extent  # exported with its decoding inside
    cells, strides = [], []
    for stride in grids:
        v, u = np.mgrid[: -(-size[1] // stride), : -(-size[0] // stride)]
        cells.append(np.stack([u.ravel(), v.ravel()], axis=1))
        strides.append(np.full(u.size, stride))
    scale = np.concatenate(strides)[:, None]
    return (centre + np.concatenate(cells)) * scale, np.exp(extent) * scale


def _decode_points(maps: np.ndarray, size: tuple[int, int], confidence: float) -> tuple:
    """This project's maps (11, h, w): score (0 but at its peaks), log distances to the box's sides, parts' offsets."""
    stride = size[0] / maps.shape[2]
    v, u = np.nonzero(maps[0] >= confidence)
    values = maps[:, v, u].T.astype(np.float64)
    place = (np.stack([u, v], axis=1) + 0.5) * stride
    reach = np.exp(values[:, 1:5]) * stride
    boxes = np.concatenate([place - reach[:, :2], place + reach[:, 2:]], axis=1)
    parts = place[:, None, :] + values[:, 5:11].reshape(-1, 3, 2) * stride
    return boxes, values[:, 0], parts


def suppress(boxes: np.ndarray, scores: np.ndarray, iou: float, within: float = np.inf) -> np.ndarray:
    """Non-maximum suppression: the indices, by falling score, of boxes that are no better one's once more.

    Args:
        boxes: (n, 4) [x0, y0, x1, y1].
        scores: (n,).
        iou: from 0 to 1, of two boxes of one person at least: intersection over union.
        within: or intersection over the smaller of both.
    """
    order = np.argsort(-scores, kind="stable")
    x0, y0, x1, y1 = boxes.T
    area = np.maximum(x1 - x0, 0) * np.maximum(y1 - y0, 0)
    kept: list[int] = []
    while order.size and len(kept) < MOST:
        best, order = order[0], order[1:]
        kept.append(best)
        if not order.size:
            break
        across = np.minimum(x1[order], x1[best]) - np.maximum(x0[order], x0[best])
        down = np.minimum(y1[order], y1[best]) - np.maximum(y0[order], y0[best])
        shared = np.maximum(across, 0) * np.maximum(down, 0)
        apart = shared <= iou * np.maximum(area[order] + area[best] - shared, 1e-12)
        if within < np.inf:
            apart &= shared <= within * np.maximum(np.minimum(area[order], area[best]), 1e-12)
        order = order[apart]
    return np.array(kept, dtype=int)
