"""ONNX person detectors: every layout of a head from a hand-made graph that says constants, and what is refused."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avcli.detection.network import Letterbox, ModelError, Network, find_head, suppress

WIDTH, HEIGHT = 96, 64
ANCHORS = 12 * 8 + 6 * 4 + 3 * 2
PERSON = np.array([12.0, 20.0, 28.0, 52.0])


def model(output, *, size=(HEIGHT, WIDTH), half=False, outputs=1, **metadata) -> bytes:
    """An ONNX file that answers any picture with `output`."""
    from onnx import TensorProto, helper, numpy_helper

    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    picture = helper.make_tensor_value_info("images", kind, [1, 3, *size])
    answer = np.asarray(output, np.float16 if half else np.float32)
    nodes, results = [], []
    for index in range(outputs):
        nodes.append(helper.make_node("Constant", [], [f"constant{index}"], value=numpy_helper.from_array(answer)))
        nodes.append(helper.make_node("Mul", [f"constant{index}", "one"], [f"output{index}"]))
        results.append(helper.make_tensor_value_info(f"output{index}", kind, answer.shape))
    # The picture takes part with weight 0, so that the graph has its input.
    nodes.insert(0, helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0))
    nodes.insert(1, helper.make_node("Mul", ["mean", "zero"], ["nothing"]))
    nodes.insert(2, helper.make_node("Add", ["nothing", "unit"], ["one"]))
    constants = [
        numpy_helper.from_array(np.array(value, answer.dtype), name) for name, value in (("zero", 0.0), ("unit", 1.0))
    ]
    graph = helper.make_graph(nodes, "constant", [picture], results, constants)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    for key, value in metadata.items():
        made.metadata_props.add(key=key, value=value)
    return made.SerializeToString()


def rows(fields, person=0, objectness=False, score=0.9):
    """(anchors, fields) with one person at PERSON in row 5 and everything else far below the threshold."""
    table = np.zeros((ANCHORS, fields))
    table[:, :4] = [30, 30, 4, 4]
    table[5, :4] = [*(PERSON[:2] + PERSON[2:]) / 2, *(PERSON[2:] - PERSON[:2])]
    if objectness:
        table[5, 4] = 0.95
        table[5, 5 + person] = score / 0.95
    else:
        table[5, 4 + person] = score
    return table


NAMES = "{0: 'chair', 1: 'table', 2: 'person'}"
COCO = str({0: "person", **{k: f"thing{k}" for k in range(1, 80)}})


def v5(classes=80):
    table = np.zeros((3 * ANCHORS, 5 + classes))
    table[7, :4] = [*(PERSON[:2] + PERSON[2:]) / 2, *(PERSON[2:] - PERSON[:2])]
    table[7, 4], table[7, 5] = 0.95, 0.9 / 0.95
    return table[None]


def yolox(classes=80):
    """YOLOX's raw output: offsets from a cell of the coarsest grid, logs of the size."""
    table = np.zeros((ANCHORS, 5 + classes))
    centre, extent = (PERSON[:2] + PERSON[2:]) / 2, PERSON[2:] - PERSON[:2]
    row = 12 * 8 + 2 * 6 + 1  # cell (1, 2) at stride 16
    table[row, :2] = centre / 16 - [1, 2]
    table[row, 2:4] = np.log(extent / 16)
    table[row, 4], table[row, 5] = 0.95, 0.9 / 0.95
    return table[None]


END2END = np.zeros((1, 30, 6))
END2END[0, 0] = [*PERSON, 0.9, 2]
END2END[0, 1] = [*PERSON + 1, 0.95, 0]  # a chair

LAYOUTS = {
    "v8, 80 classes": (rows(84).T[None], {"names": COCO}),
    "v8, 80 classes, nameless": (rows(84).T[None], {}),
    "v8, one class": (rows(5).T[None], {"names": "{0: 'person'}"}),
    "v8, person is class 2": (rows(7, person=2).T[None], {"names": NAMES}),
    "v8, transposed": (rows(84)[None], {"names": COCO}),
    "v8, transposed, nameless": (rows(84)[None], {}),
    "v5": (v5(), {}),
    "v5, one class": (v5(1), {"names": "['person']"}),
    "yolox": (yolox(), {}),
    "yolox, one class": (yolox(1), {}),
    "yolox, decoded inside": (rows(85, objectness=True)[None], {}),
    "end to end": (END2END, {"names": NAMES, "end2end": "True"}),
}


@pytest.mark.parametrize("half", [False, True], ids=["fp32", "fp16"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_gives_the_person(layout, half):
    output, metadata = LAYOUTS[layout]
    found = Network(model(output, half=half, **metadata)).detect(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert len(found) == 1
    assert np.allclose(found.boxes[0], PERSON, atol=0.1 if half else 1e-3)
    assert found.scores[0] == pytest.approx(0.9, abs=2e-3 if half else 1e-5)
    assert found.parts is None


@pytest.mark.parametrize("size", [("h", "w"), (-1, -1)])
def test_an_open_size_is_taken_from_the_metadata_or_the_caller(size):
    output, metadata = LAYOUTS["v8, 80 classes"]
    dims = [item if isinstance(item, str) else None for item in size]
    stated = Network(model(output, size=dims, imgsz="[64, 96]", **metadata))
    assert stated.size == (96, 64)
    assert Network(model(output, size=dims, imgsz="[96, 64]", **metadata), (96, 64)).size == (96, 64)
    assert len(stated.detect(np.zeros((36, 96, 3), np.uint8))) == 1


def test_boxes_come_back_through_the_letterbox():
    output, metadata = LAYOUTS["v8, 80 classes"]
    found = Network(model(output, **metadata)).detect(
        np.zeros((72, 192, 3), np.uint8)
    )  # half size, 14 px of grey above
    assert np.allclose(found.boxes[0], (PERSON - [0, 14, 0, 14]) * 2)
    corner = Network(model(yolox())).detect(np.zeros((72, 192, 3), np.uint8))  # YOLOX: in the corner
    assert np.allclose(corner.boxes[0], PERSON * 2, atol=1e-4)


@given(st.integers(8, 2000), st.integers(8, 2000), st.integers(1, 20), st.integers(1, 20), st.booleans())
def test_a_letterbox_and_its_inverse_are_exact(width, height, across, down, centred):
    fit = Letterbox.fit((width, height), (32 * across, 32 * down), centred=centred)
    points = np.array([[0.0, 0.0], [width, height], [width / 3, height / 7]])
    assert np.allclose(fit.to_picture(fit.to_input(points)), points, atol=1e-6)
    corners = fit.to_input(points[:2])
    assert (corners >= -1e-9).all()
    assert (corners <= np.array(fit.size) + 0.5).all()


def test_a_letterbox_pads_with_grey():
    out = Letterbox.fit((64, 32), (64, 64)).apply(np.full((32, 64, 3), 7, np.uint8))
    assert (out[16:48] == 7).all()
    assert (out[:16] == 114).all()
    assert (out[48:] == 114).all()


@pytest.mark.parametrize("times", [1, 2, 3, 5])
def test_a_picture_is_scaled_bilinearly(times):
    cv2 = pytest.importorskip("cv2")
    picture = np.random.default_rng(0).integers(0, 256, (24 * times, 32 * times, 3)).astype(np.uint8)
    out = Letterbox.fit((32 * times, 24 * times), (32, 32)).apply(picture)
    assert np.array_equal(out[4:28], cv2.resize(picture, (32, 24), interpolation=cv2.INTER_LINEAR))
    assert (out[:4] == 114).all()


def test_a_chair_over_a_person_does_not_hide_the_person():
    table = rows(84)
    table[6] = table[5]
    table[6, 4], table[6, 4 + 56] = 0.0, 0.99
    found = Network(model(table.T[None], names=COCO)).detect(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert len(found) == 1
    assert found.scores[0] == pytest.approx(0.9)


def test_the_threshold_itself_is_kept_and_no_number_dropped():
    table = rows(84, score=0.5)
    table[6, 4], table[7, 4], table[8, 0], table[8, 4] = np.nan, np.inf, np.nan, 0.9
    found = Network(model(table.T[None])).detect(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert found.scores.tolist() == [0.5]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("layout", ["v8, 80 classes", "v5", "yolox", "end to end"])
def test_rows_that_are_no_box_are_dropped_without_a_word(layout):
    output, metadata = LAYOUTS[layout]
    output = np.tile(output, 1)
    rows_of = output[0].T if layout.startswith("v8") else output[0]
    if layout == "end to end":
        rows_of[2:5] = [[28, 52, 12, 20, 0.99, 2], [np.nan, 0, 9, 9, 0.99, 2], [0, 0, np.inf, 9, 0.99, np.nan]]
    else:
        rows_of[8:11, 4:] = 1.0
        rows_of[8:11, 2:4] = [[-20, 9], [np.inf, 9], [1e4, np.nan]]  # YOLOX: of these only logs
        rows_of[11, 4:] = [np.inf, *np.zeros(rows_of.shape[1] - 5)]  # 0 times infinity
        if layout == "yolox":
            rows_of[8, 2:4] = [1e4, 9]
    found = Network(model(output, **metadata)).detect(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert np.allclose(found.boxes, [PERSON])


def test_three_hundred_people_at_most_and_no_longer_than_that():
    rng = np.random.default_rng(0)
    boxes = rng.uniform(0, 2000, (8000, 2))
    boxes = np.concatenate([boxes, boxes + 10], axis=1)
    assert len(suppress(boxes, rng.random(8000), 0.7)) == 300


def test_suppression_keeps_the_better_of_two():
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 9.5], [20, 0, 30, 10.0]])
    assert suppress(boxes, np.array([0.6, 0.8, 0.7]), 0.7).tolist() == [1, 2]
    assert suppress(boxes, np.array([0.6, 0.8, 0.7]), 0.96).tolist() == [1, 2, 0]
    assert suppress(np.zeros((0, 4)), np.zeros(0), 0.5).tolist() == []


def test_parts_of_the_projects_own_head():
    maps = np.zeros((1, 11, 8, 12))
    maps[0, 0, 3, 2] = 0.9
    maps[0, 1:5, 3, 2] = np.log([1.0, 1.5, 1.0, 2.0])
    maps[0, 5:, 3, 2] = [0, 0, 0, -1, 0.5, 1]
    found = Network(model(maps, head="points")).detect(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert np.allclose(found.boxes, [[12, 16, 28, 44]])
    assert np.allclose(found.parts, [[[20, 28], [20, 20], [24, 36]]])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "git-lfs pointer"),
        (b"", "not an ONNX model"),
        (b"\x89PNG and so on", "not an ONNX model"),
        (model(rows(84).T[None])[:400], "not an ONNX model"),
        (model(np.zeros((1, 1000))), "not a known detection head"),
        (model(np.zeros((1, 3, 8, 8))), "not a known detection head"),
        (model(rows(84).T[None], outputs=2), "not a known detection head"),
        (model(np.zeros((1, 7, 7))), "not a known detection head"),
        (model(rows(84).T[None][:, :, :100]), "not a known detection head"),
        (model(rows(84).T[None], task="segment"), "task 'segment'"),
        (model(rows(84).T[None], task="classify"), "task 'classify'"),
        (model(rows(7).T[None], names="{0: 'cat', 1: 'dog', 2: 'cow'}"), "no class 'person'"),
        (model(rows(9).T[None], names=NAMES), "not a known detection head"),
        (model(rows(84).T[None], size=(3, HEIGHT, WIDTH)), "input"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_what_is_no_person_detector_is_refused_in_one_line(content, reason):
    with pytest.raises(ModelError, match=reason) as refused:
        Network(content)
    assert "\n" not in str(refused.value)


def test_heads_by_shape():
    assert find_head([(1, 84, 5040)], (640, 384), None, {}).kind == "v8"
    assert find_head([(1, 5, 5040)], (640, 384), None, {}).kind == "v8"
    assert find_head([(1, 15120, 85)], (640, 384), None, {}).kind == "v5"
    assert find_head([(1, 5040, 85)], (640, 384), None, {}).kind == "yolox"
    assert find_head([(1, 300, 6)], (640, 384), None, {}).kind == "end2end"
    assert find_head([(1, 3549, 85)], (416, 416), None, {}).kind == "yolox"
    assert find_head([(1, 25500, 85)], (640, 640), None, {}).strides == (8, 16, 32, 64)  # 3 anchors a place, P6
    assert find_head([(1, 84, 34000)], (640, 640), None, {}).strides == (4, 8, 16, 32)


def test_a_real_network_finds_nobody_in_noise(shared_data):
    network = Network((shared_data / "models" / "yolox_nano.onnx").read_bytes())
    assert (network.head.kind, network.size) == ("yolox", (416, 416))
    noise = np.random.default_rng(0).integers(0, 255, (1080, 1920, 3), dtype=np.uint8)
    assert len(network.detect(noise)) == 0


def test_nothing_is_noted_down_of_a_run(tmp_path):
    """onnxruntime keeps a data base of its runs under the user's home, to be sent to its makers, if it is let."""
    run = "from avcli.detection.network import Network, own_model; Network(own_model(), (640, 640), 0.5)"
    kept = {name: text for name, text in os.environ.items() if name not in ("CI", "GITHUB_ACTIONS", "XDG_CACHE_HOME")}
    subprocess.run([sys.executable, "-c", run], env={**kept, "HOME": str(tmp_path)}, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*"))
