"""Statistics of the pictures of each sensor preset beside those of real pictures from the ceiling.

    python tests/bench/bench_sensor.py --real DECIDING JUDGING... --out bench-out

Each folder of real pictures is one row. The presets of `avcli.scene.settings.SENSORS` were chosen on the first one,
`train/images` of the branch Dataset_Section_1 of github.com/BenoitFaureIMT/CERIS_FishEye, and are judged on another,
`valid/images` of its branch Mirror_World. They state no licence: pictures are read and measured, nothing else.

All are medians over pictures of 640 px height, inside what the lens lights. Detail: standard deviation of the
brightness less its blur of 2 px. Saturation: mean of HSV's, of 255. Red/blue: of the mean light. Noise:
J. Immerkaer, "Fast noise variance estimation" (1996), in the flattest fifth of blocks of 16 px. Blocks: difference of
columns at the edges of JPEG's blocks over the usual one. Clipped: percent of pixels at 250 or more. Edges: 99th
percentile of the gradient.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from avcli.scene import film, sensor
from avcli.scene.settings import SENSORS, Drawing, Effects, with_sensor

HEIGHT = 640
NAMES = ("detail", "saturation", "red/blue", "noise", "blocks", "clipped %", "edges")


def statistics(rgb: np.ndarray) -> list[float] | None:
    """The numbers of `NAMES` of a picture (height, width, 3) uint8; None where it is too dark to measure."""
    light = rgb.astype(np.float32)
    y = light @ np.array([0.299, 0.587, 0.114], np.float32)
    lit = (cv2.GaussianBlur(light.max(-1), (0, 0), 3) > 28).astype(np.uint8)
    closed = cv2.morphologyEx(lit, cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8))
    core = cv2.erode(closed, np.ones((21, 21), np.uint8)) > 0
    if core.mean() < 0.2:
        return None
    detail = (y - cv2.GaussianBlur(y, (0, 0), 2))[core].std()
    most, least = light.max(-1), light.min(-1)
    saturation = (255 * (most - least) / np.maximum(most, 1))[core].mean()
    red, _, blue = ((light[core] / 255) ** 2).mean(0)
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    rough = np.abs(cv2.filter2D(y, -1, mask)) * np.float32(np.sqrt(np.pi / 2) / 6)
    rows, columns = y.shape[0] // 16, y.shape[1] // 16

    def blocks(picture: np.ndarray) -> np.ndarray:
        return picture[: 16 * rows, : 16 * columns].reshape(rows, 16, columns, 16)

    noise = np.quantile(blocks(rough).mean((1, 3))[blocks(core).all((1, 3))], 0.2)
    column = np.abs(np.diff(y, axis=1)).mean(0)
    phases = [column[k::8].mean() for k in range(8)]
    edges = np.hypot(cv2.Sobel(y, -1, 1, 0), cv2.Sobel(y, -1, 0, 1))[core] / 8
    clipped = 100 * (y[core] >= 250).mean()
    block = max(phases) / np.median(phases)
    return [float(v) for v in (detail, saturation, red / blue, noise, block, clipped, np.quantile(edges, 0.99))]


def real_pictures(folder: Path, count: int) -> list[np.ndarray]:
    """Up to so many pictures of a folder, spread over it."""
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    chosen = [paths[k] for k in np.linspace(0, len(paths) - 1, min(count, len(paths))).astype(int)]
    read = [cv2.imread(str(path)) for path in chosen]
    return [picture[..., ::-1] for picture in read if picture is not None]


def drawn_pictures(worlds: int) -> list[np.ndarray]:
    """A clean picture of each of some random worlds, `HEIGHT` px high."""
    pictures = []
    for seed in range(worlds):
        scene = film.simulate("random", seed=seed, people=4, duration=0.0, sensor_name="clean")
        (frame,) = scene.frames()
        assert frame.rgb is not None  # it was asked for
        scale = HEIGHT / frame.rgb.shape[0]
        small = cv2.resize(frame.rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        pictures.append(np.ascontiguousarray(small))
    return pictures


def main() -> None:
    """Measure, print, and write the table sensor.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="folders; the first one decided the presets")
    parser.add_argument("--count", type=int, default=60, help="pictures of a folder")
    parser.add_argument("--worlds", type=int, default=12, help="random worlds that are drawn")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = {
        f"{folder.name} ({'judging' if index else 'deciding'})": real_pictures(folder, options.count)
        for index, folder in enumerate(options.real)
    }
    clean = drawn_pictures(options.worlds)
    for name in SENSORS:
        effects = with_sensor(name, Drawing(), Effects())[1]
        rows[f"--sensor {name}"] = [
            sensor.expose(picture, effects, (picture.shape[1] / 2, HEIGHT / 2), np.random.default_rng(seed))
            for seed, picture in enumerate(clean)
        ]
    lines = [f"| pictures | {' | '.join(NAMES)} |", "|---" + "|---:" * len(NAMES) + "|"]
    for name, pictures in rows.items():
        measured = [numbers for picture in pictures if (numbers := statistics(picture))]
        lines.append(f"| {name} | " + " | ".join(f"{v:.2f}" for v in np.median(measured, axis=0)) + " |")
    table = "\n".join(["# Pictures of the sensor presets beside real ones", "", *lines, ""])
    print(table)
    (options.out / "sensor.md").write_text(table)


if __name__ == "__main__":
    main()
