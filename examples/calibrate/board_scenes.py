"""Write scenarios in which a camera of known lens looks at a checkerboard from many sides.

    python board_scenes.py FOLDER [VIEWS] [LENS.json]

Stands in for a real camera: `loop.sh` renders the scenarios with avsim-scene and calibrates from the pictures. What
moves is the camera, which to the pictures is the same as a board that moves. The board has 7 × 10 squares of 95 mm and
is made of thin panels on the floor of the room.
"""

import json
import sys
from pathlib import Path

import numpy as np

from avcli import pose
from avcli.formats.experiment import lens_from_config
from avcli.scene.scenario import CAMERAS

COLUMNS, ROWS, SQUARE = 7, 10, 0.095
MIDDLE = np.array([2.33, 2.33, 0.02])


def board():
    """The board's panels: a white sheet, and the black squares a tenth of a millimetre above it."""
    sheet = [(COLUMNS + 2) * SQUARE, (ROWS + 2) * SQUARE, 0.01]
    below = (MIDDLE - np.array([0, 0, 0.01])).tolist()
    panels = [{"kind": "panel", "position_m": below, "size_m": sheet, "color": [0.9] * 3}]
    for row in range(ROWS):
        for column in range(COLUMNS):
            if (row + column) % 2 == 0:
                x, y = (column + 0.5 - COLUMNS / 2) * SQUARE, -(row + 0.5 - ROWS / 2) * SQUARE
                panels.append(
                    {
                        "kind": "panel",
                        "position_m": (MIDDLE + np.array([x, y, -0.0049])).tolist(),
                        "size_m": [SQUARE, SQUARE, 0.01],
                        "color": [0.05] * 3,
                    }
                )
    return panels


def viewpoint(lens, size, rng):
    """A camera's pose from which the whole board is in the picture, its middle at a random pixel."""
    reach = np.array([COLUMNS + 1, ROWS + 1]) / 2 * SQUARE
    rim = np.array([[sx * reach[0], sy * reach[1], 0] for sx in (-1, 0, 1) for sy in (-1, 0, 1)]) + MIDDLE
    while True:
        ray = lens.unproject(rng.uniform([0, 0], size)[None])[0]
        if not np.isfinite(ray).all():
            continue
        # Above the board by 0.4 to 1 m, to the side by up to as much; turned so that the board is seen along the ray.
        place = MIDDLE + rng.uniform(0.4, 1.0) * np.array([*rng.uniform(-0.7, 0.7, 2), 1.0])
        forward = (MIDDLE - place) / np.linalg.norm(MIDDLE - place)
        turn = _turn_to(ray, forward) @ _about(ray, rng.uniform(0, 2 * np.pi))
        T = pose.transform(turn, place)
        seen = lens.project(pose.apply(pose.inverse(T), rim))
        if np.isfinite(seen).all() and (seen > 5).all() and (seen < np.array(size) - 6).all():
            return T


def _turn_to(one, other):
    """A rotation that takes one unit vector to the other."""
    v, c = np.cross(one, other), one @ other
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + K + K @ K / (1 + c + 1e-12)


def _about(axis, angle):
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def main(folder, views="20", camera=None):
    """Write one scenario a view."""
    known = json.loads(Path(camera).read_text()) if camera else CAMERAS["real"]
    size = known["image_width_px"], known["image_height_px"]
    lens = lens_from_config(known, width_px=size[0], height_px=size[1])
    rng = np.random.default_rng(0)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(int(views)):
        T = viewpoint(lens, size, rng)
        scene = {
            "name": f"view_{number:02d}",
            "duration_s": 0.0,
            "camera_config": {
                **known,
                "camera_position_m": T[:3, 3].tolist(),
                "camera_rotation_deg": pose.camera_rotation_deg(T).tolist(),
                "frame_rate_hz": 10,
            },
            "microphone_config": {"mic_positions_m": [{"object_id": 1, "position": [0.1, 0.1, 2.4]}]},
            "room_config": {"room_dimensions_m": [4.66, 4.66, 3.0]},
            "furniture": board(),
            "people": [],
        }
        (folder / f"view_{number:02d}.json").write_text(json.dumps(scene))


if __name__ == "__main__":
    main(*sys.argv[1:])
