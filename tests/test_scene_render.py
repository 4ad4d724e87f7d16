"""The renderer against an independent ray caster (embree on triangles), analytic rooms, and counted pixels."""

import dataclasses

import numpy as np
import pytest

from avcli import pose
from avcli.scene import annotations, devices, furniture, mesh, outlines, people, render, scenario

SMALL_KB = {
    "lens_model": "kannala_brandt", "fx_px": 215.6, "fy_px": 215.7, "cx_px": 262.0, "cy_px": 137.8, "k1": -0.0269,
    "k2": -0.0038, "k3": 0.0016, "k4": -0.0006, "image_width_px": 480, "image_height_px": 270,
}  # fmt: skip
WIDE_KB = {
    "lens_model": "kannala_brandt", "fx_px": 95.0, "fy_px": 95.0, "cx_px": 180.0, "cy_px": 180.0, "image_width_px": 361,
    "image_height_px": 361, "camera_position_m": [2.33, 2.33, 1.4], "camera_rotation_deg": [10.0, 20.0, 5.0],
}  # fmt: skip
DIVISION = {
    "lens_model": "division", "fx_px": 149.1, "fy_px": 149.1, "cx_px": 240.0, "cy_px": 135.0, "k1": -0.2,
    "image_width_px": 480, "image_height_px": 270,
}  # fmt: skip
FOLDED = {
    "lens_model": "brown_conrady", "fx_px": 149.1, "fy_px": 149.1, "cx_px": 240.0, "cy_px": 135.0, "k1": -0.2,
    "image_width_px": 480, "image_height_px": 270,
}  # fmt: skip
FURNITURE = [
    {"kind": "table", "position_m": [1.0, 3.6], "rotation_deg": 20},
    {"kind": "chair", "position_m": [3.6, 3.4], "rotation_deg": 215},
    {"kind": "cylinder", "position_m": [3.9, 1.0, 0.5], "radius_m": 0.2, "height_m": 1.0},
    {"kind": "sphere", "position_m": [1.2, 1.0, 0.3], "radius_m": 0.3},
]
PEOPLE = [
    {"look": "red", "waypoints": [{"position_m": [1.2, 2.2]}, {"position_m": [3.2, 2.6]}], "speech_s": True},
    {"look": "plaid", "waypoints": [{"position_m": [3.0, 1.9]}, {"position_m": [1.9, 1.6]}]},
]
TIMES = np.array([0.35])


@pytest.fixture(scope="module")
def context():
    return render.open_context()


def scene_of(camera=SMALL_KB, people=PEOPLE, solids=FURNITURE, **more):
    return scenario.parse({"camera_config": camera, "people": people, "furniture": solids, **more})


def renderer_of(scene, context, **options):
    return render.Renderer(scene.config.camera, scene.config.room.dimensions, scene.solids, context=context, **options)


def depth_m(renderer):
    """Radial depth of the frame that was drawn last, unrounded: (height, width) float32 m, 0 none."""
    people_, room = (
        np.frombuffer(seen.read(), np.float32).reshape(seen.height, seen.width, 2)[..., 0]
        for seen in (renderer.people_seen, renderer.room_seen)
    )
    return np.where(people_ > 0, people_, room)


def rays_of(camera):
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = camera.lens.unproject(np.stack([u.ravel(), v.ravel()], -1))
    return rays @ camera.T_room_camera[:3, :3].T


def to_the_walls(scene):
    rays = rays_of(scene.config.camera)
    rays = np.where(np.abs(rays) < 1e-15, 1e-15, rays)
    eye, size = scene.config.camera.T_room_camera[:3, 3], scene.config.room.dimensions
    return np.where(rays > 0, (size - eye) / rays, -eye / rays).min(1)


@pytest.mark.parametrize("camera", [SMALL_KB, WIDE_KB, DIVISION, FOLDED], ids=["kb", "wide", "division", "folded"])
def test_depth_equals_a_ray_caster_on_the_same_bodies(camera, context):
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    scene = scene_of(camera)
    bodies = people.pose(scene.people, TIMES)
    renderer = renderer_of(scene, context)
    frame = renderer.draw(renderer.prepare(bodies), 0)
    depth = depth_m(renderer).ravel()
    room = mesh.room_triangles(scene.config.room.dimensions)
    solids, _ = mesh.solids_triangles(scene.solids, 192)
    persons, owner = mesh.bodies_triangles(bodies, 0, 48)
    triangles = np.concatenate([room, solids, persons])
    label = np.concatenate([np.zeros(len(room) + len(solids), int), bodies.person[owner] + 1])
    caster = RayMeshIntersector(trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=False))
    rays = rays_of(scene.config.camera)
    seen = np.isfinite(rays[:, 0])
    assert (depth[~seen] == 0).all()
    assert (frame.rgb.reshape(-1, 3)[~seen] == 0).all()
    eye = np.tile(scene.config.camera.T_room_camera[:3, 3], (seen.sum(), 1))
    hit, ray, at = caster.intersects_id(eye, rays[seen], multiple_hits=False, return_locations=True)
    truth, ids = np.zeros(seen.sum()), np.zeros(seen.sum(), int)
    truth[ray], ids[ray] = np.linalg.norm(at - eye[0], axis=1), label[hit]
    error = np.abs(depth[seen] - truth)
    # Where two surfaces meet in a pixel, an outline's 0.1 mm decides: look at pixels away from edges of the truth.
    image = np.zeros(depth.shape)
    image[seen] = truth
    image = image.reshape(frame.depth.shape)
    step = np.maximum(
        np.abs(np.diff(image, axis=0, append=image[-1:])), np.abs(np.diff(image, axis=1, append=image[:, -1:]))
    )
    near = np.zeros_like(step, bool)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            near |= np.roll(step > 0.03, (dy, dx), (0, 1))
    inner = ~near.ravel()[seen]
    assert np.median(error) < 1e-4
    assert np.quantile(error[inner], 0.999) < 2e-3
    assert (error[inner] > 0.02).mean() < 1e-4
    assert (frame.ids.ravel()[seen][inner] == ids[inner]).mean() > 0.9999
    assert {1, 2} <= set(np.unique(frame.ids))
    steps = frame.depth.ravel()[seen] * 1e-4
    assert np.abs(steps - depth[seen]).max() < 0.51e-4


def test_an_empty_room_is_exact(context):
    scene = scene_of(people=[], solids=[])
    renderer = renderer_of(scene, context)
    renderer.draw(renderer.prepare(people.pose([], TIMES)), 0)
    np.testing.assert_allclose(depth_m(renderer).ravel(), to_the_walls(scene), rtol=0, atol=5e-6)


def test_a_ball_has_the_outline_of_its_cone_of_rays(context):
    scene = scene_of(people=[], solids=[{"kind": "sphere", "position_m": [2.9, 2.1, 1.2], "radius_m": 0.25}])
    camera = scene.config.camera
    renderer = renderer_of(scene, context)
    renderer.draw(renderer.prepare(people.pose([], TIMES)), 0)
    rays = rays_of(camera)
    way = np.array([2.9, 2.1, 1.2]) - camera.T_room_camera[:3, 3]
    far = np.linalg.norm(way)
    inside = rays @ (way / far) > np.sqrt(1 - (0.25 / far) ** 2)
    assert inside.sum() > 1000
    assert ((depth_m(renderer).ravel() < to_the_walls(scene) - 1e-3) == inside).mean() > 0.9999


def test_visible_fraction_is_what_can_be_counted(context):
    table = {"kind": "table", "position_m": [2.5, 2.7], "size_m": [1.0, 0.5, 1.2]}
    people_near = [{"waypoints": [{"position_m": [2.4, 2.8]}]}, {"waypoints": [{"position_m": [2.8, 2.3]}]}]
    scene = scene_of({**SMALL_KB, "camera_position_m": [2.33, 2.33, 2.95]}, people_near, [table])
    bodies = people.pose(scene.people, TIMES)
    renderer = renderer_of(scene, context)
    frame = renderer.draw(renderer.prepare(bodies), 0)
    alone = []
    for number in range(2):
        one = dataclasses.replace(scene, people=(scene.people[number],))
        single = renderer_of(dataclasses.replace(one, solids=furniture.join([])), context)
        ids = single.draw(single.prepare(people.pose(one.people, TIMES)), 0).ids
        # Only people who are inside the image as a whole can be counted there.
        assert not ids[[0, -1]].any()
        assert not ids[:, [0, -1]].any()
        alone.append(int((ids == 1).sum()))
    assert any(annotations.visibility(frame, number)["visible_fraction"] < 0.9 for number in range(2))
    for number in range(2):
        said = annotations.visibility(frame, number)
        counted = (frame.ids == number + 1).sum() / alone[number]
        assert said["visible_fraction"] == pytest.approx(counted, abs=0.01)
        rows, columns = np.nonzero(frame.ids == number + 1)
        assert said["bbox_px"] == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]


def test_a_person_outside_the_image_is_not_seen(context):
    scene = scene_of({**DIVISION, "fx_px": 900.0, "fy_px": 900.0}, [{"waypoints": [{"position_m": [0.3, 0.3]}]}])
    bodies = people.pose(scene.people, TIMES)
    renderer = renderer_of(scene, context)
    frame = renderer.draw(renderer.prepare(bodies), 0)
    said = annotations.visibility(frame, 0)
    assert said["visible_fraction"] == 0
    assert "bbox_px" not in said


def test_a_person_at_the_border_is_partly_seen(context):
    scene = scene_of(SMALL_KB, [{"waypoints": [{"position_m": [2.33, 3.2]}]}], [])
    renderer = renderer_of(scene, context)
    frame = renderer.draw(renderer.prepare(people.pose(scene.people, TIMES)), 0)
    said = annotations.visibility(frame, 0)
    assert 0.05 < said["visible_fraction"] < 0.95
    assert said["bbox_full_px"][1] < 0
    assert said["bbox_px"][1] == 0


def test_frames_are_redrawn_without_a_trace_of_the_last(context):
    scene = scene_of()
    times = np.array([0.0, 0.4, 0.8])
    bodies = people.pose(scene.people, times)
    one, other = renderer_of(scene, context), renderer_of(scene, context)
    a, b = one.prepare(bodies), other.prepare(bodies)
    for index in range(3):
        drawn = one.draw(a, index)
    fresh = other.draw(b, 2)
    for name in ("rgb", "depth", "ids"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(fresh, name))


@pytest.mark.parametrize("size", [(1, 1), (64, 36), (333, 77)])
def test_odd_sizes(size, context):
    width, height = size
    f = 0.45 * width
    camera = {
        "fx_px": f,
        "fy_px": f,
        "cx_px": width / 2 - 0.5,
        "cy_px": height / 2 - 0.5,
        "lens_model": "kannala_brandt",
    }
    scene = scene_of({**camera, "image_width_px": width, "image_height_px": height})
    renderer = renderer_of(scene, context)
    frame = renderer.draw(renderer.prepare(people.pose(scene.people, TIMES)), 0)
    assert frame.rgb.shape == (height, width, 3)
    assert (frame.depth > 0).all()


def test_more_samples_change_colours_at_outlines_alone(context):
    scene = scene_of()
    bodies = people.pose(scene.people, TIMES)
    hard, soft = (renderer_of(scene, context, samples=s) for s in (1, 8))
    a, b = hard.draw(hard.prepare(bodies), 0), soft.draw(soft.prepare(bodies), 0)
    np.testing.assert_array_equal(a.depth, b.depth)
    np.testing.assert_array_equal(a.ids, b.ids)
    changed = (a.rgb != b.rgb).any(-1)
    assert 0.005 < changed.mean() < 0.2


def test_a_persons_depth_out_of_range_is_none(context):
    scene = scene_of(SMALL_KB, PEOPLE[:1], [])
    renderer = renderer_of(scene, context, depth_step=1e-5)
    frame = renderer.draw(renderer.prepare(people.pose(scene.people, TIMES)), 0)
    assert (frame.depth[depth_m(renderer) > 0.66] == 0).all()


def test_keypoints_lie_on_their_person(context):
    scene = scene_of()
    bodies = people.pose(scene.people, TIMES)
    renderer = renderer_of(scene, context)
    frame = renderer.draw(renderer.prepare(bodies), 0)
    record = annotations.truth(scene, bodies, 0, frame)
    for number, item in enumerate(record["objects"]):
        seen = [(x, y) for x, y, v in item["keypoints_px"] if v == 2]
        assert len(seen) >= 6
        for x, y in seen:
            assert frame.ids[round(y), round(x)] == number + 1
        assert np.hypot(*(np.subtract(item["mouth_position"], item["position"])[:2])) < 0.35


def test_camera_pose_is_used(context):
    tilted = {**SMALL_KB, "camera_position_m": [0.4, 0.5, 2.4], "camera_rotation_deg": [45.0, 45.0, 0.0]}
    scene = scene_of(tilted)
    bodies = people.pose(scene.people, TIMES)
    renderer = renderer_of(scene, context)
    frame = renderer.draw(renderer.prepare(bodies), 0)
    camera = scene.config.camera
    mouth = pose.apply(pose.inverse(camera.T_room_camera), bodies.mouths[0])
    for number, (x, y) in enumerate(camera.lens.project(mouth)):
        x0, y0, x1, y1 = annotations.visibility(frame, number)["bbox_full_px"]
        assert x0 - 2 <= x <= x1 + 2
        assert y0 - 2 <= y <= y1 + 2


def test_a_rendered_checkerboard_is_straight_through_the_inverse_lens(context):
    """What the thesis's first shader could not do: corners found in the picture lie on straight lines of rays."""
    import cv2

    columns, rows, square = 9, 7, 0.12
    board = [{"kind": "panel", "position_m": [2.33, 2.33, 1.0], "size_m": [1.5, 1.2, 0.02], "color": [1, 1, 1]}]
    for i in range(columns):
        for j in range(rows):
            if (i + j) % 2 == 0:
                x, y = 2.33 + (i - (columns - 1) / 2) * square, 2.33 + (j - (rows - 1) / 2) * square
                piece = {"kind": "panel", "position_m": [x, y, 1.0101], "size_m": [square, square, 1e-4]}
                board.append({**piece, "color": [0, 0, 0]})
    camera = {**scenario.CAMERAS["real"], "camera_position_m": [2.33, 2.0, 1.75], "camera_rotation_deg": [75, 0, 10]}
    scene = scene_of(camera, [], board)
    renderer = renderer_of(scene, context, samples=32)
    rgb = renderer.draw(renderer.prepare(people.pose([], TIMES)), 0).rgb
    grey = np.ascontiguousarray(rgb[..., 1])
    lens, T_camera_room = scene.config.camera.lens, pose.inverse(scene.config.camera.T_room_camera)
    grid = np.array(
        [
            [2.33 + (i - columns / 2) * square, 2.33 + (j - rows / 2) * square, 1.01015]
            for j in range(1, rows)
            for i in range(1, columns)
        ]
    )
    truth = lens.project(pose.apply(T_camera_room, grid))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    start = np.array(truth + 0.7, np.float32, order="C").reshape(-1, 1, 2)
    found = cv2.cornerSubPix(grey.copy(), start, (6, 6), (-1, -1), criteria)[:, 0].astype(float)
    assert np.abs(found - truth).max() < 0.25
    assert np.sqrt(np.mean((found - truth) ** 2)) < 0.05
    rays = lens.unproject(found).reshape(rows - 1, columns - 1, 3)
    flat = 862.5 * rays[..., :2] / rays[..., 2:]
    offsets = []
    for line in [*flat, *flat.transpose(1, 0, 2)]:
        centred = line - line.mean(0)
        offsets.append(centred @ np.linalg.svd(centred)[2][1])
    assert np.sqrt(np.mean(np.concatenate(offsets) ** 2)) < 0.05


def test_a_thin_edge_is_lit_alike_wherever_the_grid_of_the_light_falls(context):
    """The light is computed on every fourth pixel; the edges of these panels are 1 to 3 px thick."""
    places = [[2.3, 1.6, 0.8], [3.2, 3.2, 1.2], [1.4, 3.0, 0.5]]
    panels = [{"kind": "panel", "position_m": at, "rotation_deg": 3 * k} for k, at in enumerate(places)]

    def drawn(shift):
        camera = {**SMALL_KB, "cx_px": SMALL_KB["cx_px"] + shift[0], "cy_px": SMALL_KB["cy_px"] + shift[1]}
        renderer = renderer_of(scene_of(camera, [], panels), context)
        rgb = renderer.draw(renderer.prepare(people.pose([], TIMES)), 0).rgb
        return rgb[shift[1] : 260 + shift[1], shift[0] : 470 + shift[0]].astype(int)

    pictures = np.stack([drawn(shift) for shift in ((0, 0), (2, 2), (1, 3), (3, 1))])
    assert np.ptp(pictures, axis=0).max() < 20


@pytest.mark.parametrize("camera", [WIDE_KB, DIVISION], ids=["wide", "division"])
def test_no_part_of_a_cone_lies_outside_its_rectangle(camera, context):
    standing = [{"waypoints": [{"position_m": at}]} for at in ([2.0, 2.3], [3.1, 1.2])]
    scene = scene_of({**camera, "camera_position_m": [2.2, 1.8, 1.9]}, standing)
    renderer = renderer_of(scene, context)
    prepared = renderer.prepare(people.pose(scene.people, TIMES))
    renderer.draw(prepared, 0)
    seen = renderer.people_seen.read()
    width, height = renderer.canvas.size
    prepared._quads[np.isfinite(prepared._quads).all(-1)] = [0, 0, width, 0, 0, height]  # the whole picture
    renderer._find(prepared.instances(0), np.ones((-(-height // outlines.TILE), -(-width // outlines.TILE)), bool))
    assert renderer.people_seen.read() == seen
    assert np.frombuffer(seen, np.float32).any()


STANDING = [
    {"look": "red", "waypoints": [{"position_m": [1.6, 2.5]}]},
    {"look": "blue", "waypoints": [{"position_m": [2.9, 2.0]}]},
    {"look": "grey", "waypoints": [{"position_m": [3.4, 2.6]}, {"position_m": [1.0, 2.6], "speed_m_s": 1.5}]},
]


def test_what_is_drawn_in_part_is_what_is_drawn_whole(context):
    scene = scene_of(people=STANDING)
    bodies = people.pose(scene.people, np.arange(0.0, 2.2, 0.3))
    one, other = renderer_of(scene, context), renderer_of(scene, context)
    prepared = one.prepare(bodies, still_px=0.25)
    assert 0 < (np.diff(prepared.held, axis=0) == 0).mean() < 0.9  # some stand for a while
    for index in range(len(bodies.times)):
        part = one.draw(prepared, index)
        other.draw(other.prepare(people.pose([], TIMES)), 0)
        whole = other.draw(other.prepare(dataclasses.replace(bodies), still_px=0.25), index)
        for name in ("rgb", "depth", "ids"):
            np.testing.assert_array_equal(getattr(part, name), getattr(whole, name))
        for (mask, place), (same_mask, same_place) in zip(part.shapes, whole.shapes, strict=True):
            np.testing.assert_array_equal(mask, same_mask)
            assert place == same_place
    assert one.drawn_share < 0.8 * other.drawn_share


def test_a_pose_that_is_kept_is_nowhere_off_by_more_than_was_asked(context):
    scene = scene_of(people=STANDING[:2])
    bodies = people.pose(scene.people, np.arange(40) / 10)
    renderer = renderer_of(scene, context)
    exact, kept = renderer.prepare(bodies), renderer.prepare(bodies, still_px=0.25)
    assert (exact.held == np.arange(40)[:, None]).all()
    assert (np.diff(kept.held, axis=0) == 0).mean() > 0.3
    for index in (7, 23, 39):
        off = (exact._rectangles - kept._rectangles)[index]
        assert np.nanmax(np.abs(off)) < 0.5  # of places 0.25, and of the sizes of balls


def test_a_frame_in_which_nobody_moved_is_the_last_one(context):
    scene = scene_of(people=[])
    renderer = renderer_of(scene, context)
    first, second = (renderer.prepare(people.pose([], np.arange(count))) for count in (3.0, 2.0))
    assert renderer.draw(first, 2) is renderer.draw(second, 0)
    scene = scene_of(people=STANDING[:1])
    prepared = renderer.prepare(people.pose(scene.people, np.arange(3.0)), still_px=100.0)
    frame = renderer.draw(prepared, 0)
    assert renderer.draw(prepared, 2) is frame
    with pytest.raises(ValueError, match="read-only"):
        frame.rgb[0, 0] = 0


def test_depth_alone_is_the_depth_that_comes_with_colour(context):
    scene = scene_of()
    bodies = people.pose(scene.people, TIMES)
    both, alone = renderer_of(scene, context), renderer_of(scene, context, colour=False)
    one, other = (renderer.draw(renderer.prepare(bodies), 0) for renderer in (both, alone))
    assert other.rgb is None
    np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(one.ids, other.ids)


def test_a_graphics_card_is_tried_before_a_processor(monkeypatch):
    assert all(isinstance(software, bool) for software in devices.known())
    several = [True, False, False]
    assert devices.preferred(several) == [1, 2, 0]
    assert devices.preferred([]) == [None]
    monkeypatch.setenv(devices.ENVIRONMENT, "2")
    assert devices.preferred(several) == [2]
    monkeypatch.setenv(devices.ENVIRONMENT, "3")
    with pytest.raises(ValueError, match="no such device; EGL has 3 here, numbered from 0"):
        devices.preferred(several)


@pytest.mark.parametrize("posture", ["stand", "bend", "lean", "sit", "crouch"])
def test_no_shirt_is_seen_through_the_back_of_a_jacket(context, posture):
    look = {"shirt": [0.0, 0.9, 0.0], "jacket": [0.9, 0.0, 0.0], "trousers": [0.0, 0.0, 0.9], "hem": 0.4}
    place = {"position_m": [2.33, 3.2], "heading_deg": 90.0, "pose": posture, "t_s": 0.0, "stay_s": 1.0}
    scene = scene_of(people=[{"look": look, "waypoints": [place]}], solids=[])
    renderer = renderer_of(scene, context)
    frame = renderer.draw(renderer.prepare(people.pose(scene.people, TIMES)), 0)
    red, green, blue = frame.rgb[frame.ids == 1].astype(int).T
    assert (red > 2 * np.maximum(green, blue)).sum() > 300
    assert (green > 1.5 * np.maximum(red, blue)).sum() <= 3
