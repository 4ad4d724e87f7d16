"""The network that ships with the package, on pictures that its training has not seen."""

import sys

import numpy as np
import pytest
from conftest import ROOT

from avcli.detection.network import Network, own_model


@pytest.fixture(scope="module")
def content() -> bytes:
    return own_model()


@pytest.fixture(scope="module")
def network(content):
    return Network(content)


def test_it_is_small_and_says_what_it_is(content, network):
    assert len(content) <= 2_000_000
    assert (network.head.kind, network.names) == ("points", ["person"])


@pytest.mark.parametrize("level", [0, 90, 255])
def test_a_blank_picture_is_empty(network, level):
    assert len(network.detect(np.full((1080, 1920, 3), level, np.uint8))) == 0


def test_any_size_and_the_same_bytes(content, network):
    picture = np.random.default_rng(0).integers(0, 255, (300, 500, 3), dtype=np.uint8)
    first, second = network.detect(picture), Network(content, threads=2).detect(picture)
    assert np.array_equal(first.boxes, second.boxes)
    assert Network(content, (320, 192)).size == (320, 192)
    Network(content, (250, 130)).detect(picture)


@pytest.fixture(scope="module")
def samples():
    """Pictures of a seed that training does not use."""
    sys.path.insert(0, str(ROOT / "examples" / "train-detector"))
    try:
        from generate import Generator
        from judge import overlaps
    finally:
        sys.path.pop(0)
    draw = Generator(seed=123_456, bodies=60, cameras=15, textures=15)
    return [draw() for _ in range(60)], overlaps


def test_looking_at_what_changed_only_finds_the_same(content, samples):
    regional, whole = Network(content, confidence=0.3), Network(content, confidence=0.3)
    pictures, _ = samples
    for before, after in zip(pictures[:20:2], pictures[1:20:2], strict=True):
        x, y = 16 * (len(after.boxes) % 3) + 200, 120
        picture = before.picture.copy()
        picture[y : y + 130, x : x + 130] = after.picture[y : y + 130, x : x + 130]
        regional.detect(before.picture)
        found = regional.detect(picture, np.array([[x - 16, y - 16, x + 146, y + 146]]))
        wanted = whole.detect(picture)
        assert len(found) == len(wanted)
        assert np.abs(found.scores - wanted.scores).max(initial=0.0) < 0.05
        assert np.abs(found.boxes - wanted.boxes).max(initial=0.0) < 3.0
    still = regional.detect(picture, np.empty((0, 4)))
    assert np.array_equal(still.boxes, found.boxes)


def test_in_integers_it_says_nearly_what_it_says_in_floats(network, samples):
    floats, off, unlike = Network(own_model(floats=True)), [], 0
    for sample in samples[0][:30]:
        found, wanted = network.detect(sample.picture), floats.detect(sample.picture)
        unlike += abs(len(found) - len(wanted))
        if len(found) == len(wanted):
            off += np.abs(found.boxes - wanted.boxes).ravel().tolist()
    assert unlike <= 2
    assert np.median(off) < 1.0


def test_people_of_another_seed_are_found(network, samples):
    pictures, overlaps = samples
    people = found = false = 0
    for sample in pictures:
        boxes = network.detect(sample.picture).boxes
        hits = np.array([overlaps(box, sample.boxes) for box in boxes]).reshape(len(boxes), len(sample.boxes))
        must = sample.visible >= 1 / 2
        people += must.sum()
        found += (hits.max(axis=0, initial=0.0) >= 0.5)[must].sum()
        false += (hits.max(axis=1, initial=0.0) < 0.3).sum()
    assert found >= 0.45 * people  # these are harder than renders: a guard against a broken file, not its measure
    assert false <= 0.25 * people
