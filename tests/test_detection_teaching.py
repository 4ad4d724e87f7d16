"""A network for one camera, learnt from a teacher: what it is shown, how it is judged, and the command."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from avcli.commands import avcalib
from avcli.detection import teaching
from avcli.detection.agreement import average_precision, matched, overlaps, platt
from avcli.detection.lessons import STRIDE, Lesson, drawn, lesson, targets

PERSON = np.array([[100.0, 60.0, 40.0, 80.0, 0.0]])


def shown(size=(320, 320), turn=0.0):
    """A dark picture with one bright person in a turned box."""
    picture = np.full((size[1], size[0], 3), 30, np.uint8)
    picture[20:100, 80:120] = 220
    people = PERSON.copy()
    people[:, 4] = turn
    return Lesson("a", picture, people, np.zeros((0, 4)))


def test_boxes_take_labels_best_first():
    labels = np.array([[0.0, 0, 10, 10], [20, 0, 30, 10]])
    boxes = np.array([[0.0, 0, 10, 9], [0, 0, 10, 10], [21, 0, 31, 10], [50, 50, 60, 60]])
    scores = np.array([0.5, 0.9, 0.8, 0.7])
    assert matched(boxes, scores, labels).tolist() == [False, True, True, False]
    assert overlaps(boxes[:1], labels)[0] == pytest.approx([0.9, 0])
    # Right, right, wrong, wrong: both labels are found before the first mistake.
    assert average_precision([(boxes, scores, labels)]) == 1.0
    assert average_precision([(boxes, scores, labels[:1])]) == 1.0
    late = np.array([0.5, 0.9, 0.8, 0.95])  # wrong, right, right: precision 1/2 and 2/3, made monotone
    assert average_precision([(boxes, late, labels)]) == pytest.approx(2 / 3)
    assert average_precision([(boxes, scores, np.zeros((0, 4)))]) == 0.0
    assert average_precision([]) == 0.0


def test_scores_become_probabilities():
    rng = np.random.default_rng(0)
    logit = rng.normal(0, 3, 20_000)
    right = rng.random(20_000) < 1 / (1 + np.exp(-(0.5 * logit - 1)))
    assert platt(1 / (1 + np.exp(-logit)), right) == pytest.approx((0.5, -1.0), abs=0.05)
    slope, shift = platt(np.array([0.3, 0.6]), np.array([True, True]))  # nothing is wrong: still finite
    assert np.isfinite([slope, shift]).all()


@pytest.mark.parametrize("size", [(320, 320), (320, 176)])
def test_what_is_drawn_has_its_person_where_the_maps_say(size):
    one = replace(shown(size), doubtful=np.array([[200.0, 100, 240, 140]]))
    for seed in range(40):
        picture, (heat, negative, reach, weight) = drawn(one, np.random.default_rng(seed))
        assert picture.shape == one.picture.shape
        assert heat.shape == (size[1] // STRIDE, size[0] // STRIDE)
        assert heat.max() in (0.0, 1.0)
        assert np.isfinite(reach).all()
        for row, column in np.argwhere(heat == 1):
            block = picture[row * STRIDE : (row + 1) * STRIDE, column * STRIDE : (column + 1) * STRIDE]
            assert block.mean() > 100  # the bright person, not the dark room
            width, height = np.exp(reach[:, row, column][[0, 1]]) + np.exp(reach[:, row, column][[2, 3]])
            assert 2 <= width * height <= 300  # 40 x 80 px are 50 cells, turned and cut
            assert weight[row, column] == 1
        assert negative.min() == 0 or heat.max() == 0 or size[1] < 200


def test_small_people_are_neither_learnt_nor_held_against():
    heat, negative, _, weight = targets(
        np.array([[16.0, 16, 24, 24]]), np.array([[20.0, 20]]), np.zeros((0, 4)), (64, 64)
    )
    assert heat.max() == weight.max() == 0
    assert negative[2, 2] == 0
    assert negative[7, 7] == 1


def test_a_lesson_is_at_the_scale_of_the_input():
    picture = np.zeros((1080, 1920, 3), np.uint8)
    made = lesson("a", picture, (PERSON * [3, 3, 3, 3, 1], np.array([[0.0, 0, 30, 30]])), (640, 368), PERSON[:, :4] * 3)
    assert made.picture.shape == (368, 640, 3)
    assert made.people[0] == pytest.approx([100, 64, 40, 80, 0])  # four rows of padding above
    assert made.doubtful[0] == pytest.approx([0, 4, 10, 14])
    assert made.labels is not None


def test_what_is_held_back_is_whole_parts_of_the_film():
    apart = teaching.held_back(100)
    assert np.flatnonzero(apart).tolist() == [*range(20, 30), *range(70, 80)]


def test_without_torch_the_command_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit) as ended:
        avcalib.main(["detector", str(tmp_path), "--teacher", "a.onnx", "-o", str(tmp_path / "room.onnx")])
    assert ended.value.code == 1
    assert capsys.readouterr().err == "avcalib: learning needs torch and onnx: pip install 'avcli[train]'\n"


def test_a_network_on_standard_output_is_refused():
    result = CliRunner().invoke(avcalib.main.commands["detector"], ["x", "--teacher", "a.onnx"])
    assert result.exit_code == 2
    assert "-o/--output FILE is required" in result.output


def test_the_graph_that_learns_is_the_network_of_the_file():
    torch = pytest.importorskip("torch")
    from avcli.detection.learning import Graph, Progress, learn
    from avcli.detection.network import Network, own_model

    graph = Graph(own_model(floats=True))
    picture = np.random.default_rng(1).integers(0, 255, (64, 96, 3), np.uint8)
    with torch.no_grad():
        maps = graph(torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255)
    written = Network(graph.content(1.0, 0.0, {"parts": "unknown"}), (96, 64))
    (found,) = written._run(picture, bgr=False)
    assert np.abs(found[0, 1:] - maps[0, 1:].numpy()).max() < 1e-4
    assert written.metadata["parts"] == "unknown"

    def taught(cuts):
        graph, progress = Graph(own_model(floats=True)), Progress()
        for cut in cuts:
            graph = Graph(own_model(floats=True))
            for now in learn(graph, lambda k, chance: drawn(shown((64, 64)), chance), 1, 3, 0, progress, 2):
                if now.step == cut < 3:
                    progress = now
                    break
        return graph.content(1.0, 0.0, {})

    assert taught([3]) == taught([1, 3])  # interrupted and taken up again
