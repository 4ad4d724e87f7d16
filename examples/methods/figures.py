"""Draw the figures of these pages with the library, as SVG.

python figures.py FOLDER
"""

import math
import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Ellipse

import avcli
from avcli import pose
from avcli.acoustics import decay, images
from avcli.acoustics.settings import Settings
from avcli.formats.records import Detections, Identified
from avcli.localization import correlation

BLUE, ORANGE, PINK, GREY = "#3366cc", "#cc7a00", "#c2256b", "#777777"


def hota() -> None:
    """HOTA for a constant error, and for two people whose identities are exchanged at some moment."""
    left, right = plt.subplots(1, 2, figsize=(8, 2.8))[1]
    times = np.arange(40) / 10

    def score(offset: float, exchanged_at: float) -> float:
        truth, tracks = [], []
        for t in times:
            places = np.array([[1 + t, 1.0, 0.0], [1 + t, 5.0, 0.0]])
            truth.append(Identified(t, np.array([0, 1]), places))
            ids = np.array([0, 1]) if t < exchanged_at else np.array([1, 0])
            tracks.append(Identified(t, ids, places + np.array([0, offset, 0])))
        return 100 * (avcli.score(truth, tracks)["HOTA"] or 0.0)

    offsets = np.arange(0, 2.01, 0.05)
    left.plot(offsets, [score(offset, math.inf) for offset in offsets], color=BLUE)
    left.set(xlabel="error, m", ylabel="HOTA", ylim=(0, 102))
    moments = np.arange(0, 4.01, 0.2)
    right.plot(moments, [score(0, moment) for moment in moments], color=PINK)
    right.set(xlabel="moment of the exchange, s", ylim=(0, 102))


def tracking() -> None:
    """A person who is detected until 2 s and hidden after that: 95 % ellipses and existence."""
    left, right = plt.subplots(1, 2, figsize=(8, 2.8))[1]
    rng = np.random.default_rng(1)
    covariance = np.diag([0.01, 0.01, 1.0])[None]
    way = np.array([[0.6 + 0.1 * k, 2.0 + 0.03 * k, 0.0] for k in range(41)])
    found = []
    for k, place in enumerate(way):
        places = place[None] + rng.normal(0, 0.07, (1, 3)) if k <= 20 else np.empty((0, 3))
        n = len(places)
        found.append(Detections(k / 10, "camera", places, covariance[:n], np.full(n, 0.9), "camera"))
    config = avcli.simulate("s1", duration=0, video=False).config
    tracks = [moment for moment in avcli.track(config, found) if len(moment.ids)]
    left.plot(way[:, 0], way[:, 1], color=GREY, lw=1, label="the true way")
    seen = np.array([one.positions[0] for one in found if len(one.positions)])
    left.plot(seen[:, 0], seen[:, 1], "+", color=ORANGE, label="detections")
    for moment in tracks[::4]:
        values, vectors = np.linalg.eigh(moment.covariances[0][:2, :2])
        width, height = 2 * np.sqrt(5.991 * values)
        angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
        left.add_patch(Ellipse(moment.positions[0][:2], width, height, angle=angle, fill=False, color=BLUE, lw=0.8))
    left.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    left.legend(frameon=False, fontsize=8, loc="upper left")
    right.plot([moment.timestamp for moment in tracks], [moment.existence[0] for moment in tracks], color=BLUE)
    right.axvline(2.0, color=GREY, lw=0.8, ls=":")
    right.set(xlabel="time, s", ylabel="existence", ylim=(0, 1.02))


def lens() -> None:
    """Image radius against the angle from the axis, and how the room's floor falls on the picture."""
    left, right = plt.subplots(1, 2, figsize=(8, 3.2))[1]
    angles = np.radians(np.arange(0, 89.5, 0.5))
    rays = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=1)
    camera = avcli.simulate("s1", duration=0, video=False).config.camera
    radius = camera.lens.project(rays)[:, 0] - camera.lens.cx
    left.plot(np.degrees(angles), radius, color=BLUE, label="fisheye (Kannala-Brandt)")
    pinhole = camera.lens.fx * np.tan(angles)
    left.plot(np.degrees(angles), pinhole, color=ORANGE, label="pinhole")
    left.set(xlabel="angle from the axis, degrees", ylabel="distance from the middle, px", ylim=(0, 1500))
    left.legend(frameon=False, fontsize=8, loc="upper left")
    T_camera_room = pose.inverse(camera.T_room_camera)
    line = np.linspace(0, 4.66, 200)
    for c in np.arange(0, 4.67, 0.466):
        for x, y in ((line, np.full_like(line, c)), (np.full_like(line, c), line)):
            points = np.stack([x, y, np.zeros_like(x)], axis=1)
            pixels = camera.lens.project(pose.apply(T_camera_room, points))
            right.plot(pixels[:, 0], pixels[:, 1], color=GREY, lw=0.7)
    for x, y in ((1.0, 2.33), (2.33, 2.33), (3.9, 3.9)):
        body = np.stack([np.full(20, x), np.full(20, y), np.linspace(0, 1.75, 20)], axis=1)
        pixels = camera.lens.project(pose.apply(T_camera_room, body))
        right.plot(pixels[:, 0], pixels[:, 1], color=PINK, lw=3, solid_capstyle="round")
    right.set(xlim=(0, 1920), ylim=(1080, 0), aspect="equal", xlabel="px", ylabel="px")


def sound() -> None:
    """An impulse response of a room, and how its energy dies away."""
    left, right = plt.subplots(1, 2, figsize=(8, 2.8))[1]
    room, source, microphone, rate = [4.66, 4.66, 2.6], [1.5, 2.3, 1.6], [4.4, 4.4, 2.4], 44100
    for rt60, colour in ((0.2, ORANGE), (0.35, BLUE), (0.6, PINK)):
        reflection = np.sqrt(1 - decay.image_absorption(room, rt60))
        response = images.shoebox_rir(room, source, microphone, reflection, rate, int(rt60 * rate))[0]
        times = np.arange(len(response)) / rate
        energy = np.cumsum(response[::-1] ** 2)[::-1]
        level = 10 * np.log10(np.maximum(energy / energy[0], 1e-12))
        right.plot(times[level > -58], level[level > -58], color=colour, label=f"T60 {rt60} s")
        if rt60 == 0.35:
            left.plot(1000 * times[: rate // 20], response[: rate // 20], color=BLUE, lw=0.8)
    left.set(xlabel="time, ms", ylabel="pressure")
    right.set(xlabel="time, s", ylabel="energy still to come, dB")
    right.legend(frameon=False, fontsize=8)


def localization() -> None:
    """The correlation of two microphones, and the mean over all pairs at every place of the room."""
    left, right = plt.subplots(1, 2, figsize=(8, 3.2))[1]
    stays = {"position_m": [1.2, 2.9], "heading_deg": 0, "stay_s": 1}
    scene = avcli.simulate({"duration_s": 1, "people": [{"waypoints": [stays], "speech_s": [[0, 1]]}]}, video=False)
    dry = Settings(rt60_s=0.1)
    sound, array = avcli.hear(scene.config, scene.truth, settings=dry), scene.config.microphones.positions
    rate, size, speed = sound.sample_rate_hz, 16384, 343.0
    mouth = scene.truth[3].mouths[0]
    start = round((scene.truth[3].timestamp + np.linalg.norm(array - mouth, axis=1).mean() / speed) * rate) - size // 2
    spectra = np.fft.rfft(sound.samples[start : start + size].T * correlation.hann(size))
    bins = slice(round(300 * size / rate), round(6000 * size / rate))
    whitened = correlation.whiten(spectra[:, bins], 1.0)
    half = 700
    gcc = correlation.gcc(whitened, bins, size, half)
    first, second = correlation.pairs(len(array))
    pair = 2
    left.plot(1000 * np.arange(-half, half + 1) / rate, gcc[pair], color=BLUE, lw=0.8)
    delay = (np.linalg.norm(mouth - array[first[pair]]) - np.linalg.norm(mouth - array[second[pair]])) / speed
    left.axvline(1000 * delay, color=PINK, lw=0.8, ls="--")
    left.set(xlim=(-8, 8), xlabel="delay, ms", ylabel="correlation of two microphones")
    x, y = np.meshgrid(np.arange(0.05, 4.66, 0.03), np.arange(0.05, 4.66, 0.03))
    places = np.stack([x, y, np.full_like(x, mouth[2])], axis=-1)
    distances = np.linalg.norm(places[..., None, :] - array, axis=-1)
    lags = np.rint((distances[..., first] - distances[..., second]) / speed * rate).astype(int)
    power = gcc[np.arange(len(first)), np.clip(lags + half, 0, 2 * half)].mean(axis=-1)
    right.pcolormesh(x, y, power, cmap="Blues", vmin=0, vmax=power.max() / 3, rasterized=True)
    right.plot(*array[:, :2].T, "^", color=ORANGE, clip_on=False)
    right.plot(*mouth[:2], "x", color=PINK)
    right.set(xlabel="x, m", ylabel="y, m", aspect="equal")


def detection() -> None:
    """A picture of the ceiling camera, with the boxes of the detector and the places on the floor that follow."""
    left, right = plt.subplots(1, 2, figsize=(8, 2.9), width_ratios=(1.7, 1))[1]
    scene = avcli.simulate("s3", duration=1.0)
    shots = list(scene.shots())[-1:]
    left.imshow(shots[0].rgb[::2, ::2], extent=(0, 1920, 1080, 0))
    left.set_axis_off()
    for monocular, colour in ((False, BLUE), (True, ORANGE)):
        options = {"monocular": True} if monocular else {"background": scene.background}
        found = next(iter(avcli.detect(scene.config, shots, **options)))
        for place, covariance, box in zip(found.positions, found.covariances, found.boxes_px, strict=True):
            if not monocular:
                left.add_patch(plt.Rectangle(box[:2], *(box[2:] - box[:2]), fill=False, color="white", lw=1.2))
            values, vectors = np.linalg.eigh(covariance[:2, :2])
            angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
            ellipse = Ellipse(place[:2], *(2 * np.sqrt(5.991 * values)), angle=angle, fill=False, color=colour)
            right.add_patch(ellipse)
    right.plot(*scene.truth[-1].positions[:, :2].T, "x", color=PINK)
    right.set(xlim=(0, 4.66), ylim=(0, 4.66), aspect="equal", xlabel="x, m", ylabel="y, m")


FIGURES = (hota, tracking, lens, sound, localization, detection)


def main() -> None:
    """Write one SVG for each figure."""
    matplotlib.use("svg")
    plt.rcParams.update({"svg.hashsalt": "avcli", "axes.spines.top": False, "axes.spines.right": False, "font.size": 9})
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for figure in FIGURES:
        figure()
        plt.tight_layout()
        plt.savefig(folder / f"{figure.__name__}.svg", metadata={"Date": None})
        plt.close("all")


if __name__ == "__main__":
    main()
