"""What random scenes and worlds tell of the detector: the samples to which fit_detection.py fits its numbers.

Each scene is drawn from a seed of its own, and its samples can be kept in a file, so that a fit that was interrupted
goes on where it was. The folder has a name of the code and the network that they come from.
"""

import contextlib
import dataclasses
import hashlib
import pickle
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from bench_detection import GATE_M, Tally, scenes
from detection_worlds import BoxSample, Said, looked_at, of_people
from renders import Shot

from avcli.detection import fitted
from avcli.detection.depth import DepthDetector
from avcli.detection.fitted import SCORE
from avcli.detection.network import Network, own_model
from avcli.detection.view import View
from avcli.scene import render, scenario

AxisSample = tuple[np.ndarray, np.ndarray, float]


@dataclasses.dataclass
class Samples:
    """What a scene or a world gives to fit to.

    Attributes:
        axis: of each position from depth: error (2,) m, from the camera (2,) m, visible fraction.
        box: of each body that the network found, see detection_worlds.
        score: of each thing before the empty room: visible surface, m², and whether it was a person.
        faint: of each body before the empty room that is none of the network's people, see detection_worlds.
        network: of each of the network's detections: score, and whether it was a person.
    """

    axis: list[AxisSample] = dataclasses.field(default_factory=list)
    box: list[BoxSample] = dataclasses.field(default_factory=list)
    score: list[tuple[float, bool]] = dataclasses.field(default_factory=list)
    faint: list[Said] = dataclasses.field(default_factory=list)
    network: list[tuple[float, bool]] = dataclasses.field(default_factory=list)


def collect(count: int, frames: int, seed: int, kept: Path | None = None) -> list[Samples]:
    """Look at `frames` pictures of each of `count` random scenes: the samples of each, kept in a folder if given."""
    network = Network(own_model(), confidence=0.02)
    context = render.open_context()
    context.gc_mode = "auto"

    def look(k: int) -> Samples:
        samples = Samples()
        for drawn, view in scenes(1, frames, [seed, k], context):
            detector = DepthDetector(view, view.sampled(drawn[0].background))
            bare = _without_rays(drawn[0].view)
            tally = Tally("network")
            for shot in drawn:
                _add_depth(samples, shot, view, detector)
                found = network.detect(shot.picture)
                tally.rank(shot, found)
                samples.box += of_people(found, shot.boxes, shot.places, bare)
            samples.network += zip(tally.scores, map(bool, tally.right), strict=True)
        return samples

    return _each(f"scenes-{seed}-{frames}", range(count), look, kept)


def collect_worlds(count: int, frames: int, first: int, kept: Path | None = None) -> list[Samples]:
    """Look at `frames` pictures of each of `count` random worlds, from the seed `first` on, as `collect` does."""
    context = render.open_context()
    context.gc_mode = "auto"

    def look(seed: int) -> Samples:
        with contextlib.suppress(scenario.ScenarioError):  # more people than the room holds
            faint, box = looked_at(seed, frames, context)
            return Samples(faint=faint, box=box)
        return Samples()

    return _each(f"worlds-{frames}", range(first, first + count), look, kept)


def joined(scenes_of: list[Samples], name: str) -> list:
    """The samples of a name of all scenes."""
    return [sample for scene in scenes_of for sample in getattr(scene, name)]


def folder(out: Path) -> Path:
    """The folder in which samples of today's code and network are kept."""
    here, package = Path(__file__).resolve().parent, Path(fitted.__file__).resolve().parent
    sources = [here / f"{name}.py" for name in ("detection_samples", "detection_worlds", "bench_detection")]
    drawing = here.parent.parent / "examples" / "train-detector"
    sources += [drawing / f"{name}.py" for name in ("renders", "generate", "judge")]
    for part in ("detection", "lens", "scene"):
        sources += [one for one in package.with_name(part).rglob("*") if one.suffix in (".py", ".json", ".onnx")]
    digest = hashlib.sha256(b"".join(one.read_bytes() for one in sorted(sources)))
    return out / digest.hexdigest()[:12]


def _each(name: str, numbers: range, look: Callable[[int], Samples], kept: Path | None) -> list[Samples]:
    """The samples of all numbers, from their files where they are kept there; every tenth is said on stderr."""
    everything, begin = [], time.process_time()
    for done, k in enumerate(numbers, 1):
        path = None if kept is None else kept / f"{name}-{k}.pickle"
        if path is not None and path.exists():
            samples = pickle.loads(path.read_bytes())
        else:
            samples = look(k)
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                part = path.with_suffix(".part")
                part.write_bytes(pickle.dumps(samples))
                part.replace(path)
        everything.append(samples)
        if kept is not None and (done % 10 == 0 or done == len(numbers)):
            print(f"{name}: {done} of {len(numbers)}, {time.process_time() - begin:.0f} CPU s", file=sys.stderr)
    return everything


def _without_rays(view: View) -> View:
    """The view as it was made: the rays that it has reckoned since are large."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = view.rotation, view.origin
    return View(view.lens, pose, view.size, view.theta_max)


def _add_depth(samples: Samples, shot: Shot, view: View, detector: DepthDetector) -> None:
    taken: set[int] = set()
    for person in sorted(detector.detect(view.sampled(shot.depth)), key=lambda one: -one.score):
        away = np.linalg.norm(shot.places - person.position[:2], axis=1)
        away[list(taken)] = np.inf
        right = bool(len(away)) and bool(away.min() < GATE_M)
        samples.score.append((SCORE.surface_m2 * person.score / (1 - person.score), right))
        if right and person.visible is not None:
            best = int(away.argmin())
            taken.add(best)
            place = person.position[:2]
            samples.axis.append((place - shot.places[best], place - view.origin[:2], person.visible))
