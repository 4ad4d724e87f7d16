"""Runs a scene of the bench through avfuse's trackers, or through the filter that knows the true associations."""

import math
import re
import time
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from tracking_scenes import KIND, Scene

from avcli.formats.records import Detections
from avcli.tracking import gaussian
from avcli.tracking.fusion import Fusion
from avcli.tracking.merging import Record
from avcli.tracking.model import Population
from avcli.tracking.motion import WALKING
from avcli.tracking.settings import Settings, sensor


@dataclass(frozen=True)
class Frame:
    """What a tracker reports at one time.

    Attributes:
        ids: n numbers of people.
        xy: (n, 2) m.
        existence: (n,) probabilities.
    """

    ids: list[int]
    xy: np.ndarray
    existence: np.ndarray


@dataclass(frozen=True)
class Variant:
    """A way to run avfuse: a tracker, its lag and its settings."""

    tracker: str = "ms-glmb"
    lag: float = 0.0
    settings: Settings = field(default_factory=Settings)

    @classmethod
    def of(cls, words: list[str]) -> "Variant":
        """Read words as `no-hidden`, `stay=20`, `tracker=gnn`, `lag=inf`; names are those of `Settings`.

        Raises:
            ValueError: a word is not understood.
        """
        known = {one.name: one for one in fields(Settings)}
        given: dict[str, Any] = {}
        for word in words:
            name, _, value = word.partition("=")
            off = name.startswith("no-") and name.removeprefix("no-").replace("-", "_") in known
            name = (name.removeprefix("no-") if off else name).replace("-", "_")
            if name in ("tracker", "lag"):
                given[name] = value if name == "tracker" else float(value)
            elif name not in known:
                raise ValueError(f"--set {word}: settings are {', '.join(known)}, tracker and lag")
            elif not value:
                given[name] = not off
            else:
                given[name] = float(value) if re.fullmatch(r"-?[\d.]+(e-?\d+)?|inf", value) else value
                if isinstance(known[name].default, int):
                    given[name] = int(value)
        chosen = {name: given.pop(name) for name in ("tracker", "lag") if name in given}
        return cls(**chosen, settings=replace(Settings(), **given))


def detections(scene: Scene) -> list[Record]:
    """What the sensors of a scene found, as `Fusion.step` takes it."""
    if scene.ready is not None:
        return scene.ready
    records = []
    for k, (t, name, z, sigma, _) in enumerate(scene.records):
        n, floor, told = len(z), sensor(name, KIND[name]).floor, scene.told.get(name, 1.0)
        covariances = np.full((n, 3, 3), np.nan)
        covariances[:, :2, :2] = max(sigma**2 - floor**2, 1e-6) * told**2 * np.eye(2)
        positions = np.column_stack([z, np.full(n, np.nan)])
        found = Detections(t, name, positions, covariances, np.full(n, np.nan), KIND[name])
        given: dict[str, Any] = {"features": scene.features[k]} if scene.features else {}
        records.append((t, name, replace(found, **given)))
    return records


def fuse(scene: Scene, variant: Variant) -> tuple[list[Frame], float]:
    """Tracks of a scene by avfuse, and milliseconds a frame."""
    if scene.config is None:
        fusion = Fusion(variant.settings, variant.tracker, variant.lag, population=Population())
    else:
        fusion = Fusion.of(scene.config, variant.settings, variant.tracker, variant.lag)
    queue, steps, first = detections(scene), [], 0
    for now, *_ in scene.truth:
        last = first
        while last < len(queue) and queue[last][0] <= now + 1e-9:
            last += 1
        steps.append((now, queue[first:last]))
        first = last
    begin = time.process_time()
    out = [one for now, due in steps for one in fusion.step(now, due)] + fusion.finish()
    spent = time.process_time() - begin
    return [Frame(one.ids.tolist(), one.positions[:, :2], one.existence) for one in out], 1e3 * spent / len(steps)


def ceiling(scene: Scene) -> list[Frame]:
    """Tracks of the filter that knows the truth's associations."""
    states: dict[int, tuple[float, np.ndarray, np.ndarray, np.ndarray]] = {}
    out, queue = [], list(scene.records)

    def moved(
        state: tuple[float, np.ndarray, np.ndarray, np.ndarray], t: float
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        last, mean, cov, mode = state
        if t - last > 1e-9:
            mean, cov, mode, *_ = gaussian.predict(mean, cov, mode, WALKING, round(t - last, 9))
        return max(t, last), mean, cov, mode

    for now, present, _ in scene.truth:
        while queue and queue[0][0] <= now + 1e-9:
            t, name, z, sigma, owners = queue.pop(0)
            noise = sigma**2 * np.eye(2)[None]
            for position, owner in zip(z, owners.tolist(), strict=True):
                if owner in states:
                    last, mean, cov, mode = moved(states[owner], t)
                    offset = sensor(name, KIND[name]).mouth_offset
                    states[owner] = (
                        last,
                        *gaussian.update(
                            mean, cov, mode, position[None], noise, gaussian.innovation(mean, cov, offset)
                        ),
                    )
                elif owner >= 0:
                    states[owner] = (t, *gaussian.begin(position[None], noise, WALKING))
        known = [i for i in present.tolist() if i in states]
        positions = [gaussian.moments(*moved(states[i], now)[1:])[0][0, :2] for i in known]
        out.append(Frame(known, np.reshape(positions, (-1, 2)), np.full(len(known), math.nan)))
    return out
