"""Any stream of records that follows the format gives tracks without an error, and what is learnt can be written."""

import dataclasses

import numpy as np
import orjson
from hypothesis import example, given, settings
from hypothesis import strategies as st

from avcli.formats import records
from avcli.formats.records import Detections
from avcli.tracking import coverage
from avcli.tracking.fusion import Fusion
from avcli.tracking.model import Population
from avcli.tracking.settings import Settings

AREAS = (((0.0, 0.0), (5.0, 5.0)), ((0.0, 0.0), (40.0, 25.0)))
ORIGIN = np.array([0.1, 0.1, 2.4])


@dataclasses.dataclass(frozen=True)
class Source:
    """A sensor: its kind, what it shows, its first record and the steps between two, whether it covers a disc alone."""

    kind: str = "camera"
    shows: str = "position"
    first: int = 0
    every: int = 1
    disc: bool = False


SOURCES = st.builds(
    Source,
    st.sampled_from(["camera", "microphones"]),
    st.sampled_from(["position", "position", "direction", "range"]),
    st.integers(0, 25),
    st.integers(1, 4),
    st.booleans(),
)


def seen(rng, time, name, source, people):
    """One record: most people, some false detections, some without a covariance or a score."""
    there = people[rng.random(len(people)) < 0.8]
    there = np.concatenate([there, rng.uniform(-20, 40, (rng.choice([0, 0, 1, 3]), 3))])
    there[:, :2] += 0.1 * rng.standard_normal((len(there), 2))
    n, given = len(there), {}
    partly = rng.random(n) < (0.8 if source.shows != "position" else 0.0)
    place = np.where(partly[:, None], np.nan, there)
    if source.shows != "position":
        given["origins"] = np.where(partly[:, None], ORIGIN, np.nan)
        away = there - ORIGIN
        far = np.linalg.norm(away, axis=1)
        if source.shows == "range":
            given["ranges"] = np.where(partly, far, np.nan)
        else:
            given["directions"] = np.where(partly[:, None], away / far[:, None], np.nan)
    spread = rng.choice([1e-8, 0.01, 4.0, 100.0, np.nan], n)
    cov = np.where(partly[:, None, None], np.nan, spread[:, None, None] * np.eye(3))
    score = rng.choice([0.0, 1.0, 0.7, np.nan], n)
    return Detections(time, name, place, cov, score, source.kind, **given)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(SOURCES, min_size=1, max_size=3), st.integers(0, 1), st.sampled_from([0, 3]))
@example(0, [Source(), Source(first=11)], 0, 0)  # the second one comes when something was learnt of the first
@example(8, [Source(every=2, disc=True), Source(every=4)], 0, 3)  # somebody leaves just before a smoothed step
@example(2, [Source(disc=True), Source(disc=True)], 1, 0)  # a hall, seen in part
def test_any_stream_is_fused(seed, sources, area, lag):
    rng = np.random.default_rng(seed)
    people = rng.uniform(0.5, 4.5, (rng.integers(0, 5), 3))
    disc = coverage.of_place({"polygon_m": None, "disc_m": [2.0, 2.0, 1.5]}, AREAS[area])
    covers = {f"s{k}": disc for k, one in enumerate(sources) if one.disc}
    fusion, found = Fusion(Settings(), lag=lag, population=Population(AREAS[area]), coverage=covers), []
    for step in range(40):
        time, people = step / 10, people + np.array([0.05, -0.03, 0.0])
        looks = [
            (time, f"s{k}", seen(rng, time, f"s{k}", one, people))
            for k, one in enumerate(sources)
            if step >= one.first and not (step - one.first) % one.every
        ]
        found += fusion.step(time, looks)
    for tracks in [*found, *fusion.finish()]:
        assert np.isfinite(tracks.positions).all()
        assert ((tracks.existence >= 0) & (tracks.existence <= 1)).all()
        for cov in tracks.covariances[:, :2, :2]:
            np.testing.assert_array_equal(cov, cov.T)
            assert (np.linalg.eigvalsh(cov) > 0).all()
        records.encode(records.as_record(tracks))
    orjson.dumps(fusion.tracker.state())
