"""Rooms of materials: what is painted, lit and fitted, and that it changes nothing where it is not stated."""

import json

import numpy as np
import pytest
from conftest import ROOT

from avcli import materials
from avcli.scene import fittings, furniture, interior, look_shaders, people, render, scenario

WIDE = json.loads((ROOT / "examples" / "scenarios" / "wide-lens.json").read_text())
SIZE = 96
CAMERA = WIDE["camera_config"] | {
    "fx_px": 28.0, "fy_px": 28.0, "cx_px": 47.5, "cy_px": 47.5, "image_width_px": SIZE, "image_height_px": SIZE,
}  # fmt: skip


@pytest.fixture(scope="module")
def context():
    return render.open_context()


def scene(furniture=(), **room):
    return scenario.parse({"camera_config": CAMERA, "room_config": room, "furniture": list(furniture), "people": []})


def renderer(context, made):
    dressed = interior.interior(made.config.room, made.solids)
    return render.Renderer(
        made.config.camera, made.config.room.dimensions, made.solids, samples=1, context=context, dressed=dressed
    )


def picture(context, made):
    drawn = renderer(context, made)
    return drawn.draw(drawn.prepare(people.pose([], np.zeros(1))), 0)


def test_a_plain_room_is_not_dressed():
    made = scene([{"kind": "table", "position_m": [1, 1]}, {"kind": "chair", "position_m": [2, 2]}])
    assert interior.interior(made.config.room, made.solids) is None
    assert len(fittings.solids(made.config.room)) == 0


def test_every_pattern_is_painted_and_differs_from_the_plain_room(context):
    known = {material.look.pattern: name for name, material in materials.table().items()}
    assert set(look_shaders.PATTERNS) <= set(known)
    plain = picture(context, scene()).rgb.astype(float)
    boxes = [
        {"kind": "box", "position_m": [0.5 + 0.6 * (k % 7), 0.6 + 0.7 * (k // 7), 0.2], "size_m": [0.4, 0.5, 0.4],
         "material": known[pattern]}
        for k, pattern in enumerate(look_shaders.PATTERNS)
    ]  # fmt: skip
    made = scene(boxes, surfaces={"floor": "carpet", "walls": "brick", "ceiling": "acoustic_tile"})
    first = picture(context, made)
    assert (np.abs(first.rgb - plain).max(-1) > 10).mean() > 0.8
    assert (first.rgb.max(-1) > 0).all()
    assert first.rgb.tobytes() == picture(context, made).rgb.tobytes(), "the same bytes again"


def test_a_material_has_the_colour_that_it_states(context):
    def floor(color):
        made = scene(surfaces={"floor": {"material": "linoleum", "color": color}})
        return picture(context, made).rgb[40:56, 40:56].reshape(-1, 3).mean(0)

    red, blue = floor([0.8, 0.1, 0.1]), floor([0.1, 0.1, 0.8])
    assert red[0] > 1.7 * red[2]
    assert blue[2] > 1.7 * blue[0]


def test_windows_are_bright_and_light_the_floor_before_them(context):
    window = {"wall": "x0", "at_m": 2.33, "width_m": 2.0}
    room = {"surfaces": {"floor": "linoleum"}, "windows": [window], "lights": []}
    day = picture(context, scene(**room))
    assert (day.rgb[38:58, :24].min(-1) >= 240).any(), "what is outside is brighter than the picture holds"
    floor = day.rgb[47, 30:66].astype(float).mean(-1)
    assert floor[:8].mean() > 1.1 * floor[-8:].mean()
    sun = picture(context, scene(**room, sun_deg=[180, 40])).rgb.astype(float)
    assert sun[47, 30:66].max() > 1.2 * floor.max()
    night = picture(context, scene(**room, daylight=0)).rgb
    assert night.max() < day.rgb.max()


def test_furniture_shades_the_light_in_the_air(context):
    lamp = [{"position_m": [2.33, 2.33], "size_m": [0.3, 0.3]}]
    roof = {"kind": "box", "position_m": [2.33, 2.33, 2.0], "size_m": [2.0, 2.0, 0.05]}

    def below(pieces):
        made = scene(pieces, surfaces={"floor": "linoleum"}, lights=lamp)
        drawn = renderer(context, made)
        nx, ny, nz = (int(n) for n in drawn._dressed.cells)
        cells = np.frombuffer(drawn._probes.read(), np.float32).reshape(6, nz, ny, nx, 4)
        return cells[4, nz // 4, ny // 2, nx // 2, 0]  # light that falls on what faces up

    assert below([roof]) < 0.05 * below([])


def test_doors_windows_lamps_and_skirting_are_solids_inside_the_room():
    made = scene(
        doors=[{"wall": "y0", "at_m": 2.0}], windows=[{"wall": "x1", "at_m": 2.0}], skirting_m=0.1,
        lights=[{"position_m": [1, 1]}, {"position_m": [3, 3], "shape": "disc", "height_m": 2.5}],
    )  # fmt: skip
    solids = fittings.solids(made.config.room)
    names = [furniture.MATERIALS[number] for number in solids.material]
    assert {"door", "window", "lamp", "steel", "paint"} == set(names)
    corners = np.abs(solids.axes.transpose(0, 2, 1)) @ solids.half[..., None]
    low, high = solids.centre - corners[..., 0], solids.centre + corners[..., 0]
    assert (low > -1e-9).all()
    assert (high < made.config.room.dimensions + 1e-9).all()
    assert np.allclose(np.linalg.det(solids.axes), 1)
    assert len(made.solids) == len(solids)
    boards = [k for k, name in enumerate(names) if name == "paint" and np.isclose(high[k, 2], 0.1)]
    assert len(boards) == 5, "the wall with the door has two"


def test_a_camera_that_adapts_sees_dim_and_bright_rooms_alike(context):
    def mean(strength):
        lights = [{"position_m": [x, 2.3], "strength": strength} for x in (1.5, 3.2)]
        return picture(context, scene(surfaces={"floor": "linoleum"}, lights=lights)).rgb.mean()

    assert 0.5 < mean(0.2) / mean(5.0) < 1.0
