"""People as meshes for training pictures: how a figure follows a skeleton, and how it is drawn."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples" / "train-detector"))

import meshes

from avcli.detection.view import View
from avcli.lens import KannalaBrandt
from avcli.pose import camera_pose
from avcli.scene import render
from avcli.scene.skeleton import skeleton

SIDES = "RL"


def at_rest(bones):
    """A figure of one vertex at each joint, as a skeleton that faces along x stands."""
    joints = {"pelvis": bones.trunk.pelvis[0], "waist": bones.trunk.waist[0], "chest": bones.trunk.chest[0]}
    joints |= {"neck": bones.trunk.neck[0], "head": bones.head.base[0]}
    toes = {}
    for side, arm, leg in zip(SIDES, bones.arms, bones.legs, strict=True):
        joints |= {f"upperarm.{side}": arm.shoulder[0], f"lowerarm.{side}": arm.elbow[0], f"hand.{side}": arm.wrist[0]}
        joints |= {f"thigh.{side}": leg.hip[0], f"shank.{side}": leg.knee[0], f"foot.{side}": leg.ankle[0]}
        toes[side] = leg.toe[0]
    joints = {name: joints[name] for name in meshes.SEGMENTS}
    n = len(joints)
    return meshes.Figure(
        np.array(list(joints.values())), np.eye(n), np.zeros((0, 3), int), np.zeros((n, 3)), joints, toes
    )


@pytest.mark.parametrize("seed", range(6))
def test_the_limbs_of_a_figure_point_as_those_of_the_skeleton(seed):
    rng = np.random.default_rng(seed)
    person = meshes.somebody(rng, np.zeros(2))
    still = replace(person.motion, places=np.zeros((2, 2)), headings=np.zeros(2), seated=np.zeros(2, bool), postures=())
    figure = at_rest(skeleton(replace(person, motion=still, carries=None, speech=np.empty((0, 2))), np.array([0.0])))
    bones = skeleton(person, np.array([5.0]))
    places = dict(zip(meshes.SEGMENTS, meshes.posed(figure, bones, 0), strict=True))
    for side, arm, leg in zip(SIDES, bones.arms, bones.legs, strict=True):
        limbs = (("upperarm", "lowerarm", arm.elbow - arm.shoulder), ("lowerarm", "hand", arm.wrist - arm.elbow))
        limbs += (("thigh", "shank", leg.knee - leg.hip), ("shank", "foot", leg.ankle - leg.knee))
        for begin, end, way in limbs:
            mine = places[f"{end}.{side}"] - places[f"{begin}.{side}"]
            cosine = mine @ way[0] / np.linalg.norm(mine) / np.linalg.norm(way[0])
            assert cosine == pytest.approx(1, abs=1e-6)


def test_a_figure_is_drawn_where_the_lens_shows_it_and_hidden_by_what_is_nearer():
    size = 200, 160
    view = View(
        KannalaBrandt(90, 90, 99.5, 79.5, 0, 0, 0, 0), camera_pose([0, 0, 3], [90, 0, 0]), size, np.deg2rad(88), 1
    )
    square = np.array([[0.4, 0.2, 1.0], [0.8, 0.2, 1.0], [0.8, 0.6, 1.0], [0.4, 0.6, 1.0]])
    mesh = square, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([1.0, 0.5, 0.0], (4, 1))
    painter = meshes.Painter(render.open_context())
    colour, share, owner, reached = painter.draw([mesh], view, np.full(size[::-1], np.inf))
    column, row = np.rint(view.project(square.mean(0)[None])[0]).astype(int)
    assert owner[row, column] == 1
    assert share[row, column] == 1
    assert reached[row, column] == pytest.approx(np.linalg.norm(square.mean(0) - view.origin), abs=0.02)
    np.testing.assert_allclose(colour[row, column], [1, 0.5, 0], atol=0.01)
    corners = view.project(square)
    v, u = np.nonzero(owner)
    np.testing.assert_allclose([u.min(), v.min(), u.max(), v.max()], [*corners.min(0), *corners.max(0)], atol=1.5)
    assert not painter.draw([mesh], view, np.full(size[::-1], 1.5))[2].any()
