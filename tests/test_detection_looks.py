"""What people wear: known colours in known light, and what the vector must not depend on."""

import json
import sys

import numpy as np
import pytest
from conftest import ROOT
from detection_people import ceiling_view
from hypothesis import given
from hypothesis import strategies as st

from avcli.detection import looks
from avcli.detection.body import Person, Surface
from avcli.detection.looks import COMPONENTS, LAW, Looks, feature
from avcli.formats.features import known

sys.path.insert(0, str(ROOT / "tests" / "bench"))
import fit_looks
import looks_real

VIEW = ceiling_view(4, stride=4)
ROOM = 100, 120, 90
RED, BLUE, BROWN = (160, 60, 50), (40, 50, 110), (70, 50, 30)
TALL = 1.75


def person(at=(100, 100), height=TALL, heights=(0.1, 1.75)):
    """Somebody who is seen from feet to head in 60 rows of 20 columns, `at` is the top left pixel (x, y)."""
    rows, columns = np.mgrid[at[1] : at[1] + 60, at[0] : at[0] + 20].reshape(2, -1)
    seen = Surface(rows, columns, np.linspace(*heights, 60).repeat(20), np.full(1200, 1e-3))
    box = np.array([at[0], at[1], at[0] + 20, at[1] + 60], float)
    return Person(np.array([1.0, 1.0, 0.9]), np.eye(3), 0.9, box, height, "depth", 1.0, seen)


def painted(*people, room=ROOM):
    """A picture of a room of one colour with people, each with the colours of lower body, upper body and head."""
    picture = np.full((270, 480, 3), room, np.uint8)
    for one, (lower, upper, head) in people:
        share = one.surface.heights / TALL
        colours = np.where(share[:, None] < 0.5, lower, np.where(share[:, None] < 0.85, upper, head))
        picture[one.surface.rows, one.surface.columns] = colours
    return picture


def described(*pictures_and_people, describer=None):
    describer = describer or Looks(VIEW)
    return [describer.describe(picture, people) for picture, people in pictures_and_people][-1]


ANNA = person()
CLOTHES = BLUE, RED, BROWN
PICTURE = painted((ANNA, CLOTHES))


def test_a_person_of_three_colours_before_a_room_of_one():
    vector, sd = described((PICTURE, [ANNA]))[0]
    expected = []
    for colour in (BROWN, RED, BLUE):
        red, green, blue = np.log(0.45 * np.array(colour) / ROOM + 0.05)
        expected += [(red + green + blue) / 3, red - blue, green - (red + blue) / 2]
    assert vector == pytest.approx([expected[0], *expected[3:]])
    assert sd.tolist() == LAW.floor.tolist()


@pytest.mark.parametrize("gain", [(0.5, 0.5, 0.5), (1.5, 1.5, 1.5), (1.2, 1.0, 0.8), (0.6, 0.7, 0.9)])
def test_light_and_exposure_cancel(gain):
    other = np.rint(PICTURE * np.array(gain)).astype(np.uint8)
    (one, sd), (two, _) = described((PICTURE, [ANNA]))[0], described((other, [ANNA]))[0]
    assert (np.abs(one - two) < 0.5 * sd).all()
    later = described((PICTURE, [ANNA]), (other, [ANNA]))[0, 0]
    assert (np.abs(one - later) < 0.5 * sd).all()


def test_it_does_not_matter_which_part_of_the_room_people_hide():
    """A room of two colours: whoever comes in hides one of them."""
    crowd = [person((x, y)) for x in range(250, 470, 22) for y in (5, 75, 145, 205)]
    empty = painted(room=ROOM)
    empty[:, 240:] = 30, 40, 60
    first, second = empty.copy(), empty.copy()
    for picture in (first, second):
        picture[ANNA.surface.rows, ANNA.surface.columns] = RED
    for one in crowd:
        second[one.surface.rows, one.surface.columns] = RED
    alone = described((first, [ANNA]))[0, 0]
    assert described((first, [ANNA]), (second, [ANNA, *crowd]))[0, 0] == pytest.approx(alone)


def test_a_part_that_is_not_seen_is_not_told():
    legs = person(heights=(0.1, 0.8))
    vector, sd = described((painted((legs, CLOTHES)), [legs]))[0]
    seen = [name.startswith("lower") for name in COMPONENTS]
    assert (~np.isnan(vector)).tolist() == (~np.isnan(sd)).tolist() == seen


def test_a_part_that_is_clipped_is_not_told():
    vector = described((painted((ANNA, (BLUE, (255, 255, 255), BROWN))), [ANNA]))[0, 0]
    assert [name for name, value in zip(COMPONENTS, vector, strict=True) if np.isnan(value)] == list(COMPONENTS[1:4])


def test_stripes_are_less_sure_than_one_colour():
    striped = PICTURE.copy()
    striped[101::2, 100:120] = 20, 25, 20
    plain, other = described((PICTURE, [ANNA]))[0, 1], described((striped, [ANNA]))[0, 1]
    assert (other >= plain).all()
    assert other[1] > 1.5 * plain[1]


@pytest.mark.parametrize("noise", [0, 2])
def test_a_picture_without_colour_tells_nothing(noise):
    """It may be one of heat, or of infrared light, in which clothes look otherwise than by day."""
    grey = np.repeat(PICTURE.mean(axis=2, keepdims=True), 3, axis=2)
    grey = np.clip(grey + np.random.default_rng(1).normal(0, noise, grey.shape), 0, 255).astype(np.uint8)
    assert np.isnan(described((grey, [ANNA]))).all()
    coloured = painted((ANNA, CLOTHES), room=(110, 110, 110))
    assert not np.isnan(described((coloured, [ANNA]))).any()


@pytest.mark.parametrize("value", [0, 5, 255])
def test_a_picture_that_shows_no_room_tells_nothing(value):
    assert np.isnan(described((np.full_like(PICTURE, value), [ANNA]))).all()
    after = described((np.full_like(PICTURE, value), [ANNA]), (PICTURE, [ANNA]))
    assert np.array_equal(after, described((PICTURE, [ANNA])))


def test_without_depth_a_standing_body_is_looked_for_in_the_box():
    place = np.array([1.2, 2.3, 0.9])
    body = looks.standing(place[:2], TALL, VIEW)
    picture = np.full((270, 480, 3), ROOM, np.uint8)
    y0, y1, x0, x1 = body.rows.min(), body.rows.max() + 1, body.columns.min(), body.columns.max() + 1
    picture[y0:y1, x0:x1] = RED
    ben = Person(place, np.eye(3), 0.9, np.array([x0, y0, x1, y1], float), TALL, "monocular")
    vector = described((picture, [ben]))[0, 0]
    assert vector[1:4] == pytest.approx(described((PICTURE, [ANNA]))[0, 0, 1:4])
    nearer = Person(np.array([1.5, 2.3, 0.9]), np.eye(3), 0.9, ben.bbox_px, TALL, "monocular")
    hidden, seen = described((picture, [ben, nearer]))
    assert np.isnan(hidden).all()
    assert not np.isnan(seen).all()


@given(st.permutations(range(4)), st.integers(0, 2**32 - 1))
def test_the_order_of_people_does_not_matter(order, seed):
    rng = np.random.default_rng(seed)
    people = [person((30 + 60 * k, 50)) for k in range(4)]
    picture = painted(*((one, rng.integers(0, 256, (3, 3))) for one in people))
    told = described((picture, people))
    assert np.array_equal(described((picture, [people[k] for k in order])), told[list(order)], equal_nan=True)
    assert (told[:, 1][~np.isnan(told[:, 1])] > 0).all()


def test_nobody_and_somebody_who_was_not_described():
    assert feature([]) == feature([ANNA]) == {}
    assert described((PICTURE, [])).shape == (0, 2, 7)


# --- the fitted numbers -----------------------------------------------------------------------------------------------


def test_the_kind_is_known_to_the_tracker():
    kind = known(looks.KIND)
    assert kind is not None
    assert kind.mean.shape == kind.between.shape == kind.within.shape == (len(COMPONENTS),)
    assert (kind.between > 0).all()


def test_the_fit_finds_what_descriptions_were_drawn_from():
    rng = np.random.default_rng(3)
    law = fit_looks.LooksLaw(np.array([0.3, 0.15, 0.05, 0.03, 0.15, 0.05, 0.03]), 0.6)
    own, spreads = rng.normal(0, 0.4, (200, 7)).repeat(4, axis=0), rng.uniform(0, 0.5, (800, 7))
    vectors = own + law.deviations(spreads) * rng.normal(size=(800, 7))
    rows = [(vectors[k], spreads[k], k // 4, k // 4) for k in range(800)]
    sights = fit_looks.rendered(rows)
    people = fit_looks.population([sights])
    assert people.between == pytest.approx(np.full(7, 0.16), rel=0.4)
    found = fit_looks.fit_law([sights], people)
    surer = fit_looks.LooksLaw(found.floor / fit_looks.DOUBT, found.slope / fit_looks.DOUBT)
    assert surer.slope == pytest.approx(law.slope, rel=0.3)
    assert fit_looks.judge(sights, surer, people)["cllr"] <= fit_looks.judge(sights, law, people)["cllr"] + 0.01
    figures = fit_looks.judge(sights, law, people)
    assert figures["squares"] == pytest.approx(1.0, abs=0.1)
    assert figures["wrong_20_to_1"] < 0.02
    assert figures["least_cllr"] <= figures["cllr"] < 0.4


def test_real_people_are_linked_where_only_one_link_is_possible():
    def frame(number, *corners):
        return number, None, np.array([[x, y, x + 20, y + 20] for x, y in corners], float).reshape(-1, 4)

    film = [
        frame(0, (100, 100), (400, 400)),
        frame(10, (410, 400), (110, 100)),
        frame(20, (120, 100)),
        frame(30, (130, 100), (160, 100)),
        frame(99, (130, 100)),
    ]
    numbers = looks_real.linked(film)
    assert [own.tolist() for own in numbers] == [[0, 1], [1, 0], [0], [0, 2], [3]]
    identity, frames = np.concatenate(numbers), np.array([0, 0, 10, 10, 20, 30, 30, 99])
    same, different = looks_real.pairs(identity, frames)
    assert {tuple(sorted(frames[pair])) for pair in same} == {(0, 20), (0, 30), (10, 30)}
    assert {tuple(sorted(identity[pair])) for pair in different} == {(0, 1), (0, 2)}


def test_the_files_say_what_their_numbers_were_fitted_on():
    law = json.loads((ROOT / "avcli" / "detection" / "looks.json").read_text())
    kind = json.loads((ROOT / "avcli" / "formats" / "features" / "clothes.json").read_text())
    assert law["fitted_on"] == kind["fitted_on"]
    assert law["fitted_on"]["seed"] != law["fitted_on"]["other_seed"]
    assert tuple(kind["components"]) == COMPONENTS
