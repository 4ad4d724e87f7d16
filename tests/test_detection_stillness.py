"""Who keeps still in a film becomes less probable, who sways does not, and what is not known changes nothing."""

import numpy as np
import pytest
from test_detection_detector import FakeNetwork, config

from avcli.detection.detector import Detector
from avcli.detection.network import Boxes
from avcli.detection.settings import Settings
from avcli.detection.stillness import COME, DOUBT, LEAST, Stillness, after

BOX = np.array([[120.0, 60.0, 160.0, 110.0]])
SECONDS = np.arange(0, 10, 0.2)


@pytest.fixture
def room():
    rng = np.random.default_rng(3)
    return np.kron(rng.integers(40, 180, (36, 64, 3)), np.ones((5, 5, 1)))


def moved(part, by):
    """A part moved by a fraction of a pixel."""
    whole = int(np.floor(by))
    return (1 - by + whole) * np.roll(part, whole, axis=1) + (by - whole) * np.roll(part, whole + 1, axis=1)


def filmed(room, *, sway=0.0, noise=2.0, light=0.0, passer=(), seed=0):
    """Pictures of a room at `SECONDS`; what is in the box moves by `sway` px, somebody passes over it at some times."""
    rng = np.random.default_rng(seed)
    for time in SECONDS:
        picture = room.copy()
        picture[60:110, 120:160] = moved(picture[60:110, 120:160], sway * np.sin(2 * time))
        if any(abs(time - one) < 0.5 for one in passer):
            picture[50:120, 110:150] = (20, 30, 200)
        picture += noise * rng.standard_normal(picture.shape) + light * time
        yield time, np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def told(pictures):
    stillness, evidence = Stillness(), []
    for time, picture in pictures:
        stillness.see(picture, time, BOX)
        evidence.append(stillness.evidence(BOX)[0])
    return np.array(evidence)


@pytest.mark.parametrize("noise", [0.3, 2.0, 4.0])
def test_a_thing_is_doubted_the_more_the_longer_it_is_watched(room, noise):
    evidence = told(filmed(room, noise=noise))
    assert evidence[0] == 0
    assert 0 > evidence[SECONDS < 0.7].min() > evidence[SECONDS < 1.3].min() > evidence.min()
    assert evidence[SECONDS > 3].max() < -4
    assert evidence.min() == DOUBT


def test_a_camera_that_has_stopped_tells_nothing(room):
    assert (told(filmed(room, noise=0.0)) == 0).all()


@pytest.mark.parametrize("sway", [0.15, 0.5, 3.0, 20.0])
def test_somebody_who_sways_by_a_fraction_of_a_pixel_or_more_is_not_doubted(room, sway):
    assert told(filmed(room, sway=sway)).mean() > -0.2


def test_where_a_sway_could_not_be_seen_its_absence_tells_little(room):
    room[60:110, 120:160] = 60 + 0.02 * (room[60:110, 120:160] - 110)
    assert told(filmed(room)).min() > LEAST
    assert told(filmed(room, noise=0.3)).min() < 2 * LEAST  # a better camera would show it


def test_somebody_else_at_the_same_place_is_not_the_same_thing(room):
    rng = np.random.default_rng(7)
    others = [np.kron(rng.integers(40, 180, (10, 8, 3)), np.ones((5, 5, 1))) for _ in range(10)]
    pictures = []
    for time, picture in filmed(room):
        picture[60:110, 120:160] = others[int(time)]
        pictures.append((time, picture))
    assert told(pictures)[SECONDS == 5.0] > DOUBT / 2


def test_moving_alone_is_no_evidence_for_a_person_but_for_who_was_found_before(room):
    assert told(filmed(room, sway=0.5)).max() == 0
    stillness, moves = Stillness(), []
    for time, picture in filmed(room, sway=0.5):
        stillness.see(picture, time, BOX)
        moves.append(stillness.told(BOX, np.ones(1, bool))[0, 1])
    assert moves[0] == 0
    assert np.median(moves) == COME
    assert (stillness.told(BOX + 50, np.zeros(1, bool)) == 0).all()  # it has not come


def motion(pictures, rows=(60, 110), columns=(120, 160)):
    stillness, nats = Stillness(), []
    y, x = (grid.ravel() for grid in np.mgrid[rows[0] : rows[1] : 2, columns[0] : columns[1] : 2])
    for time, picture in pictures:
        stillness.see(picture, time, BOX)
        nats.append(stillness.motion(BOX[0], x, y))
    return np.array(nats)


@pytest.mark.parametrize("sway", [0.5, 3.0])
def test_a_body_that_moves_before_the_empty_room_is_a_person(room, sway):
    nats = motion(filmed(room, sway=sway))
    assert nats[0] == 0
    assert np.median(nats[SECONDS > 2]) > 2


def test_a_body_that_keeps_still_tells_nothing_by_its_motion(room):
    assert motion(filmed(room)).max() == 0
    assert motion(filmed(room, noise=0.0)).max() == 0


def test_what_moves_in_the_box_beside_a_body_is_not_the_body(room):
    def pictures():
        for time, picture in filmed(room):
            picture[60:110, 140:160] = moved(picture[60:110, 140:160].astype(float), 3 * np.sin(2 * time))
            yield time, picture

    assert motion(pictures(), columns=(142, 158)).max() > 2
    assert motion(pictures(), columns=(120, 136)).max() == 0


def test_a_thing_that_somebody_hid_is_known_again(room):
    evidence = told(filmed(room, passer=(6.0,)))
    hidden, later = abs(SECONDS - 6) < 0.15, SECONDS > 7.3
    assert evidence[hidden].min() >= 0
    assert evidence[later].max() < -1


def arrived(room, *, bump=np.inf, sway=0.0):
    """Pictures of a room in which something that sways comes into the box after 5 s; the camera is bumped later."""
    rng = np.random.default_rng(11)
    other = np.kron(rng.integers(40, 180, (10, 8, 3)), np.ones((5, 5, 1)))
    for time in np.arange(0, 20, 0.2):
        picture = room.copy()
        if time >= 5:
            picture[60:110, 120:160] = moved(other, sway * np.sin(2 * time))
        picture = np.roll(picture, 3, axis=1) if time >= bump else picture
        yield time, np.clip(np.rint(picture + 2 * rng.standard_normal(picture.shape)), 0, 255).astype(np.uint8)


def test_who_came_after_the_film_began_may_keep_still(room):
    evidence = told(arrived(room))
    assert evidence[20:25].max() == DOUBT  # what is there from the beginning
    assert evidence[26:].min() == 0
    assert evidence[40:].max() == 0


def test_who_came_and_moves_is_a_person_more_probably(room):
    evidence = told(arrived(room, sway=1.0))
    assert evidence[:25].max() == 0
    assert np.median(evidence[30:]) == COME


def test_a_camera_that_was_bumped_does_not_make_people_of_things(room):
    stillness = Stillness()
    for time, picture in arrived(room, bump=8.0):
        stillness.see(picture, time, BOX)
    thing = np.array([[220.0, 60.0, 260.0, 110.0]])
    assert stillness.evidence(thing)[0] == DOUBT


def test_light_that_changes_everywhere_makes_no_difference(room):
    assert told(filmed(room, light=2.0))[-1] < -4


def test_a_camera_that_moves_or_pictures_of_several_rooms_tell_nothing(room):
    swung = [(t, np.roll(picture, round(20 * np.sin(t)), axis=1)) for t, picture in filmed(room)]
    rng = np.random.default_rng(5)
    rooms = [(t, rng.permutation(picture.reshape(-1, 5, 320, 3)).reshape(picture.shape)) for t, picture in filmed(room)]
    assert told(swung).min() == told(rooms).min() == 0


def test_pictures_of_another_time_or_size_begin_anew(room):
    stillness = Stillness()
    for time, picture in filmed(room):
        stillness.see(picture, time, BOX)
    assert stillness.evidence(BOX)[0] < -4
    stillness.see(picture, 2.0, BOX)
    assert stillness.evidence(BOX)[0] == 0
    stillness.see(picture[:100, :100], 3.0, BOX)
    assert stillness.evidence(BOX)[0] == 0


def test_pictures_that_are_far_apart_tell_nothing(room):
    stillness = Stillness()
    for time, picture in filmed(room):
        stillness.see(picture, 600 * time, BOX)
    assert stillness.evidence(BOX)[0] == 0


def test_boxes_without_area_or_outside_tell_nothing(room):
    stillness = Stillness()
    for time, picture in filmed(room):
        stillness.see(picture, time, BOX)
    odd = np.array([[10, 10, 10, 10], [-50, -50, -10, -10], [900, 900, 950, 950], [5, 5, 7, 200.0]])
    assert (stillness.evidence(odd) == 0).all()
    assert stillness.evidence(np.empty((0, 4))).shape == (0,)


def test_scores_after_evidence():
    assert after(np.array([0.9, 1.0, 0.0, 0.5]), np.zeros(4)).tolist() == [0.9, 1.0, 0.0, 0.5]
    assert after(np.array([0.9]), np.array([-np.log(9)])) == pytest.approx(0.5)
    assert 0 < after(np.array([1.0]), np.array([DOUBT]))[0] < 0.5
    assert after(np.array([0.995]), np.array([-1e-3])) < 0.995
    assert after(np.array([0.25, 0.999]), np.log([3.0, 3.0])) == pytest.approx([0.5, 0.999])


class SureNetwork(FakeNetwork):
    """Finds the box, with a least score."""

    confidence = 0.5


def people(network, timed=True, **settings):
    """What a detector finds in a room in which nothing but noise ever changes."""
    detector = Detector(config(), settings=Settings(**settings))
    detector.network = network
    rng = np.random.default_rng(1)
    room = np.kron(rng.integers(40, 180, (27, 48, 3)), np.ones((10, 10, 1)))
    pictures = [(room + rng.standard_normal(room.shape)).astype(np.uint8) for _ in range(60)]
    found = [detector.look(picture, None, 0.1 * k if timed else None) for k, picture in enumerate(pictures)]
    return found, detector.tally


def test_the_detector_lowers_scores_then_holds_back():
    found, tally = people(SureNetwork([200, 80, 250, 160]))
    scores = [one[0].score if one else 0.0 for one in found]
    assert scores[0] == 0.9
    assert scores[-1] == 0.0
    assert len(set(scores)) > 2  # unchanged pictures tell too
    assert tally.held_back > 0


class FaintNetwork(FakeNetwork):
    """Finds the box and one that lies within, with low scores."""

    def detect(self, picture, regions):
        seen = super().detect(picture, regions)
        part = seen.boxes * 0.5 + seen.boxes[:, [0, 1, 0, 1]] * 0.5
        return Boxes(np.concatenate([seen.boxes, part]), np.array([0.25, 0.24]))


@pytest.mark.parametrize(("settings", "people"), [({}, 1), ({"confidence": 0.5}, 0), ({"stillness": False}, 0)])
def test_who_came_and_moves_is_found_with_a_low_score_and_is_one_person(settings, people):
    detector = Detector(config(), settings=Settings(refresh=1, **settings))
    detector.network = FaintNetwork([200, 80, 240, 130])
    rng = np.random.default_rng(1)
    room = np.kron(rng.integers(40, 180, (27, 48, 3)), np.ones((10, 10, 1)))
    body = np.kron(rng.integers(40, 180, (10, 8, 3)), np.ones((5, 5, 1)))
    counts = []
    for k in range(50):
        picture = room.copy()
        if k >= 25:
            picture[80:130, 200:240] = moved(body, 3 * np.sin(0.4 * k))
        picture = np.clip(picture + rng.standard_normal(room.shape), 0, 255).astype(np.uint8)
        found = detector.look(picture, None, 0.2 * k)
        counts.append(len(found))
    assert max(counts[:25]) == 0
    assert np.median(counts[30:]) == people
    if people:
        assert found[0].score == pytest.approx(0.6, abs=0.01)
        assert detector.tally.came > 10


def test_the_detector_doubts_nobody_without_times_or_when_told():
    for found, tally in (
        people(SureNetwork([200, 80, 250, 160]), timed=False),
        people(SureNetwork([200, 80, 250, 160]), stillness=False),
    ):
        assert [one[0].score for one in found] == [0.9] * 60
        assert tally.held_back == 0
