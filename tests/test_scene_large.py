"""Crowds, halls, and cameras that see nothing: what a scene may be, and what is refused."""

import numpy as np
import pytest

import avcli
from avcli.scene import annotations, outlines, people, render, scenario, shaders, viewpoint
from avcli.scene.settings import Drawing

SMALL = {
    "lens_model": "kannala_brandt", "fx_px": 215.6, "fy_px": 215.7, "cx_px": 262.0, "cy_px": 137.8, "k1": -0.0269,
    "k2": -0.0038, "k3": 0.0016, "k4": -0.0006, "image_width_px": 480, "image_height_px": 270,
}  # fmt: skip


def crowd(count, room):
    """People on a grid in a room, and the scene."""
    side = int(np.ceil(np.sqrt(count)))
    places = (np.stack(np.meshgrid(range(side), range(side)), -1).reshape(-1, 2)[:count] + 0.6) / (side + 0.2)
    standing = [{"waypoints": [{"position_m": (place * room[:2]).tolist()}]} for place in places]
    return scenario.parse({"camera_config": SMALL, "room_config": {"room_dimensions_m": room}, "people": standing})


def drawn(scene, largest=None):
    camera, room = scene.config.camera, scene.config.room.dimensions
    renderer = render.Renderer(camera, room, scene.solids)
    if largest:
        renderer.canvas.largest = largest
    bodies = people.pose(scene.people, np.array([0.35]))
    prepared = renderer.prepare(bodies)
    return renderer, bodies, prepared, renderer.draw(prepared, 0)


def test_in_a_crowd_each_person_has_their_own_number():
    scene = crowd(100, [12.0, 12.0, 5.0])
    renderer, bodies, _, frame = drawn(scene)
    assert len(bodies.ra) > shaders.TABLE_LINES  # more cones than a texture has lines
    seen = np.frombuffer(renderer.people_seen.read(), np.float32).reshape(*frame.ids.shape, 2)[..., 1].astype(int)
    owner = np.concatenate([[0], bodies.person + 1])
    np.testing.assert_array_equal(frame.ids, owner[seen])
    assert len(np.unique(frame.ids)) > 30
    assert len(frame.shapes) == 100


def test_silhouettes_in_rows_and_on_several_sheets_are_those_of_one_row(monkeypatch):
    scene = crowd(49, [6.0, 6.0, 3.0])
    _, _, whole, frame = drawn(scene)
    monkeypatch.setattr(outlines, "_SHEET_SAMPLES", 480 * 130)
    _, _, prepared, other = drawn(scene, largest=480)
    sheets = prepared.sheets(0, np.ones(49, bool))
    assert len(whole.sheets(0, np.ones(49, bool))) == 1
    assert len(sheets) > 1
    assert any(tile.box[1] > 0 for sheet in sheets for tile in sheet.tiles)
    assert all(sheet.size[0] <= 480 for sheet in sheets)
    for number in range(49):
        one, two = (annotations.visibility(picture, number) for picture in (frame, other))
        assert one == two
        assert one["visible_fraction"] == 0 or frame.shapes[number][0].any()


@pytest.mark.parametrize("width", [1920, 3840])
@pytest.mark.parametrize("count", [100, 250])
def test_the_silhouettes_of_a_crowd_fit_the_largest_texture(width, count):
    size = (width // 8, width // 5)  # samples of one person near the camera
    packed = outlines._packed([outlines.Tile(k, (0, 0, *size), (0, 0)) for k in range(count)], 16384)
    assert sum(len(tiles) for _, tiles in packed) == count
    for (wide, tall), tiles in packed:
        assert wide <= 16384
        assert tall <= 16384
        covered = np.zeros((tall // 4 + 1, wide // 4 + 1), int)
        for tile in tiles:
            x0, y0, x1, y1 = (value // 4 for value in tile.box)
            covered[y0:y1, x0:x1] += 1
        assert covered.max() == 1


def test_the_step_of_a_depth_picture_holds_the_room():
    fine, coarse = Drawing(), Drawing(depth_bits="8")
    for farthest, step in ((0.1, 1e-4), (4.14, 1e-4), (6.5534, 1e-4), (6.5535, 2e-4), (20.0, 5e-4), (1e3, 0.02)):
        assert fine.depth_step_m(farthest) == pytest.approx(step, rel=1e-12)
        assert round(farthest / fine.depth_step_m(farthest)) < 65535
    assert coarse.depth_step_m(4.14) == 0.02
    assert coarse.depth_step_m(5.1) == 0.04


HALLS = [
    ([16.0, 12.0, 4.0], 3.5, [[0.5, 0.6], [-2.5, 0.3], [3.4, 1.0]], 2e-4),
    ([30.0, 30.0, 8.0], 5.0, [[0.5, 0.6], [-2.5, 1.3], [3.5, -1.5]], 5e-4),
]


@pytest.mark.parametrize(("room", "height", "offsets", "step"), HALLS, ids=["16 m", "30 m"])
def test_in_a_hall_whoever_is_plainly_visible_has_depth_keypoints_and_is_found(room, height, offsets, step):
    middle = np.array(room[:2]) / 2
    standing = [{"waypoints": [{"position_m": (middle + offset).tolist()}]} for offset in offsets]
    lens = {"fx_px": 431.1, "fy_px": 431.4, "cx_px": 524.5, "cy_px": 276.1, "image_width_px": 960}
    camera = {**SMALL, **lens, "image_height_px": 540, "camera_position_m": [*middle.tolist(), height]}
    scene = avcli.simulate(
        {"duration_s": 0, "room_config": {"room_dimensions_m": room}, "camera_config": camera, "people": standing}
    )
    assert scene.config.camera.depth_step_m == step
    (frame,) = scene.frames()
    assert (frame.picture.depth > 0).all()
    for item in frame.record["objects"]:
        assert item["visible_fraction"] > 0.9
        assert sum(v == 2 for _, _, v in item["keypoints_px"]) >= 6
    shots = list(scene.shots())
    for detector in ("depth", "net"):
        (found,) = avcli.detect(scene.config, shots, background=scene.background, detector=detector)
        away = np.linalg.norm(found.positions[:, None, :2] - (middle + offsets), axis=2)
        assert (away.min(0) < 0.15).all(), detector


def test_beyond_64_m_the_nearer_of_two_surfaces_is_seen():
    camera = {**SMALL, "camera_position_m": [1.0, 5.0, 2.0], "camera_rotation_deg": [0, 90, 0]}
    panels = [  # the first one that is drawn is the farther
        {"kind": "box", "position_m": [x, 5.0, 2.0], "size_m": [0.2, 60.0, 60.0]} for x in (150.0, 100.0)
    ]
    room = {"room_dimensions_m": [200.0, 10.0, 4.0]}
    scene = scenario.parse({"camera_config": camera, "room_config": room, "furniture": panels})
    renderer = render.Renderer(scene.config.camera, scene.config.room.dimensions, scene.solids)
    depth = renderer.room_depth * renderer.depth_step
    assert depth.max() == pytest.approx(99.0, abs=1.0)


@pytest.mark.parametrize(
    ("piece", "inside"),
    [
        ({"kind": "box", "position_m": [2.33, 2.33, 2.4], "size_m": [0.3, 0.3, 0.3], "rotation_deg": 30}, True),
        ({"kind": "box", "position_m": [2.33, 2.33, 2.2], "size_m": [0.3, 0.3, 0.3]}, False),
        ({"kind": "cylinder", "position_m": [2.4, 2.33, 2.5], "radius_m": 0.1, "height_m": 0.3}, True),
        ({"kind": "cylinder", "position_m": [2.45, 2.33, 2.5], "radius_m": 0.1, "height_m": 0.3}, False),
        ({"kind": "sphere", "position_m": [2.4, 2.4, 2.5], "radius_m": 0.12}, True),
        ({"kind": "sphere", "position_m": [2.42, 2.42, 2.5], "radius_m": 0.12}, False),
    ],
)
def test_a_camera_inside_furniture_is_refused(piece, inside):
    def parse():
        return scenario.parse({"furniture": [{"kind": "table", "position_m": [1, 1]}, piece]})

    if not inside:
        parse()
        return
    with pytest.raises(scenario.ScenarioError, match=r"\"furniture\[1\]\" holds the camera, .* \[2.33, 2.33, 2.5\]"):
        parse()


def test_a_camera_inside_a_person_is_refused_and_one_beside_or_above_them_is_not():
    def parse(height, y):
        camera = {"camera_position_m": [2.33, 2.33, height]}
        walk = [{"t_s": 0, "position_m": [1.33, y]}, {"t_s": 2, "position_m": [3.33, y]}]
        return scenario.parse({"camera_config": camera, "people": [{"height_m": 1.75, "waypoints": walk}]})

    for height in (1.3, 1.5):
        with pytest.raises(
            scenario.ScenarioError, match=r"\"people\[0\]\" is where the camera is, .* at (0\.9|1\.0) s"
        ):
            parse(height, 2.33)
    parse(1.3, 3.0)
    parse(1.8, 2.33)


def test_the_place_inside_a_cone_is_where_the_ray_caster_sees_the_inside():
    import trimesh

    from avcli.scene import mesh

    scene = crowd(1, [4.0, 4.0, 3.0])
    bodies = people.pose(scene.people, np.array([0.0]))
    low, high = bodies.a[0].min(0) - 0.1, bodies.a[0].max(0) + 0.1
    places = np.random.default_rng(0).uniform(low, high, (300, 3))
    inside = np.zeros(len(places), bool)
    for cone in range(len(bodies.ra)):
        triangles, owner = mesh.bodies_triangles(bodies, 0, 24)
        body = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles[owner == cone]), process=True)
        inside |= body.contains(places)
    said = np.array([viewpoint._cones_around(bodies, place)[0] for place in places])
    assert inside.sum() > 20
    assert (said == inside).mean() > 0.99


@pytest.mark.parametrize("lens", [{"fx_px": 1e-9}, {"k1": -5.0}, {"fx_px": 20.0, "fy_px": 20.0, "k1": -0.5}])
def test_a_lens_that_sees_next_to_nothing_is_refused(lens):
    with pytest.raises(scenario.ScenarioError, match=r"gives a picture of which (9\d|100) % is black"):
        scenario.parse({"camera_config": {**SMALL, **lens}})


def test_what_a_crowd_does_is_said_once_and_counted():
    meeting = [{"waypoints": [{"position_m": [1.0, 1.0 + 0.01 * k]}]} for k in range(20)]
    running = [{"waypoints": [{"position_m": [3, 1]}, {"position_m": [3, 4], "t_s": 0.1 + 0.01 * k}]} for k in range(3)]
    table = [{"kind": "table", "position_m": [1.0, 1.0]}]
    said = scenario.parse({"people": [*meeting, *running], "furniture": table}).warnings
    assert len(said) == 3
    assert said[0].startswith("scenario: people[20].waypoints[1]: a walk at 30 m/s, and 2 other walks are as fast")
    assert said[1] == "scenario: people[0] walks through furniture at 0.0 s, and 19 other people do"
    assert said[2].startswith("scenario: people[1] and people[0] meet at 0.0 s, and 1")
