"""The bench of trackers measures what it says, on tracks whose faults are known."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from avcli.tracking.settings import sensor

sys.path.insert(0, str(Path(__file__).parent / "bench"))
import tracking_measures as measures
import tracking_peers as peers
import tracking_report as report
import walks
from tracking_cases import SYNTHETIC, judged
from tracking_runs import Frame, Variant, ceiling, fuse
from tracking_scenes import Look, Scene, Stay, clock, perceived, room


def frame(**people):
    """A frame of tracks by their names t0, t1, ...: places (2,) m, all of existence 0.9."""
    ids = [int(name[1:]) for name in people]
    return Frame(ids, np.reshape(list(people.values()), (-1, 2)), np.full(len(ids), 0.9))


def true(*frames):
    """The truth at 10 Hz of frames {person: place}."""
    return [(k / 10, np.array(list(one), int), np.reshape(list(one.values()), (-1, 2))) for k, one in enumerate(frames)]


def test_a_ghost_lasts_until_its_track_ends_and_not_while_somebody_is_near():
    truth = true(*[{0: (1, 1)}] * 5, *[{}] * 3, *[{1: (2.5, 1)}] * 2, *[{1: (8, 8)}] * 5)
    tracks = [*[frame(t7=(1, 1))] * 12, *[frame()] * 3]
    left = measures.departures(truth, tracks, measures.matched(truth, tracks))
    assert left.ghosts == pytest.approx([0.5])  # frames 5 to 7, 10 and 11
    assert left.takeovers == 0


def test_a_track_of_somebody_who_left_that_becomes_somebody_elses_is_a_takeover():
    truth = true(*[{0: (1, 1)}] * 5, *[{}] * 3, *[{1: (1.2, 1)}] * 4)
    tracks = [frame(t7=(1, 1))] * 12
    left = measures.departures(truth, tracks, measures.matched(truth, tracks))
    assert left.ghosts == pytest.approx([0.3])
    assert left.takeovers == 1


def test_existence_is_true_for_tracks_matched_one_to_one_within_a_metre():
    truth = true({0: (1, 1)}, {0: (1, 1)})
    tracks = [frame(t1=(1.5, 1), t2=(1, 1)), frame(t1=(2.5, 1))]
    bins = measures.existence(tracks, measures.matched(truth, tracks))
    assert bins[9].tolist() == pytest.approx([3, 2.7, 1, 2 * 0.81 + 0.01])
    assert not bins[:9].any()


def test_what_existence_says_is_counted_over_all_records_and_with_each_case_alike():
    def run(case, seed, true):
        bins = np.zeros((10, 4))
        bins[7] = 10, 7.5, 10 * true, 0
        return report.Run(case, seed, "", "", measures.Outcome(0, 0, 0, 0, 0, 0, 0, [], [], 0, bins.tolist(), 0.0))

    runs = [run("gaps", seed, 1.0) for seed in range(3)] + [run("clutter", 0, 0.4)]
    assert report.reliability({"synthetic": runs})["synthetic"][7] == pytest.approx([40, 4, 0.75, 0.85, 0.75, 0.7])


def test_who_comes_is_found_after_a_delay_and_who_is_never_found_after_the_whole_stay():
    truth = true(*[{0: (1, 1), 1: (5, 5)}] * 6)
    tracks = [*[frame()] * 3, *[frame(t4=(1, 1))] * 3]
    assert measures.delays(truth, measures.matched(truth, tracks)) == pytest.approx([0.3, 0.5])


def test_in_a_hall_seen_in_part_only_the_part_is_scored_and_a_return_may_be_known_or_not():
    places = [(1, 1)] * 10 + [(9, 1)] * 20 + [(1, 1)] * 10
    scene = Scene(true(*[{0: xy} for xy in places]), seen=((0, 0), (4, 4)))
    known = [frame(t3=xy) for xy in places]
    new = [frame(t3=xy) if k < 30 else frame(t4=xy) for k, xy in enumerate(places)]
    for tracks in (known, new):
        assert measures.outcome(scene, tracks, math.nan).hota == pytest.approx(100)
        assert measures.invented(scene, tracks) == 0
    false = [Frame([3, 5], np.array([xy, (8.0, 8.0)]), np.ones(2)) for xy in places]
    assert measures.outcome(scene, false, math.nan).hota == pytest.approx(100)
    assert measures.invented(scene, false) == 1


def test_walks_are_cut_where_nobody_looked_and_where_they_leave_the_area():
    xy = np.column_stack([np.arange(11.0), np.ones(11)])  # 1 m/s to the right, out of the area between 3 and 6 m
    xy[4:7, 1] = 9.0
    stays = list(walks.inside([(np.arange(11.0), xy)], (10.0, 5.0), 0, 200))
    assert len(stays) == 2
    assert stays[0][0] == 0
    assert all((place >= 0).all() and (place <= [10, 5]).all() for _, place in stays)
    assert stays[1][0] + len(stays[1][1]) == 101


def walk(begin, start, velocity, seconds=4.0):
    times = begin + np.arange(0.0, seconds + 0.2, 0.4)
    return times, np.array(start) + (times - begin)[:, None] * np.array(velocity)


def test_a_walk_that_goes_on_under_another_number_is_one_and_a_newcomer_elsewhere_is_not():
    first = walk(0.0, (1.0, 1.0), (1.0, 0.0))
    again = walk(first[0][-1] + 0.4, (first[1][-1][0] + 0.4, 1.1), (1.0, 0.0))
    beside = walk(again[0][0], (first[1][-1][0] + 0.4, 1.7), (1.0, 0.0))
    late = walk(again[0][-1] + 2.0, (again[1][-1][0] + 2.0, 1.1), (1.0, 0.0))
    found = walks.joined([first, beside, late, again])
    assert sorted(len(times) for times, _ in found) == [11, 11, 22]
    assert all((np.diff(times) > 0).all() for times, _ in found)


def test_where_all_end_at_once_in_the_middle_nobody_looked_and_it_is_not_scored():
    stands = [walk(0.0, (x, 5.0), (0.0, 0.0)) for x in (2.0, 5.0, 8.0)]
    later = walk(9.0, (5.0, 5.0), (0.0, 0.0))
    assert walks.unlooked([*stands, later], (10.0, 10.0)) == [(4.0, 9.0)]
    assert not walks.unlooked([*stands[:2], later], (10.0, 10.0))
    assert not walks.unlooked([*stands[:2], walk(0.0, (9.8, 5.0), (0.0, 0.0)), later], (10.0, 10.0))
    assert not walks.unlooked([*stands, walk(2.0, (5.0, 1.0), (0.0, 0.0)), later], (10.0, 10.0))
    places = [{0: (1, 1)}] * 10 + [{}] * 20 + [{1: (1, 1)}] * 10
    scene = Scene(true(*places), unlooked=[(0.9, 3.0)])  # who is there afterwards may be the same person or another one
    assert measures.outcome(scene, [frame(t3=(1, 1)) for _ in places], math.nan).hota == pytest.approx(100)


@pytest.mark.parametrize("name", ["sort", "bytetrack", "oc-sort"])
def test_a_peer_follows_one_person_past_a_gap_and_ends_the_track(name):
    tracker = peers.PEERS[name][1](peers.Parameters(hits=2, age=1.0, shown=0.3))
    tracker.add(sensor("video"))
    noise, labels = 0.0144 * np.eye(2)[None], set()
    for k in range(30):
        z = np.zeros((0, 2)) if 10 <= k < 15 else np.array([[0.1 * k, 1.0]])
        tracker.update(k / 10, "video", z, noise[: len(z)])
        labels |= {track.label for track in tracker.tracks(k / 10)}
    assert labels == {0}
    assert tracker.tracks(2.9)[0].state[:2] == pytest.approx([2.9, 1.0], abs=0.1)
    for k in range(30, 45):
        tracker.update(k / 10, "video", np.zeros((0, 2)), noise[:0])
    assert not tracker.tracks(4.4)
    assert not tracker.lives


def test_merged_copied_and_false_detections_are_as_the_look_says():
    pair = [Stay(0, np.tile([x, 2.0], (101, 1)), np.ones(101, bool), np.zeros(101, bool)) for x in (2.0, 2.1)]
    look = Look("video", 0.0, 1.0, 0.0, merge=0.3)
    scene = perceived(np.random.default_rng(0), pair, clock(10.0), (look,), room(5, 5))
    counts = np.array([len(record[2]) for record in scene.records])
    assert set(counts) == {1, 2}
    assert 30 < (counts == 1).sum() < 70
    look = Look("video", 0.0, 1.0, 2.0, copies=3, corner=(3.0, 3.0), area=(4.0, 4.0))
    scene = perceived(np.random.default_rng(0), pair[:1], clock(10.0), (look,), room(5, 5))
    owners = np.concatenate([record[4] for record in scene.records])
    places = np.concatenate([record[2] for record in scene.records])
    assert (places[owners < 0] >= 3).all()
    assert (owners == 0).sum() / 101 == pytest.approx(2.0, abs=0.2)


def test_a_variant_reads_settings_and_the_best_tracker_is_told_who_is_who():
    variant = Variant.of(["no-hidden", "stay=20", "lag=inf", "tracker=lmb"])
    assert (variant.settings.hidden, variant.settings.stay) == (False, 20.0)
    assert (variant.lag, variant.tracker) == (math.inf, "lmb")
    with pytest.raises(ValueError, match="--set nonsense"):
        Variant.of(["nonsense"])
    scene = SYNTHETIC["s3"](np.random.default_rng(100))
    for tracks in (ceiling(scene), fuse(scene, Variant())[0]):
        assert measures.outcome(scene, tracks, math.nan).hota > 90


def test_sets_and_seeds_that_judge_are_known():
    assert judged(["hotel", "zara01occ@any", "s1"], range(100, 103)) == []
    assert judged(["hotel", "eth@any", "students03occ", "s1"], range(3)) == ["eth@any", "students03occ", "s1"]
