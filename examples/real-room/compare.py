"""Compare the config.json that real-room.sh found with the true installation of simulate.sh.

python compare.py LAB/config.json RECORDED/truth.json
"""

import json
import sys
from pathlib import Path

import numpy as np

from avcli import pose
from avcli.formats.experiment import Config, read_config


def main(found_path, truth_path):
    """Print how far lens, pose and microphones are from the truth."""
    found = read_config(found_path)
    known = json.loads(Path(truth_path).read_bytes())
    true = Config({"camera_config": known["camera"]}).camera
    rng = np.random.default_rng(0)
    angles, turns = rng.uniform(0, min(found.camera.theta_trusted, 1.2), 2000), rng.uniform(0, 2 * np.pi, 2000)
    rays = np.stack([np.sin(angles) * np.cos(turns), np.sin(angles) * np.sin(turns), np.cos(angles)], axis=1)
    error = np.linalg.norm(found.camera.lens.project(rays) - true.lens.project(rays), axis=1)
    print(f"lens: {error.mean():.2f} px mean error, {error.max():.2f} px at most")
    shift = np.linalg.norm(found.camera.T_room_camera[:3, 3] - true.T_room_camera[:3, 3])
    turn = (pose.inverse(true.T_room_camera) @ found.camera.T_room_camera)[:3, :3]
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    print(f"pose: {1000 * shift:.1f} mm, {angle:.3f} degrees")
    away = np.linalg.norm(found.microphones.positions - np.array(known["mics"]), axis=1)
    print(
        f"microphones: {1000 * np.sqrt((away**2).mean()):.0f} mm root mean square, {1000 * away.max():.0f} mm at most"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
