"""Leaving people out: against TrackEval's treatment of distractors, and what it means for ears alone."""

import json

import numpy as np
import pytest
from conftest import run
from hypothesis import given, settings
from hypothesis import strategies as st
from test_aveval import records_of
from test_metrics import sequences, trackeval_data

from avcli.metrics.matching import ignore


def by_trackeval(trackeval, sequence, ignored):
    """What TrackEval's own preprocessing leaves when the ignored points are distractors."""
    dataset = object.__new__(trackeval.datasets.MotChallenge2DBox)
    dataset.benchmark, dataset.do_preproc = "MOT17", True
    dataset.class_name_to_class_id = {"pedestrian": 1, "person_on_vehicle": 2, "static_person": 7}
    dataset.class_name_to_class_id |= {"distractor": 8, "reflection": 12}
    dataset.valid_class_numbers = [1, 2, 7, 8, 12]
    data = trackeval_data(sequence)
    truth, track = sequence.truth, sequence.track
    raw = {"seq": "s", "num_timesteps": sequence.time.size, "similarity_scores": data["similarity_scores"]}
    raw |= {"gt_ids": data["gt_ids"], "tracker_ids": data["tracker_ids"]}
    for name in ("gt_dets", "gt_classes", "gt_extras", "tracker_dets", "tracker_classes", "tracker_confidences"):
        raw[name] = []
    for t in range(sequence.time.size):
        g, k = slice(*truth.start[t : t + 2]), slice(*track.start[t : t + 2])
        raw["gt_dets"].append(truth.position[g])
        raw["gt_classes"].append(np.where(ignored[g], 8, 1))
        raw["gt_extras"].append({"zero_marked": np.ones(g.stop - g.start)})
        raw["tracker_dets"].append(track.position[k])
        raw["tracker_classes"].append(np.ones(k.stop - k.start, int))
        raw["tracker_confidences"].append(np.ones(k.stop - k.start))
    return dataset.get_preprocessed_seq_data(raw, "pedestrian")


@given(sequences(grid=0), st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=80, deadline=None)
def test_the_ignored_go_as_trackevals_distractors_do(sequence, seed, all_of_a_person):
    trackeval = pytest.importorskip("trackeval", reason="trackeval, the oracle, is not installed")
    rng = np.random.default_rng(seed)
    ignored = rng.random(sequence.truth.identity.size) < 0.4
    if all_of_a_person:
        ignored = np.isin(sequence.truth.identity, [0, 2])
    ours, theirs = ignore(sequence, ignored), by_trackeval(trackeval, sequence, ignored)
    data = trackeval_data(ours)
    for name in ("num_gt_ids", "num_tracker_ids", "num_gt_dets", "num_tracker_dets"):
        assert data[name] == theirs[name], name
    for t in range(sequence.time.size):
        np.testing.assert_array_equal(data["gt_ids"][t], theirs["gt_ids"][t])
        np.testing.assert_array_equal(data["tracker_ids"][t], theirs["tracker_ids"][t])
        np.testing.assert_allclose(data["similarity_scores"][t], theirs["similarity_scores"][t], atol=1e-12)


def test_ears_are_judged_by_those_who_speak(tmp_path):
    def write(name, rows):
        text = "".join(
            json.dumps({"timestamp": f"{t / 10:.10f}", "objects": objects}) + "\n" for t, objects in enumerate(rows)
        )
        (tmp_path / name).write_text(text)

    people = [
        [{"object_id": k, "position": [t / 10, 1.0 + k, 0.0], "speaking": k == 1} for k in range(3)] for t in range(20)
    ]
    write("truth.jsonl", people)
    write("ears.jsonl", [[{"object_id": 9, "position": each[1]["position"]}] for each in people])
    write("found.jsonl", [[{"position": each[1]["position"]}] for each in people])
    write("all.jsonl", [[{k: v for k, v in o.items() if k != "speaking"} for o in each] for each in people])
    write("ghost.jsonl", [[{"object_id": 9, "position": [t / 10, 4.5]}] for t in range(20)])

    def scores(*options):
        found = records_of(
            run("aveval", "truth.jsonl", "ears.jsonl", "all.jsonl", "ghost.jsonl", *options, cwd=tmp_path)
        )
        return {r["tracker"]: r["summary"]["HOTA"] for r in found if r["sequence"] == "truth" and "tracker" in r}

    assert scores() == {"ears": pytest.approx(3**-0.5), "all": 1.0, "ghost": pytest.approx(0, abs=0.2)}
    assert scores("--speaking", "--html", "r.html", "--detections", "found.jsonl") == {"ears": 1, "all": 1, "ghost": 0}
    silent = run("aveval", "all.jsonl", "ears.jsonl", "--speaking", cwd=tmp_path)
    assert (silent.returncode, silent.stdout) == (1, b"")
    assert 'must give "speaking" for every person' in silent.stderr
    assert run("aveval", "all.jsonl", "ears.jsonl", "--speaking", "--compare-thesis", cwd=tmp_path).returncode == 2
