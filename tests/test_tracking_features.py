"""Looks and voice in the tracker: known answers, properties, and that a wrong vector decides nothing."""

import json
import math
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from conftest import schema
from hypothesis import given, settings
from hypothesis import strategies as st
from test_tracking_hypotheses import cluster
from test_tracking_hypotheses import people as standing

from avcli.formats.features import Feature, Population
from avcli.formats.records import Detections, as_record, encode
from avcli.tracking.features import FOREIGN, UU, XX, Features, U, X
from avcli.tracking.fusion import Fusion
from avcli.tracking.hypotheses import BESIDE, EXCHANGE, TELL
from avcli.tracking.recognition import Gallery, Left, returned
from avcli.tracking.smoothing import Node

PLAIN = Population(np.zeros(2), np.ones(2), np.full(2, 0.25), correlation_s=1.0, correlated=0.0)
LASTING = PLAIN._replace(correlated=1.0)


def kinds(population=PLAIN):
    return Features({"clothes": population}.get)


def clothes(vectors, sd=0.5):
    vectors = np.array(vectors, float)
    return {"looks": Feature("clothes", vectors, np.full(vectors.shape, sd))}


def people(count, apart=0.1):
    return standing([[apart * k, 0, 0, 0] for k in range(count)], range(count))


def seen(features, crowd, vectors, time=0.0, sd=0.5):
    """Let row k of a crowd have been seen with vector k at a time; returns what was made of it."""
    evidence = features.weigh(
        crowd, [], time, np.zeros((len(vectors), 2)), np.ones((len(crowd), len(vectors))), clothes(vectors, sd)
    )
    rows = list(range(len(crowd)))
    crowd.traits = features.update(crowd.traits, evidence._replace(own=np.ones_like(evidence.own)), rows, rows)
    return evidence


def gauss(x, mean, variance):
    return math.exp(-((x - mean) ** 2) / variance / 2) / math.sqrt(2 * math.pi * variance)


def test_the_ratio_of_two_people_is_that_of_their_gaussians():
    features, crowd = kinds(), people(2)
    seen(features, crowd, [[1.0, 0.0], [-1.0, 0.0]])
    np.testing.assert_allclose(crowd.traits[:, X, 0], [0.8, -0.8])  # 1 / (1 + 0.25)
    np.testing.assert_allclose(crowd.traits[:, XX], 0.2)
    found = features.weigh(crowd, [], 0.0, np.zeros((1, 2)), np.ones((2, 1)), clothes([[0.9, 0.1]]))
    for row, centre in enumerate((0.8, -0.8)):
        own = gauss(0.9, centre, 0.45) * gauss(0.1, 0.0, 0.45) / gauss(0.9, 0.0, 1.25) / gauss(0.1, 0.0, 1.25)
        assert found.ratio[row, 0] == pytest.approx((1 - FOREIGN) * own + FOREIGN, rel=1e-3)


def test_people_are_as_far_apart_as_one_look_tells():
    features, crowd = kinds(), people(3)
    seen(features, crowd, np.zeros((3, 2)))
    crowd.traits = np.tile(features.prior, (3, 1, 1))
    crowd.traits[:2, XX] = 0.0  # the first two are known, of the third nothing is
    crowd.traits[:2, X] = [[1.0, 0.0], [-1.0, 0.0]]
    apart = features.apart(crowd.traits)
    np.testing.assert_allclose(apart, apart.T)
    np.testing.assert_allclose(np.diag(apart), 0, atol=1e-12)
    assert apart[0, 1] == pytest.approx(2.0**2 / 0.25)
    jeffreys = [(v / w + w / v - 2) / 2 + d * d * (1 / v + 1 / w) / 2 for v, w, d in ((0.25, 1.25, 1), (0.25, 1.25, 0))]
    assert apart[0, 2] == pytest.approx(sum(jeffreys))


def test_an_exchange_of_two_who_stand_together_stays_possible():
    features, crowd = kinds(), people(2, apart=0.1)
    seen(features, crowd, [[1.0, 0.0], [-1.0, 0.0]])
    alone = cluster({(0, 1): 1.0})
    more, new = alone.exchanged(crowd, features)
    assert more.hypotheses == [(0, 1), (2, 3)]
    assert more.shares == pytest.approx([1 - EXCHANGE, EXCHANGE])
    assert new.label == [0, 1]
    np.testing.assert_allclose(new.centres([0, 1])[:, 0], [0.1, 0.0])
    np.testing.assert_array_equal(new.traits, crowd.traits)
    again, nothing = more.exchanged(type(crowd).join([crowd, new]), features)
    assert nothing is None or again.shares[1] == pytest.approx(EXCHANGE)


def test_an_exchange_has_a_history_of_its_own():
    features, crowd = kinds(), people(2, apart=0.1)
    seen(features, crowd, [[1.0, 0.0], [-1.0, 0.0]])
    crowd.node = [Node(0.0), Node(0.0)]
    _, new = cluster({(0, 1): 1.0}).exchanged(crowd, features)
    assert len({id(node) for node in (*crowd.node, *new.node)}) == 4


@pytest.mark.parametrize(("apart", "own"), [(BESIDE + 0.01, 1.0), (0.1, 0.0)])
def test_who_stands_alone_or_looks_like_the_other_is_not_exchanged(apart, own):
    features, crowd = kinds(), people(2, apart)
    seen(features, crowd, [[own, 0.0], [-own, 0.0]])
    assert (features.apart(crowd.traits)[0, 1] < TELL) == (own == 0)
    assert cluster({(0, 1): 1.0}).exchanged(crowd, features)[1] is None


def test_who_was_never_seen_is_the_population():
    features, crowd = kinds(), people(3)
    found = features.weigh(crowd, [], 0.0, np.zeros((2, 2)), np.ones((3, 2)), clothes([[2.0, -1.0], [np.nan, np.nan]]))
    np.testing.assert_allclose(found.ratio, 1.0, rtol=1e-12)


def test_looks_whose_errors_last_count_as_one():
    features, crowd = kinds(LASTING), people(1)
    for _ in range(40):
        seen(features, crowd, [[1.0, -1.0]])  # at the same time
    once, fresh = kinds(LASTING), people(1)
    seen(once, fresh, [[1.0, -1.0]])
    np.testing.assert_allclose(crowd.traits[0, XX], fresh.traits[0, XX], rtol=0.02)
    for k in range(40):
        seen(features, crowd, [[1.0, -1.0]], time=100.0 + 10.0 * k)
    assert (crowd.traits[0, XX] < 0.07).all()  # some is left, since people change
    assert (crowd.traits[0, UU] <= 1 + 1e-9).all()


def test_a_vector_like_nobody_says_nothing():
    features, crowd = kinds(), people(2)
    seen(features, crowd, [[1.0, 0.0], [-1.0, 0.0]])
    found = features.weigh(crowd, [], 0.0, np.zeros((1, 2)), np.ones((2, 1)), clothes([[40.0, -30.0]]))
    np.testing.assert_allclose(found.ratio, 1.0, atol=1e-6)
    assert (found.own < 1e-6).all()


def test_beside_somebody_else_a_vector_says_less():
    features, crowd = kinds(), people(2, apart=0.0)
    seen(features, crowd, [[1.0, 0.0], [-1.0, 0.0]])
    here, gain, like_the_first = np.zeros((1, 2)), np.ones((2, 1)), clothes([[1.5, 0.0]])
    alone = features.weigh(crowd, [], 0.0, here, gain, like_the_first).ratio[:, 0]
    touching = features.weigh(crowd, [0, 1], 0.0, here, gain, like_the_first).ratio[:, 0]
    assert alone[0] > touching[0] > touching[1] > alone[1]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_merged_people_have_the_moments_of_the_mixture(seed):
    rng = np.random.default_rng(seed)
    crowd, share = people(3), rng.dirichlet(np.ones(3))
    crowd.traits = rng.standard_normal((3, 5, 4))
    crowd.traits[:, 2:] = np.abs(crowd.traits[:, 2:])
    before = crowd.traits.copy()
    crowd.merge([[1, 0, 2]], [share.tolist()])
    mean = np.einsum("k,kid->id", share, before[[1, 0, 2], :2])
    np.testing.assert_allclose(crowd.traits[1, :2], mean)
    second = np.einsum("k,kd->d", share, before[[1, 0, 2], XX] + before[[1, 0, 2], X] ** 2)
    np.testing.assert_allclose(crowd.traits[1, XX], second - mean[0] ** 2, atol=1e-12)
    second = np.einsum("k,kd->d", share, before[[1, 0, 2], UU] + before[[1, 0, 2], U] ** 2)
    np.testing.assert_allclose(crowd.traits[1, UU], second - mean[1] ** 2, atol=1e-12)


def test_the_ratio_of_one_person_to_two_is_the_integral():
    features, crowd = kinds(), people(2)
    seen(features, crowd, [[1.0, 0.2], [0.7, -0.5]])
    x = np.linspace(-9, 9, 20001)

    def density(mean, variance):
        return np.exp(-((x - mean) ** 2) / variance / 2) / np.sqrt(2 * np.pi * variance)

    ratio = 1.0
    for d in (0, 1):
        (a, p), (b, q) = ((crowd.traits[k, X, d], crowd.traits[k, XX, d]) for k in (0, 1))
        ratio *= np.trapezoid(density(a, p) * density(b, q) / density(0, 1), x)
    found = features.same(crowd.traits[0], crowd.traits[1:])
    assert math.exp(found[0]) == pytest.approx((1 - FOREIGN) * ratio + FOREIGN, rel=1e-6)


def test_noise_that_is_told_too_small_is_learnt_and_never_shrinks():
    from avcli.tracking.association import Group, Hypothesis

    for true, least, most in ((0.5, 1.0, 1.6), (1.5, 5.0, 13.0), (0.1, 1.0, 1.0)):
        rng, features, crowd = np.random.default_rng(0), kinds(), people(1)
        for k in range(300):
            vectors = [true * rng.standard_normal(2)]
            evidence = features.weigh(crowd, [], k / 10, np.zeros((1, 2)), np.ones((1, 1)), clothes(vectors))
            features.learn(crowd, evidence, [Group([0], [Hypothesis(0.0, ((0, 0),), 1)])])
            crowd.traits = features.update(crowd.traits, evidence, [0], [0])
        (kind,) = features.kinds.values()
        assert least <= kind.scale <= most


# --- people who come back ---------------------------------------------------------------------------------------------


def test_who_comes_back_is_recognised_and_a_stranger_is_not():
    features = kinds(PLAIN._replace(within=np.full(2, 0.01)))
    crowd = people(4)
    for _ in range(30):
        seen(features, crowd, [[2.0, 2.0], [-2.0, 1.0], [2.0, 1.9], [0.0, -2.0]], sd=0.1)
    anna, ben, again, stranger = crowd.traits
    left = [Left(10.0, np.array([1.0, 1.0]), anna), Left(12.0, np.array([3.0, 1.0]), ben)]
    here = np.array([2.0, 2.0])
    chances = returned(Left(21.0, here, again), 20.0, left, 20.0, features, 0.02)
    assert chances[0] > 0.9
    assert returned(Left(21.0, here, stranger), 20.0, left, 20.0, features, 0.02)[2] > 0.9
    assert returned(Left(21.0, here, again), 20.0, left, 20.0, features, 0.5)[0] < 0.8  # where people look alike
    far = np.array([90.0, 2.0])
    assert returned(Left(21.0, far, again), 20.0, left, 20.0, features, 0.02)[0] < 0.01  # nobody runs so fast


def remembered(features, vectors, absent=20.0):
    """A gallery of people who came one after another, each long ago, and what is known of each."""
    crowd, gallery = people(len(vectors)), Gallery()
    for k in range(30):
        seen(features, crowd, vectors, time=10.0 * k, sd=0.1)
    known = [Left(300.0 + absent * k, np.ones(2), traits) for k, traits in enumerate(crowd.traits)]
    return gallery, known


def visited(gallery, features, label, person):
    """Let somebody come, be watched, and leave; returns the label of before, if any."""
    gallery.come(label, person.time - 6.0)
    found = gallery.recognise({label: person}, person.time - 0.9, 20.0, features)
    gallery.leave(found.get(label, label), person, features)
    return found.get(label)


def test_a_gallery_gives_a_label_back_once_it_has_seen_that_people_differ():
    features = kinds()
    gallery, (anna, ben, again) = remembered(features, [[3.0, -3.0], [-3.0, 0.0], [3.0, -3.0]])
    assert visited(gallery, features, 7, anna) is None
    assert visited(gallery, features, 8, ben) is None
    assert visited(gallery, features, 9, again) == 7
    assert sorted(gallery.left) == [7, 8]
    assert not gallery.fresh


def test_where_nobody_was_seen_to_differ_nobody_is_recognised():
    features = kinds()
    gallery, everybody = remembered(features, [[3.0, -3.0]] * 6)
    assert {visited(gallery, features, k, one) for k, one in enumerate(everybody)} == {None}


def test_who_was_taken_for_a_stranger_is_known_later():
    features = kinds()
    gallery, everybody = remembered(features, [[3.0, -3.0], [3.0, -3.0], [-3.0, 0.0], [3.0, -3.0]])
    assert [visited(gallery, features, k, one) for k, one in enumerate(everybody)] == [None, None, None, 1]
    assert sorted(gallery.left) == [1, 2]


def test_how_many_pass_for_each_other_is_learnt_of_the_scene():
    gallery = Gallery()
    at_first = gallery.alike()
    gallery._count((0, 1), -3.0, 1.0)
    assert gallery.alike() < 0.3 * at_first
    gallery._count((0, 1), 5.0, 1.0)
    assert gallery.alike() > 2 * at_first
    gallery._count((0, 1), 0.0, 1.0)  # not known yet
    assert gallery.alike() == at_first


def test_a_few_false_detections_are_not_a_person_to_remember():
    features = kinds()
    gallery, (anna, *_) = remembered(features, [[3.0, -3.0]])
    gallery.come(7, anna.time - 0.3)
    gallery.leave(7, anna, features)
    assert not gallery.left


# --- the whole tracker ------------------------------------------------------------------------------------------------


def fused(records, population=PLAIN):
    fusion = Fusion()
    fusion.tracker.features = kinds(population)
    return [as_record(one) for one in records for one in fusion.step(one.timestamp, [(one.timestamp, "ceiling", one)])]


def pair(seed, features=True, order=None, kind="clothes"):
    """Two people who meet within 0.2 m, stand for 2 s and turn back, at 10 Hz."""
    rng, own = np.random.default_rng(seed), np.array([[1.5, 0.0], [-1.0, 1.0]])
    for k in range(100):
        away = max(abs(k / 10 - 5.0) - 1.0, 0.0) * 0.8 + 0.09
        z = np.array([[2.3 - away, 2.3, np.nan], [2.3 + away, 2.3, np.nan]])
        z[:, :2] += 0.1 * rng.standard_normal((2, 2))
        vectors = own + 0.5 * rng.standard_normal((2, 2))
        rows = [0, 1] if order is None else order.permutation(2)
        told = {"looks": Feature(kind, vectors[rows], np.full((2, 2), 0.5))} if features else {}
        cov = np.tile(0.01 * np.eye(3), (2, 1, 1))
        yield Detections(k / 10, "ceiling", z[rows], cov, np.full(2, np.nan), "camera", features=told)


def identities(tracks):
    """The identities, from left to right, of each of the records with two people."""
    each = [sorted((row["position"][0], row["object_id"]) for row in record["objects"]) for record in tracks]
    return [[identity for _, identity in row] for row in each if len(row) == 2]


@pytest.mark.parametrize("seed", range(3))
def test_people_who_meet_and_turn_back_are_told_apart(seed):
    found = identities(fused(pair(seed)))
    assert found[5] == found[-1]
    assert len(found) > 90


@pytest.mark.parametrize("seed", range(3))
def test_rare_words_tell_afterwards_who_walked_through_whom(seed):
    """Whoever seems to turn back and walked on is known again by a look a second, though none is given meanwhile."""

    def records():
        for one in pair(seed):
            k = round(10 * one.timestamp)
            told = one.features["looks"].vectors
            if k >= 50:  # each goes on along the other one's way
                told[:] = told[::-1].copy()
            if k % 10 or 35 < k < 65:
                told[:] = np.nan
            yield one

    found = identities(fused(records()))
    assert found[5] == found[-1][::-1]


def test_an_account_says_what_the_features_mean():
    fusion = Fusion(explain=True)
    fusion.tracker.features = kinds()
    for one in pair(1):
        fusion.step(one.timestamp, [(one.timestamp, "ceiling", one)])
    accounts = fusion.accounts()
    validate = jsonschema.Draft202012Validator(schema("explain")).validate
    validate(json.loads(encode(accounts[-1])))
    touching = [one for one in accounts if all(len(each.get("features", {})) == 2 for each in one["detections"])]
    assert len(touching) > 5
    fits = [max(each["features"].values()) for one in touching for each in one["detections"]]
    assert np.mean(fits) > 0.5
    assert min(min(each["features"].values()) for one in touching for each in one["detections"]) >= math.log(FOREIGN)


def test_the_order_of_detections_does_not_matter():
    assert fused(pair(1)) == fused(pair(1, order=np.random.default_rng(5)))


def test_an_unknown_kind_changes_nothing():
    assert fused(pair(1, kind="hat")) == fused(pair(1, features=False))


@pytest.mark.parametrize("like_nobody", [False, True])
def test_wrong_vectors_that_last_begin_no_person(like_nobody):
    records = []
    for k, one in enumerate(pair(2)):
        looks = one.features["looks"]
        vectors = looks.vectors.copy()
        if 5 <= k < 25:
            vectors[0] = [9.0, -9.0] if like_nobody else [-2.0, 2.0]
        told = {"looks": Feature(looks.kind, vectors, looks.sds)}
        records.append(replace(one, features=told))
    tracks = fused(records)
    assert max(len(row["objects"]) for row in tracks) == 2
    assert len({one["object_id"] for row in tracks for one in row["objects"]}) == 2


def test_one_at_a_time_in_the_same_clothes_each_is_somebody_else():
    rng, records = np.random.default_rng(0), []
    for k in range(300):
        there = k % 150 < 80
        z = np.array([[0.4 + 0.05 * (k % 150), 2.0, np.nan]])[:there]
        z[:, :2] += 0.1 * rng.standard_normal((len(z), 2))
        told = clothes([[2.0, -2.0]] * len(z) + 0.2 * rng.standard_normal((len(z), 2))) if there else {}
        cov = np.tile(0.01 * np.eye(3), (len(z), 1, 1))
        records.append(Detections(k / 10, "ceiling", z, cov, np.full(len(z), np.nan), "camera", features=told))
    tracks = fused(records)
    first, second = (
        {one["object_id"] for row in part for one in row["objects"]} for part in (tracks[:90], tracks[150:])
    )
    assert first
    assert second
    assert not first & second


def test_a_kind_that_nobody_knows_and_vectors_of_another_length_are_said_once_and_ignored():
    features, crowd = kinds(), people(2)
    strange = {"gait": Feature("steps", np.zeros((1, 3)), np.ones((1, 3)))}
    for time in (0.0, 0.1):
        for some in (strange, clothes([[1.0, 2.0, 3.0]])):
            assert features.weigh(crowd, [], time, np.zeros((1, 2)), np.ones((2, 1)), some) is None
    assert features.news() == [
        "features 'gait' of kind 'steps' are ignored: nothing is known of this kind over people",
        "features 'looks' of kind 'clothes' are ignored: the vectors have 3 numbers, and those of this kind have 2",
    ]
    assert features.news() == []
    assert seen(features, crowd, [[1.0, 0.0], [-1.0, 0.0]]).vectors.shape == (2, 2)
