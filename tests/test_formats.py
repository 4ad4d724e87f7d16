"""Records, config.json and descriptions: what enters and what leaves, with the thesis's own listings."""

import contextlib
import doctest
import math
import subprocess
import sys

import jsonschema
import numpy as np
import orjson
import pytest
from conftest import ROOT, schema
from hypothesis import given
from hypothesis import strategies as st

from avcli import lens
from avcli.formats import __main__ as written
from avcli.formats import descriptions, experiment, records, sensors
from avcli.formats import schema as schemas

LISTING_1 = """
{
    "session_id": "Scenario1",
    "camera_config": {
        "camera_position_m": [2.33, 2.33, 2.50],
        "camera_rotation_deg": [90.0, 0.0, 0.0],
        "fx_px": 596.43,
        "fy_px": 596.43,
        "cx_px": 960.00,
        "cy_px": 540.00,
        "k1": -0.20,
        "k2": 0.00,
        "k3": 0.00,
        "k4": 0.00
    },
    "microphone_config": {
        "audio_sample_rate_hz": 44100,
        "audio_bit_depth": 32,
        "mic_positions_m": [
            { "object_id": 1, "position": [0.12, 4.55, 2.49] },
            { "object_id": 2, "position": [2.40, 4.50, 2.39] },
            { "object_id": 3, "position": [4.55, 4.55, 2.48] },
            { "object_id": 4, "position": [4.50, 2.34, 2.38] },
            { "object_id": 5, "position": [4.55, 0.12, 2.49] },
            { "object_id": 6, "position": [2.40, 0.16, 2.38] },
            { "object_id": 7, "position": [0.12, 0.12, 2.49] },
            { "object_id": 8, "position": [2.39, 2.25, 2.49] }
        ],
        "mic_directivity": "omni"
    },
    "room_config": {
        "room_dimensions_m": [4.66, 4.66, 3.00]
    }
}
"""


def config(**changes):
    """Listing .1 with "section.key" replaced, or removed where the value is None."""
    raw = orjson.loads(LISTING_1)
    for where, value in changes.items():
        section, key = where.split("__")
        if value is None:
            del raw[section][key]
        else:
            raw[section][key] = value
    return experiment.Config(raw, "config.json")


# --- config.json ------------------------------------------------------------------------------------------------------


def test_listing_1_loads_as_it_stands(tmp_path):
    path = tmp_path / "config.json"
    path.write_text(LISTING_1)
    loaded = experiment.read_config(path)
    camera, microphones, room = loaded.camera, loaded.microphones, loaded.room
    assert camera.lens == lens.Division(596.43, 596.43, 960.0, 540.0, -0.2, 0.0, 0.0, 0.0, 1920, 1080)
    assert (camera.width_px, camera.height_px, camera.frame_rate_hz, camera.depth_kind) == (1920, 1080, 10.0, "radial")
    np.testing.assert_allclose(camera.T_room_camera @ [0, 0, 1, 1], [2.33, 2.33, 1.5, 1], atol=1e-12)
    np.testing.assert_allclose(camera.T_room_camera @ [1, 0, 1, 1], [3.33, 2.33, 1.5, 1], atol=1e-12)
    np.testing.assert_allclose(camera.T_room_camera @ [0, -1, 1, 1], [2.33, 3.33, 1.5, 1], atol=1e-12)
    assert microphones.positions.shape == (8, 3)
    assert microphones.sample_rate_hz == 44100
    assert (microphones.directivities == 1).all()
    assert room.dimensions.tolist() == [4.66, 4.66, 3.0]
    assert (room.reverberation_time_s, room.speed_of_sound_m_s) == (None, 343.0)
    jsonschema.validate(loaded.raw, schema("config"))


def test_a_command_asks_only_for_the_keys_that_it_uses():
    loaded = experiment.Config({"room_config": {"room_dimensions_m": [5, 4, 3]}})
    assert loaded.room.dimensions.tolist() == [5, 4, 3]
    assert loaded.frame_rate_hz == 10.0
    with pytest.raises(experiment.ConfigError, match=r'config.json: "camera_config" is missing'):
        _ = loaded.camera


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_config__fx_px": None}, '"camera_config.fx_px" is missing'),
        (
            {"camera_config__fx_px": "596"},
            '"camera_config.fx_px" must be a number above 0 and at most 1e6, found "596"',
        ),
        ({"camera_config__fx_px": -1}, '"camera_config.fx_px" must be a number above 0 and at most 1e6, found -1'),
        ({"camera_config__lens_model": "fisheye"}, '"camera_config.lens_model" must be one of kannala_brandt, '),
        (
            {"camera_config__camera_position_m": [1, 2]},
            r'"camera_config.camera_position_m" must be a list of three numbers from -1e6 to 1e6, found \[1,2\]',
        ),
        (
            {"camera_config__image_width_px": 0.5},
            '"camera_config.image_width_px" must be an integer from 1 to 134217728',
        ),
        (
            {"microphone_config__mic_positions_m": []},
            '"microphone_config.mic_positions_m" must be a list of at least one',
        ),
        ({"microphone_config__mic_positions_m": [[0, 0, None]]}, r"mic_positions_m\[0\]\" must be a list of three"),
        (
            {"microphone_config__mic_positions_m": [{"position": [0, None, 0]}]},
            r"mic_positions_m\[0\].position\" must be a list of three numbers from -1e6 to 1e6",
        ),
        ({"microphone_config__mic_directivity": "shotgun"}, '"microphone_config.mic_directivity" must be one of omni'),
        ({"microphone_config__directivities": ["omni"]}, "must be a list of 8, one for each microphone, found 1"),
        ({"room_config__room_dimensions_m": [4, 4, -3]}, "must be a list of three numbers from 0.001 to 10000"),
        ({"room_config__absorption": [0.1, 0.2]}, "must be a number from 0 to 1 or a list of six numbers from 0 to 1"),
    ],
)
def test_a_wrong_key_is_named(changes, words):
    loaded = config(**changes)
    with pytest.raises(experiment.ConfigError, match=f"config.json: .*{words}"):
        _ = loaded.camera, loaded.microphones, loaded.room


def test_a_broken_config_is_named_with_its_place(tmp_path):
    path = tmp_path / "config.json"
    path.write_text('{\n  "camera_config": \n}')
    with pytest.raises(experiment.ConfigError, match=r"config.json:3:\d+: invalid JSON"):
        experiment.read_config(path)


def test_what_a_sensor_is_comes_from_its_record_then_from_config_json_then_from_its_name():
    known = config().sensors
    assert known == {}
    raw = orjson.loads(LISTING_1) | {
        "sensors": {"audio": {"kind": "camera"}, "ring": {"kind": "microphones", "own": 1}}
    }
    known = experiment.Config(raw).sensors
    assert sensors.sensor_kind("audio", "microphones", known) == ("microphones", False)
    assert sensors.sensor_kind("audio", None, known) == ("camera", False)
    assert sensors.sensor_kind("ring", None, known) == ("microphones", False)
    assert sensors.sensor_kind("my-Mics", None, known) == ("microphones", True)
    assert sensors.sensor_kind("ceiling") == ("camera", True)
    raw["sensors"]["ring"]["kind"] = "radar"
    with pytest.raises(
        experiment.ConfigError, match=r'"sensors\.ring\.kind" must be one of camera, microphones, found "'
    ):
        _ = experiment.Config(raw).sensors


def test_angles_that_calibration_saw_limit_the_lens():
    assert config(camera_config__theta_max_observed_deg=40.0).camera.theta_max == pytest.approx(math.radians(40))


def test_rays_beyond_the_trusted_angle_are_used_and_known_to_be_extrapolated():
    limits = {"camera_config__theta_max_observed_deg": 38.0, "camera_config__theta_max_trusted_deg": 35.0}
    camera = config(**limits, camera_config__theta_max_valid_deg=50.0).camera
    assert (camera.theta_max, camera.theta_trusted) == pytest.approx((camera.lens.theta_max, math.radians(35)), abs=0.5)
    assert config().camera.theta_trusted == math.pi
    assert config().camera.circle is None
    assert config(camera_config__image_circle_px=[960, 540, 500]).camera.circle == (960, 540, 500)
    with pytest.raises(experiment.ConfigError, match="the radius must be above 0"):
        _ = config(camera_config__image_circle_px=[960, 540, 0]).camera


# --- records ----------------------------------------------------------------------------------------------------------


def test_listing_4_and_5_load():
    found = records.detections(
        records.decode(b'{"timestamp": "0.1000000000", "objects": [{"position": [-0.62, 2.34, 0.46]}]}')
    )
    assert (found.timestamp, found.sensor, found.positions.tolist()) == (0.1, None, [[-0.62, 2.34, 0.46]])
    assert np.isnan(found.covariances).all()
    assert np.isnan(found.scores).all()
    line = b'{"timestamp": "0.0000000000", "objects": [{"object_id": 0, "position": [0.0, 1.33, 0.0]}]}'
    truth = records.identified(records.decode(line))
    assert (truth.ids.tolist(), truth.positions.tolist()) == ([0], [[0.0, 1.33, 0.0]])
    assert np.isnan(truth.speaking).all()
    assert np.isnan(truth.mouths).all()


@given(st.floats(0, 2e9), st.lists(st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3), max_size=5))
def test_what_is_written_is_read_again(timestamp, positions):
    rows = [{"object_id": i, "position": position} for i, position in enumerate(positions)]
    line = records.encode({"timestamp": timestamp, "objects": rows})
    record = records.decode(line)
    assert line.endswith(b"}\n")
    assert abs(record["timestamp"] - timestamp) <= 6e-11 + 1e-15 * timestamp
    assert records.identified(record).positions.tolist() == positions
    assert records.encode(record) == line, "the form is canonical"
    jsonschema.validate(orjson.loads(line), schema("track"))


@pytest.mark.parametrize(
    "value", [math.nan, math.inf, np.float64("nan"), np.array([1.0, np.inf]), [[{"a": -math.inf}]]]
)
def test_a_writer_refuses_what_json_cannot_hold(value):
    with pytest.raises(records.RecordError, match="JSON cannot hold"):
        records.encode({"timestamp": 0.0, "position": value})


def test_numpy_is_written_as_numbers():
    line = records.encode({"timestamp": np.float64(0.1), "a": np.eye(2)[:, :1], "b": np.int64(3), "c": np.float32(0.5)})
    assert orjson.loads(line) == {"timestamp": "0.1000000000", "a": [[1.0], [0.0]], "b": 3, "c": 0.5}


def test_a_record_that_passes_through_keeps_its_own_keys():
    line = b'{"timestamp":"0.1000000000","own":{"list":[1,null]},"objects":[{"position":[1,2],"own":true}]}\n'
    record = records.decode(line)
    assert len(records.detections(record)) == 1
    assert records.encode(record) == line


def test_a_height_that_was_not_observed():
    objects = b'[{"position": [1, 2, null]}, {"position": [1, 2], "covariance": [[1, 0], [0, 2]]}]'
    line = b'{"timestamp": 0, "objects": ' + objects + b"}"
    found = records.detections(records.decode(line))
    assert np.isnan(found.positions[:, 2]).all()
    assert np.diag(found.covariances[1]).tolist() == [1.0, 2.0, 0.0]


def test_one_identity_twice_is_refused():
    line = b'{"timestamp": 0, "objects": [{"object_id": 1, "position": [1, 2]}, {"object_id": 1, "position": [3, 4]}]}'
    with pytest.raises(records.RecordError, match='"object_id" 1 occurs twice'):
        records.identified(records.decode(line))


LOOKS = {"kind": "clothes", "vector": [0.5, None, -2.0], "sd": [0.1, None, 1.0]}


def with_features(*each):
    return {"timestamp": 0.0, "sensor": "a", "objects": [{"position": [1.0, 2.0, 0.0], "features": f} for f in each]}


def test_features_are_read_as_columns_and_written_again():
    voice = {"kind": "pitch", "vector": [1.5]}
    record = with_features({"looks": LOOKS}, None, {"looks": LOOKS, "voice": voice}, {})
    found = records.detections(record)
    assert {name: one.kind for name, one in found.features.items()} == {"looks": "clothes", "voice": "pitch"}
    nan, looks = [np.nan] * 3, found.features["looks"]
    np.testing.assert_array_equal(looks.vectors, [[0.5, np.nan, -2], nan, [0.5, np.nan, -2], nan])
    np.testing.assert_array_equal(looks.sds, [[0.1, np.nan, 1], nan, [0.1, np.nan, 1], nan])
    np.testing.assert_array_equal(found.features["voice"].vectors, [[np.nan], [np.nan], [1.5], [np.nan]])
    assert np.isnan(found.features["voice"].sds).all()
    again = orjson.loads(records.encode(records.as_record(found)))
    assert [row.get("features") for row in again["objects"]] == [
        {"looks": LOOKS},
        None,
        record["objects"][2]["features"],
        None,
    ]
    jsonschema.validate(again, schema("localization"))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"looks": {"vector": [1]}}, '"features.looks.kind" is missing'),
        (
            {"looks": {**LOOKS, "vector": []}},
            '"features.looks.vector" must be a list of 1 to 1024 numbers from -1e6 to',
        ),
        ({"looks": {**LOOKS, "vector": [1, "2", 3]}}, '"features.looks.vector" must be a list of 1 to 1024 numbers'),
        ({"looks": {**LOOKS, "sd": [1, 1]}}, '"features.looks.sd" must be a list of 3, as "vector" is, found 2'),
        ({"looks": {**LOOKS, "sd": [1, 0, 1]}}, '"features.looks.sd" must be a list of 1 to 1024 numbers above 0'),
        (
            {"looks": {**LOOKS, "kind": "hat"}},
            '"features.looks" must have one kind and length in a record, found "hat"',
        ),
        ({str(k): LOOKS for k in range(9)}, '"features" must have at most 8 names, found 9'),
        (3, '"features" must be a JSON object, found 3'),
    ],
)
def test_invalid_features_are_named_or_dropped(wrong, words):
    record = with_features({"looks": LOOKS}, wrong)
    with pytest.raises(records.RecordError, match=r"^objects\[1\]: " + words):
        records.detections(record)
    reasons = []
    found = records.detections(record, reasons.append)
    assert (len(found), len(found.features["looks"].vectors), len(reasons)) == (1, 1, 1)


@pytest.mark.parametrize("seconds", [0.0, -0.0, 0.1, 1e-11, 4.0, 1.7e9])
def test_timestamps_have_ten_decimals_and_no_negative_zero(seconds):
    text = records.format_timestamp(seconds)
    assert not text.startswith("-")
    assert len(text.split(".")[1]) == 10


def test_people_are_read_with_all_that_is_known_of_them():
    line = (
        b'{"timestamp": "1", "objects": [{"object_id": 4, "position": [1, 2, 0], "mouth_position": [1, 2, 1.6],'
        b' "speaking": true, "bbox_px": [1, 2, 3, 4], "own": {"key": 1}},'
        b' {"object_id": 3.0, "position": [3, 4], "speaking": 0.25, "velocity": [1, 0, 0], "existence": 0.5,'
        b' "covariance": [[2, 1, 0], [1, 2, 0], [0, 0, 1]]}, {"object_id": -1, "position": [5, 6], "speaking": null}]}'
    )
    people = records.identified(records.decode(line))
    assert people.ids.tolist() == [4, 3, -1]
    np.testing.assert_array_equal(people.mouths[:, 2], [1.6, np.nan, np.nan])
    np.testing.assert_array_equal(people.speaking, [1.0, 0.25, np.nan])
    np.testing.assert_array_equal(people.boxes_px[0], [1, 2, 3, 4])
    np.testing.assert_array_equal(people.velocities[:, 0], [np.nan, 1, np.nan])
    np.testing.assert_array_equal(people.covariances[1], [[2, 1, 0], [1, 2, 0], [0, 0, 1]])
    np.testing.assert_array_equal(people.existence, [np.nan, 0.5, np.nan])
    assert np.isnan(people.covariances[[0, 2]]).all()


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"position": [0, 0]}, '"object_id" is missing'),
        ({"object_id": 1}, '"position" is missing'),
        ({"object_id": "a", "position": [0, 0]}, '"object_id" must be an integer, found "a"'),
        ({"object_id": 2**63, "position": [0, 0]}, '"object_id" must be an integer'),
        (
            {"object_id": 1, "position": [0, 0], "speaking": "yes"},
            '"speaking" must be true or false or a number from 0',
        ),
        ({"object_id": 1, "position": [0, 0], "existence": 2}, '"existence" must be a number from 0 to 1, found 2'),
        (
            {"object_id": 1, "position": [0, 0], "velocity": [1, 2]},
            '"velocity" must be a list of three numbers from -1e6 to 1e6',
        ),
    ],
)
def test_an_invalid_person_is_named_or_dropped(value, words):
    record = {"timestamp": 0.0, "objects": [{"object_id": 7, "position": [1, 2]}, value]}
    with pytest.raises(records.RecordError, match=r"^objects\[1\]: " + words):
        records.identified(record)
    reasons = []
    assert records.identified(record, reasons.append).ids.tolist() == [7]
    assert len(reasons) == 1


def test_the_kind_of_a_sensor_stands_in_its_records():
    record = {"timestamp": 0.0, "sensor": "ring", "kind": "microphones", "objects": []}
    assert records.detections(record).kind == "microphones"
    with pytest.raises(records.RecordError, match='"kind" must be one of camera, microphones, found "radar"'):
        records.detections(record | {"kind": "radar"})


@given(st.integers(0, 4), st.data())
def test_what_is_saved_is_loaded(tmp_path_factory, count, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))

    def some(*shape):
        array = rng.uniform(0, 1, (count, *shape))
        array[rng.uniform(size=count) < 0.3] = np.nan
        return array

    spread = some(3, 3)
    spread = spread @ spread.transpose(0, 2, 1) + np.eye(3)
    positions = rng.normal(size=(count, 3))
    people = records.Identified(
        0.5, np.arange(count) * 7, positions, some(3), some(), some(4), some(3), spread, existence=some()
    )
    found = records.Detections(0.5, "ring", positions, spread, some(), "camera", some(4), some())
    path = tmp_path_factory.mktemp("saved") / "records.jsonl"
    for item in (people, found):
        records.save(path, [item])
        (again,) = records.load(path)
        assert type(again) is type(item) or not count
        for name, value in vars(again).items():
            np.testing.assert_array_equal(value, getattr(item, name), err_msg=name)
    records.save(path, [records.Detections(0.0, None, positions), found])
    assert [type(item) for item in records.load(path)] == [records.Detections] * 2


def test_records_are_written_as_they_were_read():
    person = {"object_id": 0, "position": [1.0, 2.0], "mouth_position": [1.0, 2.0, 1.5], "speaking": True}
    track = {"object_id": 0, "position": [1.0, 2.0, 0.0], "existence": 1.0, "speaking": 1.0}
    for record in ({"timestamp": 0.1, "objects": [person]}, {"timestamp": 0.1, "objects": [track]}):
        assert records.encode(records.as_record(records.identified(record))) == records.encode(record)
    boxed = {"position": [1.0, 2.0, 0.9], "score": 0.5, "bbox_px": [1.0, 2.0, 3.0, 4.0], "height": None}
    record = {"timestamp": 0.1, "sensor": "video", "objects": [boxed, {"position": [1.0, 2.0, None]}]}
    assert records.encode(records.as_record(records.detections(record))) == records.encode(record)


def test_an_invalid_line_of_a_file_is_named(tmp_path):
    path = tmp_path / "tracks.jsonl"
    path.write_text('{"timestamp": 0, "objects": []}\n\n{"timestamp": 1, "objects": [{"object_id": 1}]}\n')
    with pytest.raises(records.RecordError, match=r'tracks.jsonl:3: objects\[0\]: "position" is missing'):
        records.load(path)


# --- descriptions -----------------------------------------------------------------------------------------------------


def objects_in(kind):
    """Every Object within a description, itself included."""
    if isinstance(kind, schemas.Object):
        yield kind
        for key in kind.keys.values():
            yield from objects_in(key.kind)
    for inner in (getattr(kind, "item", None), getattr(kind, "kind", None), *_values(getattr(kind, "kinds", ()))):
        if inner is not None:
            yield from objects_in(inner)


def _values(kinds):
    return kinds.values() if isinstance(kinds, dict) else kinds


DESCRIBED = [
    pytest.param(each, id=f"{described.name}-{number}")
    for described in written.FORMATS
    for number, each in enumerate(objects_in(described.content))
    if each.keys
]
EYE = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
VALUES = [
    *(
        None,
        True,
        False,
        0,
        1,
        1.0,
        2,
        -1,
        0.5,
        16,
        250.5,
        8000,
        2**63,
        1e300,
        "",
        "x",
        "0.1",
        " 1e5 ",
        "nan",
        "1_0",
        "0.1000000000",
    ),
    *(
        [],
        [0, 1],
        [0, 1, 2],
        [0, 1, None],
        [0, None, 1],
        [1, 2, 3, 4],
        [0.5] * 3,
        [0.5] * 6,
        ["a"],
        [[0, 1]],
        [True, 0, 0],
    ),
    *(
        [[1, 0], [0, 1]],
        EYE,
        [[1, 0], [0]],
        {},
        {"position": [0, 1, 2]},
        {"position": [0]},
        {"x": 0.5},
        {"x": [[0, 1]]},
    ),
    *({"rgb": "a"}, {"x": {"kind": "camera"}}, {"kind": "sphere", "position_m": [1, 2, 3], "radius_m": 1}, [{}]),
    *("camera", "omni", "z", "division", "sit", "red", "paint", "micro", ["omni"], [{"position_m": [1, 2]}]),
]


@pytest.mark.parametrize("described", DESCRIBED)
def test_the_reader_takes_what_the_schema_takes(described):
    rules = described.schema()
    for rule in described.rules:
        rules.pop(rule)  # which only a writer follows
    check = jsonschema.Draft202012Validator(rules)
    good = valid(described)
    assert _is_read(described, good)
    changed = [*VALUES, {**good, "own key": 1}, *({k: v for k, v in good.items() if k != name} for name in good)]
    for name, key in described.keys.items():
        if key.read and not isinstance(key.kind, schemas.Written):  # else nothing reads it, so that nothing checks it
            changed += [{**good, name: value} for value in VALUES]
    outcomes = [check.is_valid(value) for value in changed]
    assert {True, False} <= set(outcomes)
    for value, outcome in zip(changed, outcomes, strict=True):
        assert _is_read(described, value) == outcome, value


@pytest.mark.parametrize(
    ("read", "described"),
    [
        (records.detections, descriptions.LOCALIZATION),
        (lambda record: records.identified(record, names=records.Names()), descriptions.TRACK),
        (records.frame, descriptions.FRAME_RECORD),
        (records.audio, descriptions.AUDIO_RECORD),
    ],
)
def test_records_are_read_as_their_schemas_say(read, described):
    check = jsonschema.Draft202012Validator(described.content.schema())
    good = valid(described.content)
    inner = next(name for name in good if name in ("objects", "frame", "audio"))
    changed = [{**good, name: value} for name, key in described.content.keys.items() if key.read for value in VALUES]
    for name in good[inner][0] if inner == "objects" else good[inner]:
        if name == "mask":  # which nothing reads
            continue
        for value in VALUES:
            part = {**(good[inner][0] if inner == "objects" else good[inner]), name: value}
            changed.append({**good, inner: [part] if inner == "objects" else part})
    for value in changed:
        line = orjson.dumps(value)
        try:
            taken = read(records.decode(line)) is not None
        except records.RecordError as error:
            taken = '"num_samples"' in str(error)  # a bound that another key gives: JSON Schema cannot say it
        assert taken == check.is_valid(orjson.loads(line)), value


def _is_read(described, value):
    try:
        described.read(value)
    except schemas.Invalid:
        return False
    return True


def valid(kind):
    """One of the values that fit a kind, found in the list above."""
    if isinstance(kind, schemas.Object):
        return {name: valid(key.kind) for name, key in kind.keys.items() if name not in kind.exclusive[1:]}
    if isinstance(kind, schemas.Written):
        check = jsonschema.Draft202012Validator(kind.schema())
        return next((value for value in VALUES if check.is_valid(value)), None)
    if isinstance(kind, schemas.ListOf):
        return [valid(kind.item)] * (kind.least or 1)
    if isinstance(kind, schemas.Choice):
        return kind.choices[0]
    if isinstance(kind, schemas.Named):
        return kind.names[0]
    if isinstance(kind, schemas.Numbers):
        return [valid(kind.item)] * kind.count
    for value in VALUES:
        with contextlib.suppress(schemas.Invalid):
            if value is not None:
                kind.read(value)
                return value
    raise AssertionError(kind)


def numbers_in(kind):
    """Every Number and Integer within a description that a reader checks."""
    if isinstance(kind, schemas.Number | schemas.Integer):
        yield kind
    if isinstance(kind, schemas.Object):
        for key in kind.keys.values():
            if key.read:
                yield from numbers_in(key.kind)
    for inner in (getattr(kind, "item", None), getattr(kind, "kind", None), *_values(getattr(kind, "kinds", ()))):
        if inner is not None:
            yield from numbers_in(inner)


@pytest.mark.parametrize("described", [each for each in written.FORMATS if each.name not in ("explain", "metrics")])
def test_every_number_that_is_read_has_bounds(described):
    numbers = list(numbers_in(described.content))
    for number in numbers:
        above = getattr(number, "above", None)
        assert number.most is not None, number
        assert number.least is not None or above is not None, number


def test_what_follows_from_the_descriptions_is_up_to_date():
    check = subprocess.run([sys.executable, "-m", "avcli.formats", "--check"], capture_output=True, text=True, cwd=ROOT)
    assert (check.returncode, check.stderr) == (0, ""), "run make formats"
    for described in written.FORMATS:
        jsonschema.Draft202012Validator.check_schema(schema(described.name))


def test_a_new_key_is_in_the_schema_and_in_the_manual():
    described = descriptions.Format(
        "own", "Own", schemas.Object({"voice": schemas.Key(schemas.Choice(("high", "low")), "pitch", default="low")})
    )
    assert orjson.loads(written.json_schema(described))["properties"]["voice"]["enum"] == ["high", "low", None]
    assert '.It Va voice\nPitch.\nOne of high, low; default "low".\n' in written.key_list(described)


def test_numbers_beyond_floats_are_refused_and_large_ones_are_not():
    described = schemas.Object({"a": schemas.Key(schemas.Numbers(2)), "b": schemas.Key(schemas.Number())})
    assert described.read({"a": [1.7e308, 1.7e308], "b": np.float64(2)}) == {"a": [1.7e308, 1.7e308], "b": 2.0}
    for value in ({"a": [10**400, 1]}, {"b": 10**400}, {"b": math.inf}, {"a": [math.nan, 1]}, {"a": [math.inf, 1]}):
        with pytest.raises(schemas.Invalid, match="must be"):
            described.read(value)


@pytest.mark.parametrize("module", [records, schemas])
def test_the_samples_in_the_docstrings(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testmod(module)
    assert tried > 0
    assert failed == 0
