"""Scenario files: invalid keys and their messages; random scenarios; camera twins."""

import json

import jsonschema
import numpy as np
import pytest
from conftest import ROOT, done, refused, run, schema

from avcli.scene import film, furniture, mesh, scenario, sensor, worlds
from avcli.scene.doorways import is_inside
from avcli.scene.people import LOOKS
from avcli.scene.settings import LENSES, ROOM_KINDS, Effects

SCHEMA = schema("scenario")
GOOD = {"people": [{"waypoints": [{"position_m": [1.0, 1.0]}, {"position_m": [2.0, 1.0]}]}]}


def test_what_is_left_out_is_the_laboratory():
    scene = scenario.parse({})
    assert scene.duration == 4.0
    assert scene.config.room.dimensions.tolist() == [4.66, 4.66, 3.0]
    assert scene.config.camera.lens.fx == 862.27
    assert len(scene.config.microphones.positions) == 8
    assert len(scene.times) == 41


def test_every_key_of_people_and_waypoints_is_used():
    source = (ROOT / "avcli" / "scene" / "scenario.py").read_text()
    unused = [key for kind in (scenario._PERSON, scenario._WAYPOINT) for key in kind.keys if f'["{key}"]' not in source]
    assert not unused


def point(**keys):
    return {"people": [{"waypoints": [{"position_m": [1.0, 1.0]}, {"position_m": [2.0, 1.0], **keys}]}]}


@pytest.mark.parametrize(
    ("raw", "where"),
    [
        ([], "s.json: must be a JSON object, found []"),
        ({"peeple": []}, 's.json: "peeple" is not a known key; known are name, duration_s, '),
        ({"people": {}}, 's.json: "people" must be a list'),
        ({"people": [3]}, 's.json: "people[0]" must be a JSON object, found 3'),
        ({"people": [{}]}, 's.json: "people[0].waypoints" is missing'),
        ({"people": [{"waypoints": []}]}, '"people[0].waypoints" must be a list of at least one, found []'),
        ({"people": [{"waypoints": [{}]}]}, 's.json: "people[0].waypoints[0].position_m" is missing'),
        (point(position_m=[9.0, 1.0]), '"people[0].waypoints[1].position_m" [9.0, 1.0] is outside the room'),
        (point(position_m=[1.0, None]), 's.json: "people[0].waypoints[1].position_m" must be a list of two numbers'),
        (point(position_m=[1.0, float("nan")]), '"people[0].waypoints[1].position_m" must be a list of two'),
        (point(speed_m_s=0), '"people[0].waypoints[1].speed_m_s" must be a number from 1e-6 to 1e6, found 0'),
        (point(speed_m_s=1, t_s=2), '"people[0].waypoints[1]" has t_s and speed_m_s; only one of them is possible'),
        (point(t_s=0), '"people[0].waypoints[1].t_s" must be after the previous waypoint, 0 s, found 0'),
        (point(pose="fly"), '"people[0].waypoints[1].pose" must be one of stand, sit, table, '),
        (point(stay_s=-1), '"people[0].waypoints[1].stay_s" must be a number from 0 to 1e11'),
        (
            point(position_m=[1.0, 1.0]),
            '"people[0].waypoints[1].position_m" is the position of the previous waypoint; give t_s',
        ),
        ({"people": [{**GOOD["people"][0], "look": "pink"}]}, '"people[0].look" must be one of red'),
        ({"people": [{**GOOD["people"][0], "height_m": 9}]}, '"people[0].height_m" must be a number from 0.5 to 2.5'),
        ({"people": [{**GOOD["people"][0], "speech_s": [[2, 1]]}]}, '"people[0].speech_s[0]" must start before'),
        ({"people": [{**GOOD["people"][0], "speech_s": [[0, 2], [1, 3]]}]}, '"people[0].speech_s[1]" begins before'),
        ({"people": [{**GOOD["people"][0], "speech_s": [[0]]}]}, '"people[0].speech_s[0]" must be a list of two'),
        (
            {"people": [{**GOOD["people"][0], "object_id": 1}, GOOD["people"][0]]},
            '"people[1].object_id" must differ between people; 1 is used twice',
        ),
        ({"camera_config": {"camera_position_m": [1, 1, 3.5]}}, 'camera_position_m" [1.0, 1.0, 3.5] is outside'),
        (
            {"camera_config": {"fx_px": -1}},
            's.json: "camera_config.fx_px" must be a number above 0 and at most 1e6, found -1',
        ),
        ({"camera_config": {"image_width_px": 0}}, "camera_config.image_width_px"),
        ({"room_config": {"room_dimensions_m": [4, 0, 3]}}, "room_config.room_dimensions_m"),
        ({"duration_s": -1}, 's.json: "duration_s" must be a number from 0 to 1e11'),
        ({"duration_s": 1e9}, 's.json: "duration_s" must give at most 10 million frames, found 1e+09 s'),
        ({"furniture": [{}]}, '"furniture[0].kind" is missing'),
        ({"furniture": [{"kind": "throne"}]}, 's.json: "furniture[0].kind" must be one of table'),
        ({"furniture": [{"kind": "box", "position_m": [1, 1, 1]}]}, '"furniture[0].size_m" is missing'),
        ({"furniture": [{"kind": "box", "position_m": [1, 1, 1], "size_m": [1, 1, 0]}]}, 'size_m" must be a list'),
        ({"furniture": [{"kind": "sphere", "position_m": [1, 1, 1]}]}, '"furniture[0].radius_m" is missing'),
        ({"furniture": [{"kind": "table", "position_m": [1, 1], "radius_m": 1}]}, '"furniture[0].radius_m" is not a'),
        ({"furniture": [{"kind": "table", "position_m": [1, 1], "color": [2, 0, 0]}]}, 'color" must be a list'),
        ({"furniture": [{"kind": "mesh", "position_m": [1, 1, 1], "path": "a.stl"}]}, 'path" cannot be read: meshes'),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_place(raw, where):
    with pytest.raises(scenario.ScenarioError) as error:
        scenario.parse(raw, "s.json")
    assert where in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("dimensions", [[4.66, 4.66, 3.0], [2.5, 3.0, 2.2], [12.0, 6.0, 2.6], [40.0, 30.0, 8.0]])
def test_the_default_camera_and_microphones_stand_where_the_room_has_them(dimensions):
    raw = {"room_config": {"room_dimensions_m": dimensions}}
    usual = scenario.parse({}).config
    scale = np.array(dimensions) / usual.room.dimensions
    for changed in (raw, scenario.with_camera(raw, scenario.CAMERAS["thesis"]), scenario.at_height(raw, 1.0)):
        config = scenario.parse(changed).config
        np.testing.assert_allclose(config.microphones.positions, usual.microphones.positions * scale, atol=1e-6)
        camera = usual.camera.T_room_camera[:3, 3] * scale
        np.testing.assert_allclose(config.camera.T_room_camera[:2, 3], camera[:2], atol=1e-6)
    same = scale.tolist() == [1, 1, 1]
    assert (scenario.laboratory(raw) == scenario.LABORATORY) == same, (
        "the thesis's room has exactly the thesis's places"
    )


def test_a_microphone_outside_the_room_is_refused_with_its_number():
    raw = {"microphone_config": {"mic_positions_m": [[0, 4.66, 3.0], [1, 9, 1]]}}
    with pytest.raises(scenario.ScenarioError, match=r"mic_positions_m\[1\].* microphone 2 at .* is outside the room"):
        scenario.parse(raw)


def test_odd_scenes_are_taken_with_a_warning():
    fast = scenario.parse(point(speed_m_s=100))
    assert "100 m/s" in fast.warnings[0]
    table = {"kind": "table", "position_m": [1.5, 1.0]}
    assert "walks through furniture" in scenario.parse({**GOOD, "furniture": [table]}).warnings[0]
    assert "meet" in scenario.parse({"people": GOOD["people"] * 2}).warnings[0]


def test_a_parsed_scenario_parses_to_itself():
    scene = scenario.parse({**GOOD, "furniture": [{"kind": "chair", "position_m": [3, 3]}]}, "s")
    again = scenario.parse(json.loads(json.dumps(scene.raw)), "s")
    assert again.raw == scene.raw
    np.testing.assert_array_equal(again.solids.centre, scene.solids.centre)


def test_another_camera_replaces_the_lens_whole():
    scene = scenario.parse(scenario.with_camera({}, {"fx_px": 300, "fy_px": 300, "cx_px": 320, "cy_px": 240}))
    assert type(scene.config.camera.lens).__name__ == "Division"
    twin = {"camera_config": {"lens_model": "kannala_brandt", "fx_px": 300, "fy_px": 300, "cx_px": 320, "cy_px": 240}}
    raw = {"camera_config": {"camera_position_m": [1, 1, 2.4], "frame_rate_hz": 5}}
    camera = scenario.parse(scenario.with_camera(raw, twin)).config.camera
    assert (camera.lens.fx, camera.lens.k1) == (300, 0.0)
    assert camera.T_room_camera[:3, 3].tolist() == [1, 1, 2.4]
    assert camera.frame_rate_hz == 5
    assert scenario.parse(scenario.at_height({}, 2.8)).config.camera.T_room_camera[2, 3] == 2.8


def world(people, duration, seed, **wishes):
    wish = worlds.Wishes(people, **wishes)
    return worlds.random_world(wish, duration, np.random.default_rng(seed), scenario.CAMERAS)


@pytest.mark.parametrize(("count", "kind"), list(zip([0, 1, 6, 9, 12, 4], ROOM_KINDS, strict=True)))
def test_random_worlds_are_valid_and_seeded(count, kind):
    one, two = (world(count, 8.0, 3, kind=kind) for _ in range(2))
    assert one == two
    assert one != world(count, 8.0, 4, kind=kind)
    scene = scenario.parse(json.loads(json.dumps(one)))
    assert len(scene.people) == count
    assert scene.warnings == ()
    assert (scene.config.room.dimensions[:2] >= 3.0).all()
    assert (scene.config.room.dimensions[:2] <= 30.0).all()
    for person in scene.people:
        assert person.motion.times[-1] >= 8.0
        assert 0.9 <= person.height <= 2.0


def test_wishes_are_met_and_leave_the_rest_of_the_world_alone():
    free = world(5, 2.0, 8)
    for lens in LENSES:
        fixed = world(5, 2.0, 8, lens=lens)
        assert {**fixed, "camera_config": None} == {**free, "camera_config": None}
    small = world(2, 2.0, 8, room=(4.0, 3.0, 2.5), kind="living", camera_height=2.3)
    assert small["room_config"]["room_dimensions_m"] == [4.0, 3.0, 2.5]
    assert small["camera_config"]["camera_position_m"][2] == 2.3


def test_looks_are_drawn_for_everybody():
    looks = [json.dumps(person["look"]) for seed in range(4) for person in world(12, 1.0, seed)["people"]]
    assert len(set(looks)) == len(looks)


@pytest.mark.parametrize("count", [10, 100])
def test_nobody_meets_in_a_random_crowd(count):
    scene = scenario.parse(world(count, 5.0, 5, kind="hall"))
    assert scene.warnings == ()  # of meetings and of furniture
    t = np.arange(0.0, 5.0, 0.05)
    tracks = np.array([person.motion.position(t) for person in scene.people])
    outside = ~is_inside(tracks, scene.config.room.dimensions)
    away = np.linalg.norm(tracks[:, None] - tracks[None], axis=3) + np.eye(count)[:, :, None]
    assert away[~(outside[:, None] | outside)].min() > 0.4


def test_people_come_and_go_through_doors_and_are_in_the_truth_while_inside():
    doors = [{"wall": "x0", "at_m": 2.0}]
    way = [{"position_m": [-1.0, 2.0]}, {"position_m": [2.0, 2.0]}]
    raw = {"duration_s": 3.0, "room_config": {"doors": doors}, "people": [{"waypoints": way}]}
    truth = [len(record.positions) for record in film.simulate(raw, video=False).truth]
    assert truth == [0] * 11 + [1] * 20
    for place in ([-1.0, 3.0], [-1.0, -1.0], [5.0, 2.0]):
        with pytest.raises(scenario.ScenarioError, match=r"outside the room .* through a door"):
            scenario.parse({**raw, "people": [{"waypoints": [{"position_m": place}, way[1]]}]})


def test_meshes(tmp_path):
    import trimesh

    trimesh.creation.icosphere(radius=0.3).export(tmp_path / "ball.stl")
    (tmp_path / "text.stl").write_text("this is no mesh")
    shared = {"kind": "mesh", "position_m": [2.0, 2.0, 0.5]}
    good = {"furniture": [{**shared, "path": "ball.stl"}]}
    (tmp_path / "good.json").write_text(json.dumps(good))
    done("avsim-scene", tmp_path / "good.json", "--gltf", tmp_path / "scene.glb")
    assert (tmp_path / "scene.glb").read_bytes()[:4] == b"glTF"
    for path, reason in (("text.stl", "furniture[0].path"), ("nowhere.stl", "no such file")):
        (tmp_path / "bad.json").write_text(json.dumps({"furniture": [{**shared, "path": path}]}))
        refused(run("avsim-scene", tmp_path / "bad.json", "--print-scenario"), reason)


def test_triangles_of_solids_are_the_solids():
    import trimesh

    pieces = [
        ({"kind": "box", "position_m": [1, 1, 1], "size_m": [1, 2, 0.5], "rotation_deg": 30}, 1.0),
        ({"kind": "cylinder", "position_m": [1, 1, 1], "radius_m": 0.5, "height_m": 2}, np.pi * 0.5),
        ({"kind": "sphere", "position_m": [1, 1, 1], "radius_m": 0.5}, np.pi / 6),
    ]
    for raw, volume in pieces:
        triangles, owner = mesh.solids_triangles(furniture.build(furniture.PIECE.read(raw), None), 256)
        solid = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles))
        assert solid.volume == pytest.approx(volume, rel=2e-3)
        assert set(owner) == {0}


def test_a_rounded_cone_is_two_balls_and_what_lies_between():
    vertices, faces = mesh.rounded_cone(np.zeros(3), np.array([0.0, 0, 1]), 0.3, 0.2, np.array([1.0, 0, 0]), 0.5, 64)
    assert (vertices.min(0) >= np.array([-0.1501, -0.3001, -0.3001])).all()
    np.testing.assert_allclose(vertices[:, 2].max(), 1.2, atol=1e-9)
    np.testing.assert_allclose(vertices[:, 1].max(), 0.2985, atol=2e-3)
    assert faces.max() < len(vertices)


# --- the sensor -------------------------------------------------------------------------------------------------------

GREY = np.full((40, 60, 3), 120, np.uint8)


def expose(picture=GREY, seed=0, **effects):
    return sensor.expose(picture, Effects(**effects), (30.0, 20.0), np.random.default_rng(seed))


def test_without_effects_the_picture_is_untouched():
    assert expose() is GREY


def test_exposure_doubles_the_light():
    brighter = expose(exposure_ev=1.0)
    assert brighter[0, 0, 0] == round(120 * np.sqrt(2))
    assert (expose(exposure_ev=9.0) == 255).all()


def test_vignetting_darkens_the_corner():
    dark = expose(vignetting=0.75)
    assert dark[20, 30, 0] == 120
    assert dark[0, 0, 0] == 60


def test_noise_has_the_variance_that_was_asked_for():
    picture = np.full((400, 600, 3), 150, np.uint8)
    noisy = sensor.expose(picture, Effects(read_noise=3.0, full_well_e=5000.0), (0.0, 0.0), np.random.default_rng(1))
    light = (noisy / 255.0) ** 2
    mean = (150 / 255) ** 2
    assert light.mean() == pytest.approx(mean, rel=2e-3)
    assert light.std() == pytest.approx(np.sqrt(mean / 5000 + (3 / 255) ** 2), rel=0.02)
    assert (expose(read_noise=2.0, seed=5) == expose(read_noise=2.0, seed=5)).all()
    assert (expose(read_noise=2.0, seed=5) != expose(read_noise=2.0, seed=6)).any()


def test_aberration_spreads_red_outwards():
    picture = np.zeros((200, 300, 3), np.uint8)
    picture[:, 250:] = 255
    spread = sensor.expose(picture, Effects(aberration_px=4.0), (150.0, 100.0), np.random.default_rng(0))
    edges = [(spread[100, :, channel].astype(int) > 127).argmax() for channel in range(3)]
    assert edges[0] > edges[1] > edges[2]


def test_blur_is_the_mean_of_light():
    black, white = np.zeros((2, 2, 3), np.uint8), np.full((2, 2, 3), 255, np.uint8)
    assert (sensor.blurred([black, white]) == round(255 * np.sqrt(0.5))).all()


WARM = np.broadcast_to(np.uint8([150, 130, 112]), (40, 60, 3))


def test_white_balance_makes_lamplight_grey_and_leaves_white_and_brightness():
    picture = WARM.copy()
    picture[:5] = 255
    balanced = expose(picture, white_balance=1.0).astype(int)
    assert np.ptp(balanced[20, 30]) <= 2
    assert (balanced[:5] == 255).all()
    luma = [0.2126, 0.7152, 0.0722]
    assert (balanced[20, 30] / 255) ** 2 @ luma == pytest.approx((WARM[0, 0] / 255) ** 2 @ luma, rel=0.03)


def test_white_balance_ends_at_the_lights_that_a_camera_knows():
    wood, grass = np.uint8([180, 110, 60]), np.uint8([90, 150, 90])
    warm = (expose(np.broadcast_to(wood, (40, 60, 3)), white_balance=0.5)[0, 0] / 255) ** 2
    assert warm[0] / warm[2] == pytest.approx((180 / 60) ** 2 / 2**0.5, rel=0.03)
    green = (expose(np.broadcast_to(grass, (40, 60, 3)), white_balance=0.5)[0, 0] / 255) ** 2
    assert green[1] / green[0] == pytest.approx((150 / 90) ** 2 / 2**0.1, rel=0.03)
    dark = np.full((40, 60, 3), (20, 10, 5), np.uint8)
    assert np.abs(expose(dark, white_balance=1.0).astype(int) - dark).max() <= 1


def test_white_balance_follows_the_light_slowly_and_holds_still_in_a_room_that_does_not_change():
    balance = sensor.WhiteBalance(1.0)
    first = balance.gains(WARM, 0.0)
    assert first[2] / first[0] == pytest.approx((150 / 112) ** 2, rel=1e-3)  # it ran before the film begins
    nearly = WARM.copy()
    nearly[:4, :4] = 90
    assert balance.gains(nearly, 0.1) is first
    courses = [balance.gains(GREY, 0.1 * (k + 2)) for k in range(60)]
    left = np.array([np.log(one[2] / one[0]) for one in courses])
    assert left[0] == pytest.approx(np.log(first[2] / first[0]) * np.exp(-0.1 / 0.65), rel=1e-3)
    assert (np.diff(left) <= 0).all()
    assert abs(left[-1]) < 0.02
    assert courses[-1] is courses[-10]


def test_the_schema_takes_what_the_parser_takes():
    check = jsonschema.Draft202012Validator(SCHEMA)
    built_in = sorted((ROOT / "avcli" / "scene" / "scenarios").glob("*.json"))
    examples = sorted((ROOT / "examples" / "scenarios").glob("*.json"))
    assert len(built_in) == 4
    for path in [*built_in, *examples]:
        check.validate(json.loads(path.read_bytes()))
    check.validate(world(9, 5.0, 3))
    check.validate(scenario.parse(GOOD).raw)
    check.validate(dict.fromkeys(scenario.SCENARIO.content.keys))
    assert scenario.parse(dict.fromkeys(scenario.SCENARIO.content.keys)).people == ()
    assert SCHEMA["properties"]["people"]["items"]["properties"]["look"]["anyOf"][0] == {"enum": [*LOOKS]}


@pytest.mark.parametrize(
    "raw",
    [
        [],
        {"peeple": []},
        {"people": [{}]},
        point(speed_m_s=0),
        point(speed_m_s=1, t_s=2),
        {"furniture": [{"kind": "sphere", "position_m": [1, 1, 1], "radius_m": 0.1, "rotation_deg": 3}]},
        {"furniture": [{"kind": "table", "position_m": [1, 1, 1]}]},
    ],
)
def test_the_schema_refuses_what_the_parser_refuses(raw):
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(raw, SCHEMA)
    with pytest.raises(scenario.ScenarioError):
        scenario.parse(raw)
