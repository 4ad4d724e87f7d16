"""The network that ships with the package, on pictures that its training has not seen."""

import sys
from importlib import resources

import numpy as np
import pytest
from conftest import ROOT

from avcli.detection.network import Network


@pytest.fixture(scope="module")
def content() -> bytes:
    return (resources.files("avcli.detection") / "people.onnx").read_bytes()


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


def test_people_of_another_seed_are_found(network):
    sys.path.insert(0, str(ROOT / "examples" / "train-detector"))
    try:
        from generate import Generator
        from judge import overlaps
    finally:
        sys.path.pop(0)
    draw = Generator(seed=123_456, bodies=60, cameras=15, textures=15)
    people = found = false = 0
    for _ in range(60):
        sample = draw()
        boxes = network.detect(sample.picture).boxes
        hits = np.array([overlaps(box, sample.boxes) for box in boxes]).reshape(len(boxes), len(sample.boxes))
        must = sample.visible >= 1 / 2
        people += must.sum()
        found += (hits.max(axis=0, initial=0.0) >= 0.5)[must].sum()
        false += (hits.max(axis=1, initial=0.0) < 0.3).sum()
    assert found >= 0.45 * people  # these are harder than renders: a guard against a broken file, not its measure
    assert false <= 0.25 * people
