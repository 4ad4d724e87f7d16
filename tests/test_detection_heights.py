"""Heights seen before tell where somebody stands whose feet are hidden, and nothing else."""

import numpy as np
import pytest
from detection_people import ceiling_view

from avcli.detection.heights import FORGET_S, Heights
from avcli.detection.monocular import KINDS, Fitted


@pytest.fixture(scope="module")
def view():
    return ceiling_view(2)


def shown(view, x, height=1.75, hidden=0.0):
    """Box and parts of somebody at (x, 2.33), of whom what is lower than a part of the height is hidden."""
    outline = KINDS[0].outline * [1, 1, height] + [x, 2.33, 0.0]
    pixels = view.project(outline[outline[:, 2] >= hidden * height]) + 0.5
    levels = height * np.array([(hidden + 1.0) / 2 + 0.04, 0.93, hidden])
    axis = np.column_stack([np.tile([x, 2.33], (3, 1)), levels])
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])[None], view.project(axis)[None] + 0.5


def walk(view, steps, heights=None):
    """Positions along x of somebody at (x, height, hidden, time), and the places."""
    heights, places = heights or Heights(), []
    for *body, time in steps:
        box, parts = shown(view, *body)
        places.append(heights.place(box, time, Fitted(box, view, parts, scores=np.array([0.9])).places))
    return np.array([one.positions[0, 0] for one in places]), places


@pytest.mark.parametrize("x", [0.5, 0.8, 1.1])
def test_hidden_feet_make_nobody_smaller_who_was_seen_whole(view, x):
    whole, cut = (x - 0.1, 1.75, 0.0, 0.0), (x, 1.75, 0.45, 0.1)
    (alone,), (place,) = walk(view, [cut])
    (_, remembered), (_, again) = walk(view, [whole, cut])
    assert abs(remembered - x) < abs(alone - x) - 0.05
    assert again.alone == pytest.approx(place.alone)
    assert again.heights[0] > place.heights[0]


def test_who_is_seen_whole_stays_where_he_is(view):
    steps = [(1.0 + 0.1 * k, 1.75, 0.0, 0.1 * k) for k in range(5)]
    remembered, _ = walk(view, steps)
    assert remembered == pytest.approx([walk(view, [one])[0][0] for one in steps])


@pytest.mark.parametrize(("x", "time", "known"), [(1.0, 2.5, True), (4.0, 0.6, False), (1.0, FORGET_S + 1, False)])
def test_who_was_lost_is_found_again_in_reach_and_before_forgotten(view, x, time, known):
    alone = walk(view, [(0.5, 1.75, 0.45, 0.0)])[0][0]
    position = walk(view, [(x, 1.75, 0.0, 0.0), (0.5, 1.75, 0.45, time)])[0][1]
    assert (abs(position - alone) > 0.01) == known


def test_a_time_that_is_not_later_begins_anew(view):
    cut = (1.15, 1.75, 0.3, 0.0)
    assert walk(view, [(1.0, 1.75, 0.0, 5.0), cut])[0][1] == pytest.approx(walk(view, [cut])[0][0])


def test_a_child_is_remembered_as_a_child(view):
    (_, remembered), _ = walk(view, [(1.0, 1.2, 0.0, 0.0), (1.1, 1.2, 0.2, 0.1)])
    assert abs(remembered - 1.1) < 0.35


def test_nobody_and_boxes_without_a_place(view):
    heights = Heights()
    nobody = np.zeros((0, 4))
    assert not len(heights.place(nobody, 0.0, Fitted(nobody, view).places).positions)
    nowhere = np.array([[-90.0, -90.0, -80.0, -80.0]])
    for time in (0.1, 0.2):
        heights.place(nowhere, time, Fitted(nowhere, view).places)
    walk(view, [(1.0, 1.75, 0.0, 0.3)], heights)
