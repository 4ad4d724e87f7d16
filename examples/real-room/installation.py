"""A simulated installation for real-room.sh: scenarios of what a camera and microphones record while they are set up.

    python installation.py scenes FOLDER      the scenarios, room.json (measured with errors) and truth.json
    python installation.py film DIR FILE      the colour frames of an experiment directory as a film

Stands in for hardware. The true places of the microphones differ from the measured ones by 3 cm, and nobody knows the
camera's lens and pose: real-room.sh has to find them.
"""

import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "calibrate"))
import board_scenes

from avcli.scene.scenario import CAMERAS

SIZE = [5.6, 4.6, 2.9]
PLACE, ROTATION = [2.86, 2.21, 2.72], [89.2, 0.7, 2.0]
FLOOR_BOARD = (2.6, 2.5, 30.0)
"""Where the board lies on the floor: x and y of its middle in m, direction of its rows in degrees."""
MICROPHONES = [
    [0.1, 0.1, 2.4], [2.8, 0.1, 2.2], [5.5, 0.1, 2.4], [5.5, 2.3, 2.2],
    [5.5, 4.5, 2.4], [2.8, 4.5, 2.2], [0.1, 4.5, 2.4], [0.1, 2.3, 2.2],
]  # fmt: skip
TAPE_SD_M = 0.03


def person(number, look, points, speech):
    """Somebody who walks from point to point and speaks in the given intervals."""
    first, *others = points
    steps = [{"position_m": list(first)}, *({"position_m": list(p), "speed_m_s": 0.8} for p in others)]
    return {"object_id": number, "look": look, "waypoints": steps, "speech_s": speech}


def scene(name, seconds, people=(), furniture=()):
    """A scenario in the room under the true camera."""
    camera = {**CAMERAS["real"], "camera_position_m": PLACE, "camera_rotation_deg": ROTATION, "frame_rate_hz": 10}
    return {
        "name": name,
        "duration_s": seconds,
        "camera_config": camera,
        "microphone_config": {"mic_positions_m": MICROPHONES},
        "room_config": {"room_dimensions_m": SIZE, "reverberation_time_s": 0.3},
        "furniture": list(furniture),
        "people": list(people),
    }


def lying_board():
    """The printed board on the floor, turned."""
    x, y, turn = FLOOR_BOARD
    angle = np.deg2rad(turn)
    rotate = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    panels = []
    for panel in board_scenes.board():
        place = np.array(panel["position_m"])
        across = rotate @ (place[:2] - board_scenes.MIDDLE[:2]) + [x, y]
        panels.append({**panel, "position_m": [*across.tolist(), place[2]], "rotation_deg": turn})
    return panels


def scenes(folder):
    """Write the scenarios, what was measured, and what is true."""
    folder = Path(folder)
    board_scenes.main(folder / "boards", "16")
    around = [(0.9, 0.9), (4.7, 0.9), (4.7, 3.7), (0.9, 3.7), (0.9, 2.3), (4.7, 2.3)]
    meeting = [
        person(0, "red", [(0.8, 1.0), (4.6, 1.0), (4.6, 3.4), (2.4, 3.6)], [[0.3, 2.9], [8.4, 10.0]]),
        person(1, "white", [(4.8, 3.7), (1.2, 3.7), (1.0, 1.6), (3.2, 1.7)], [[3.2, 5.4]]),
        person(2, "blue", [(2.8, 2.4), (0.8, 2.7), (1.4, 0.8), (4.4, 2.6)], [[5.7, 8.1]]),
    ]
    written = {
        "floor": scene("floor", 0.0, furniture=lying_board()),
        "empty": scene("empty", 0.7),
        "walk": scene("walk", 15.0, [person(0, "plaid", around, [[0.0, 15.0]])]),
        "meeting": scene("meeting", 10.0, meeting),
    }
    for name, content in written.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    errors = np.random.default_rng(1).normal(0, TAPE_SD_M, (len(MICROPHONES), 3))
    measured = (np.array(MICROPHONES) + errors).clip(0.01, np.array(SIZE) - 0.01).round(3).tolist()
    room = {"room_config": {"room_dimensions_m": SIZE}, "microphone_config": {"mic_positions_m": measured}}
    (folder / "room.json").write_text(json.dumps(room))
    (folder / "truth.json").write_text(json.dumps({"camera": written["walk"]["camera_config"], "mics": MICROPHONES}))


def film(directory, path):
    """Write the frames of an experiment as a film, as a camera's program does."""
    import cv2

    frames = sorted(Path(directory, "video/rgb").glob("RGB_frame_*.png"), key=lambda p: float(p.stem.split("_")[-1]))
    writer = None
    for frame in frames:
        image = cv2.imread(str(frame))
        if writer is None:
            writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10, (image.shape[1], image.shape[0]))
        writer.write(image)
    writer.release()


if __name__ == "__main__":
    {"scenes": scenes, "film": film}[sys.argv[1]](*sys.argv[2:])
