"""People walk without sliding, keep to their path, and keep together."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.scene import people, scenario
from avcli.scene.motion import Motion
from avcli.scene.postures import POSTURES

T = np.linspace(-1, 12, 1301)


def straight(speed, length=3.0):
    return Motion(
        np.array([0.0, length / speed]),
        np.array([[0.5, 2.0], [0.5 + length, 2.0]]),
        np.full(2, np.nan),
        np.zeros(2, bool),
    )


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 6.0))
def test_a_foot_on_the_floor_does_not_slide(speed):
    motion = straight(speed)
    t = np.linspace(0, 3.0 / speed, 2000)
    sole, _, swing, _ = motion.feet(t, 0.08)
    standing = (swing[1:] == 0) & (swing[:-1] == 0)
    moved = np.linalg.norm(np.diff(sole, axis=0), axis=-1)
    landed = np.abs(np.diff((swing > 0).astype(int), axis=0)) == 0
    assert moved[standing & landed].max() < 1e-9
    assert (standing.any(1)).mean() > 0.95, "one foot carries"
    assert sole[..., 2].min() >= 0
    # No foot jumps: it moves at most at about twice the body's speed times the share of its swing.
    assert moved.max() < 6 * speed * (t[1] - t[0]) + 1e-6


def test_feet_begin_and_end_side_by_side():
    motion = straight(1.0)
    sole, _, swing, _ = motion.feet(np.array([-0.5, 0.0, 3.0, 4.0]), 0.08)
    np.testing.assert_allclose(sole[:, :, 0], [[0.5] * 2, [0.5] * 2, [3.5] * 2, [3.5] * 2], atol=1e-9)
    assert (swing == 0).all()


def test_position_is_straight_and_at_constant_speed():
    motion = straight(1.25)
    np.testing.assert_allclose(motion.position([0.8])[0], [1.5, 2.0])
    np.testing.assert_allclose(motion.speed(np.array([-1.0, 1.0, 9.0])), [0, 1.25, 0])


def test_a_corner_is_turned_smoothly_the_short_way():
    motion = Motion(
        np.array([0.0, 2.0, 4.0]), np.array([[3.0, 2.0], [1.0, 2.0], [1.0, 0.5]]), np.full(3, np.nan), np.zeros(3, bool)
    )
    heading = motion.heading(T)
    assert np.abs(np.diff(heading)).max() < np.deg2rad(5)
    assert np.ptp(heading) == pytest.approx(np.pi / 2)
    assert np.cos(heading[0]) == pytest.approx(-1)


def of(person):
    return scenario.parse({"people": [person], "duration_s": 12.0})


@pytest.mark.parametrize("look", list(people.LOOKS))
@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0])
def test_bodies_hold_together(look, speed):
    scene = of(
        {
            "look": look,
            "waypoints": [{"position_m": [0.4, 2.0]}, {"position_m": [4.2, 2.0], "speed_m_s": speed}],
            "speech_s": True,
        }
    )
    bodies = people.pose(scene.people, np.arange(0, 4.0 / speed, 0.05))
    height = scene.people[0].height
    for array in (bodies.a, bodies.b, bodies.front, bodies.flat_axis, bodies.keypoints, bodies.balls):
        assert np.isfinite(array).all()
    np.testing.assert_allclose(np.linalg.norm(bodies.flat_axis, axis=-1), 1, atol=1e-9)
    low = np.minimum(bodies.a[..., 2] - bodies.ra, bodies.b[..., 2] - bodies.rb).min()
    high = np.maximum(bodies.a[..., 2] + bodies.ra, bodies.b[..., 2] + bodies.rb).max()
    assert low > -0.03
    assert height - 0.13 < high < height + 0.12
    # Nobody falls apart or jumps: every cone stays near the person and moves steadily.
    place = scene.people[0].motion.position(bodies.times)
    assert np.linalg.norm(bodies.a[..., :2] - place[:, None], axis=-1).max() < 0.5 * height
    k = {name: bodies.keypoints[:, 0, i] for i, name in enumerate(people.KEYPOINTS)}
    for side in ("left", "right"):
        for one, other, share in (
            ("hip", "knee", 0.245),
            ("knee", "ankle", 0.246),
            ("shoulder", "elbow", 0.172),
            ("elbow", "wrist", 0.150),
        ):
            length = np.linalg.norm(k[f"{side}_{one}"] - k[f"{side}_{other}"], axis=-1)
            np.testing.assert_allclose(length, share * height, rtol=1e-6)
    steps = np.linalg.norm(np.diff(bodies.a, axis=0), axis=-1).max() / 0.05
    assert steps < 4.5 * speed + 4.0


def test_left_is_left_and_the_mouth_is_in_front():
    scene = of({"waypoints": [{"position_m": [2.0, 2.0], "heading_deg": 90}]})
    bodies = people.pose(scene.people, np.array([1.0]))
    k = dict(zip(people.KEYPOINTS, bodies.keypoints[0, 0], strict=True))
    for joint in ("shoulder", "hip", "knee", "ankle", "eye", "ear", "elbow", "wrist"):
        assert k[f"left_{joint}"][0] < k[f"right_{joint}"][0], joint
    mouth = bodies.mouths[0, 0]
    assert 0.08 < mouth[1] - 2.0 < 0.22
    assert 0.83 < mouth[2] / 1.68 < 0.92


def test_sitting_down_and_getting_up():
    person = {
        "look": "blue",
        "waypoints": [
            {"position_m": [1.0, 2.0]},
            {"position_m": [2.0, 2.0], "pose": "sit", "stay_s": 4.0, "heading_deg": 90},
            {"position_m": [3.0, 2.0]},
        ],
    }
    scene = of(person)
    t = np.array([0.5, 3.0, 4.0, 5.5])
    np.testing.assert_allclose(scene.people[0].motion.sitting(t), [0, 1, 1, 0], atol=1e-9)
    bodies = people.pose(scene.people, t)
    k = dict(zip(people.KEYPOINTS, bodies.keypoints[:, 0].transpose(1, 0, 2), strict=True))
    hips, knees = k["left_hip"][:, 2], k["left_knee"][:, 2]
    assert hips[0] > 0.8
    assert 0.45 < hips[1] < 0.62
    assert abs(hips[1] - knees[1]) < 0.15
    assert hips[3] > 0.8


def test_hands_move_only_while_speaking():
    person = {"waypoints": [{"position_m": [2.0, 2.0]}], "speech_s": [[3.0, 8.0]]}
    bodies = people.pose(of(person).people, np.arange(0, 12, 0.1))
    wrist = bodies.keypoints[:, 0, people.KEYPOINTS.index("right_wrist")]
    rise = wrist[:, 2] - wrist[0, 2]
    assert np.abs(rise[:27]).max() < 0.03
    assert rise[45:75].max() > 0.2
    still = people.pose(of({**person, "gestures": False}).people, np.arange(0, 12, 0.1))
    assert np.ptp(still.keypoints[:, 0, people.KEYPOINTS.index("right_wrist"), 2]) < 0.05


def test_turns_are_half_open_but_for_the_last():
    person = of({"waypoints": [{"position_m": [2.0, 2.0]}], "speech_s": [[0, 1], [2, 12]]}).people[0]
    said = people.speaking(person, [0.0, 0.9, 1.0, 2.0, 11.9, 12.0], 12.0)
    assert said.tolist() == [True, True, False, True, True, True]


def test_nobody_is_a_scene_too():
    bodies = people.pose([], np.arange(3.0))
    assert bodies.a.shape == (3, 0, 3)
    assert bodies.keypoints.shape == (3, 0, 17, 3)


def joints(t=1.0, **person):
    """The joints of one person who stays at (2, 2) and faces +y, by name: (3,) m."""
    point = {"position_m": [2.0, 2.0], "heading_deg": 90, "stay_s": 9.0, "pose": person.pop("pose", "stand")}
    scene = of({"look": "blue", "waypoints": [point], **person})
    bodies = people.pose(scene.people, np.array([t]))
    for array in (bodies.a, bodies.b, bodies.front, bodies.flat_axis, bodies.keypoints, bodies.balls):
        assert np.isfinite(array).all()
    return dict(zip(people.KEYPOINTS, bodies.keypoints[0, 0], strict=True))


@pytest.mark.parametrize("pose", list(POSTURES))
def test_in_every_posture_limbs_keep_their_length_and_left_is_left(pose):
    k = joints(pose=pose)
    for one, other, share in (("hip", "knee", 0.245), ("knee", "ankle", 0.246), ("shoulder", "elbow", 0.172)):
        for side in ("left", "right"):
            length = np.linalg.norm(k[f"{side}_{one}"] - k[f"{side}_{other}"])
            assert length == pytest.approx(share * 1.75, rel=1e-6)
    for joint in ("shoulder", "hip", "eye", "ear"):
        assert k[f"left_{joint}"][0] < k[f"right_{joint}"][0], joint
    hips, nose = k["left_hip"][2], k["nose"][2]
    if POSTURES[pose].seated:
        assert 0.45 < hips < 0.6
        assert 0.85 < nose < 1.35
    elif pose == "lie":
        assert max(place[2] for place in k.values()) < 0.35
        assert k["nose"][1] < 1.5 < k["left_hip"][1] < k["left_ankle"][1]
    else:
        assert hips < {"crouch": 0.45, "bend": 0.85}.get(pose, 0.95)
        assert nose < {"crouch": 1.1, "bend": 1.1}.get(pose, 1.7)


def test_hands_are_where_the_posture_needs_them():
    for pose in ("table", "type", "write", "lean"):
        for side in ("left", "right"):
            wrist = joints(pose=pose)[f"{side}_wrist"]
            assert 0.72 < wrist[2] < 0.86, pose
            assert 0.25 < wrist[1] - 2.0 < 0.6, pose
    box, none = joints(carries="box"), joints()
    assert box["left_wrist"][2] > none["left_wrist"][2] + 0.1
    assert joints(pose="raise")["right_wrist"][2] > 1.7


def test_who_rolls_sits_and_does_not_step():
    way = [{"position_m": [1.0, 2.0]}, {"position_m": [3.0, 2.0]}]
    scene = of({"look": "blue", "wheelchair": True, "waypoints": way})
    bodies = people.pose(scene.people, np.linspace(0.2, 1.8, 9))
    k = dict(zip(people.KEYPOINTS, bodies.keypoints[:, 0].transpose(1, 0, 2), strict=True))
    assert np.ptp(k["left_hip"][:, 2]) < 1e-9
    ahead = k["left_ankle"][:, 0] - k["left_hip"][:, 0]
    assert np.ptp(ahead) < 0.02
    assert (ahead > 0.2).all()


@pytest.mark.parametrize("height", [0.95, 1.2, 1.49, 1.5, 1.9])
def test_children_have_larger_heads_and_about_their_stated_height(height):
    scene = of({"look": "blue", "height_m": height, "waypoints": [{"position_m": [2.0, 2.0]}]})
    bodies = people.pose(scene.people, np.array([1.0]))
    top = np.maximum(bodies.a[..., 2] + bodies.ra, bodies.b[..., 2] + bodies.rb).max()
    assert top == pytest.approx(height, rel=0.05)
    ears = np.linalg.norm(bodies.keypoints[0, 0, 3] - bodies.keypoints[0, 0, 4]) / height
    grown = 0.16 / 1.75
    assert ears == pytest.approx(grown * (1 + 0.7 * max(1.5 - height, 0)), rel=1e-6)


def test_heads_of_a_group_turn_to_who_speaks():
    """The listener at the origin looks along +x; who speaks stands at 60 degrees to the left, the next in the back."""
    places = {"listener": [2.0, 2.0], "left": [2.5, 2.0 + 0.5 * 3**0.5], "back": [1.0, 2.0]}
    turns = {"left": [[1.0, 3.0]], "back": [[5.0, 7.0]]}
    group = [
        {
            "waypoints": [{"position_m": place, "heading_deg": 0, "t_s": 0, "stay_s": 10}],
            "group": "all",
            "speech_s": turns.get(name, []),
        }
        for name, place in places.items()
    ]

    def looks_deg(group):
        parsed = scenario.parse({"people": group, "duration_s": 10}, "group")
        bodies = people.pose(parsed.people, np.array([0.0, 2.0, 4.0, 6.0]))
        nose, ears = bodies.keypoints[:, 0, 0], bodies.keypoints[:, 0, 3:5].mean(1)
        return np.rad2deg(np.arctan2(*(nose - ears).T[1::-1]))

    np.testing.assert_allclose(looks_deg(group), [0, 60, 0, 0], atol=1)
    strangers = [{key: value for key, value in person.items() if key != "group"} for person in group]
    np.testing.assert_allclose(looks_deg(strangers), 0, atol=1)
