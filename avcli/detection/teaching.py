"""A small network learns one room from a large one (Hinton et al., 2015): film in, a network for that camera out.

A teacher, usually a network that knows people from photographs and looks at turned windows, says where the people of a
film are. The small network learns that. A part of the film is held back: there its scores are calibrated, and there
both networks are compared with the teacher, and with labels made by hand where there are some.
"""

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING

import numpy as np

from avcli.detection.agreement import LEAST, Found, average_precision, matched, overlaps, platt
from avcli.detection.bands import suited
from avcli.detection.lessons import Lesson, drawn
from avcli.detection.network import PAD, Boxes, Network
from avcli.detection.settings import FEWEST, TeachingSettings
from avcli.detection.view import View
from avcli.detection.windows import WindowedNetwork

if TYPE_CHECKING:
    from avcli.detection.learning import Progress

DOUBTFUL = 0.1
"""Score of the teacher from which a box is not held against the learner, though it is too low to be learnt."""

LOWEST = 0.02
"""Score from which boxes count in the comparison."""

CALIBRATED = 0.1
"""Score from which boxes are used to calibrate; the many below, mostly wrong, would bend the law where it matters."""

BLOCKS, EVERY = 10, 5
"""The film is cut into so many parts in time, of which every so many-th is held back."""

SURE = 0.95
"""Share of resampled films in which the new network must be the better one."""


@dataclass
class Agreement:
    """How well a network agrees with the teacher on the pictures that were held back.

    Attributes:
        ap: average precision at an intersection over union of .3, the teacher's boxes being the truth.
        precision, recall: at score .5.
        false_empty: people a picture at score .5, in the pictures where the teacher sees nobody; None: there are none.
        ap_labels: average precision against labels made by hand; None: there are none.
    """

    ap: float
    precision: float
    recall: float
    false_empty: float | None
    ap_labels: float | None = None


@dataclass
class Taught:
    """What came of the teaching.

    Attributes:
        model: content of the ONNX file.
        before, after: of the network that began, and of the one that learnt.
        teacher_labels: the teacher's own average precision against labels made by hand; None: there are none.
        learnt, held_back: number of pictures.
        people: whom the teacher saw in all of them.
        surer: share of resampled sets of the pictures held back in which the new network has the larger F measure.
    """

    model: bytes
    before: Agreement
    after: Agreement
    teacher_labels: float | None
    learnt: int
    held_back: int
    people: int
    surer: float

    @property
    def is_better(self) -> bool:
        """Whether the new network is surely better than the one that began."""
        return self.surer >= SURE


@dataclass
class State:
    """What an interrupted run leaves for the next one: what the teacher saw, and how far the learning came.

    Attributes:
        key: of the task: film, networks, settings, seed.
        seen: (people, doubtful) of `Lesson`, of each picture so far.
        progress: of the learning; None: it has not begun.
    """

    key: str
    seen: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    progress: "Progress | None" = None

    @classmethod
    def read(cls, path: Path, key: str) -> "State":
        """The state of the same task, or an empty one where the file is missing or belongs to another task."""
        import torch

        from avcli.detection.learning import Progress

        try:
            found = torch.load(path, weights_only=True)
            seen = [(people.numpy(), doubtful.numpy()) for people, doubtful in found["seen"]]
            state = cls(found["key"], seen, Progress(**found["progress"]) if found["progress"] else None)
        except (OSError, ValueError, KeyError, TypeError, RuntimeError, EOFError, UnpicklingError):
            return cls(key)
        return state if state.key == key else cls(key)

    def write(self, path: Path) -> None:
        """Replace the file whole."""
        import torch

        seen = [(torch.from_numpy(people), torch.from_numpy(doubtful)) for people, doubtful in self.seen]
        new = path.with_name(path.name + ".new")
        torch.save({"key": self.key, "seen": seen, "progress": self.progress and vars(self.progress)}, new)
        os.replace(new, path)


def key_of(*parts: bytes | str | TeachingSettings | int) -> str:
    """A key of a task, of all that decides about its result."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part if isinstance(part, bytes) else repr(part).encode())
        digest.update(b"\0")
    return digest.hexdigest()


class Teacher:
    """A network that says where people are, and how sure it is.

    Args:
        model: content of the ONNX file.
        size: (width, height) px of the pictures.
        settings: how it looks.
        view: of the camera, which says where the point below it is and what the lens lights; None: that point is taken
            to be the picture's middle.

    Raises:
        ModelError: the file is no detector of people.
    """

    def __init__(
        self, model: bytes, size: tuple[int, int], settings: TeachingSettings, view: View | None = None
    ) -> None:
        shape = (1, 1) if settings.windows else size
        network = Network(model, None, DOUBTFUL, picture=shape)
        below = None if view is None else view.below
        centre = np.array(size) / 2 if below is None else below + 0.5
        circle = None if view is None else view.circle
        self._least, self._view = settings.confidence, view
        self._look = network.detect
        if settings.windows:
            self._look = WindowedNetwork(network, size, centre, settings.windows, circle).detect

    def lit(self, picture: np.ndarray) -> np.ndarray:
        """A picture (height, width, 3) uint8 with grey in place of what the lens does not light."""
        return picture if self._view is None else self._view.lit(picture, PAD)

    def look(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The sure people (n, 5) and the doubtful boxes (k, 4) in a picture that is `lit`, px, as `Lesson` has them."""
        found = self._look(picture)
        boxes, turned = found.boxes, found.turned
        if turned is None:
            low, high = boxes[:, :2], boxes[:, 2:]
            turned = np.column_stack([(low + high) / 2, high - low, np.zeros(len(boxes))])
        sure = found.scores >= self._least
        return turned[sure], boxes[~sure]


def held_back(count: int) -> np.ndarray:
    """Which (count,) of the pictures, in order of time, are held back: whole parts of the film."""
    block = np.arange(count) * BLOCKS // max(count, 1)
    return np.asarray(block % EVERY == EVERY // 2)


def teach(
    learner: bytes,
    lessons: list[Lesson],
    settings: TeachingSettings,
    seed: int,
    state: State,
    keep: Callable[[State], None],
    metadata: dict[str, str],
) -> Iterator[int | Taught]:
    """Teach a network of this project.

    Args:
        learner: content of its ONNX file.
        lessons: in order of time.
        settings: how long.
        seed: of all chance.
        state: where an earlier run stopped.
        keep: is called after each step.
        metadata: for the new ONNX file.

    Yields:
        The number of each step, and the result at the end.

    Raises:
        ValueError: the film has too few pictures, or the teacher sees nobody in one of its two parts.
    """
    from avcli.detection.learning import Graph, Progress, learn

    apart = held_back(len(lessons))
    taught = [one for one, is_held in zip(lessons, apart, strict=True) if not is_held]
    judge = [one for one, is_held in zip(lessons, apart, strict=True) if is_held]
    if len(lessons) < FEWEST:
        raise ValueError(f"the film has {len(lessons)} pictures; {FEWEST} or more are needed")
    if not all(any(len(one.people) for one in part) for part in (taught, judge)):
        raise ValueError(
            "the teacher sees nobody in the part to learn from, or nobody in the part that is held back: film longer, "
            "try another --windows, or a smaller --confidence"
        )
    graph = Graph(learner)
    for progress in learn(
        graph, lambda k, chance: drawn(taught[k], chance), len(taught), settings.steps, seed,
        state.progress or Progress(),
    ):  # fmt: skip
        state.progress = progress
        keep(state)
        yield progress.step
    size = lessons[0].picture.shape[1], lessons[0].picture.shape[0]
    raw = [_against(one, _seen_by(graph.content(1.0, 0.0, {"parts": "unknown"}), size, one)) for one in judge]
    scores = np.clip(np.concatenate([one[1] for one in raw]), 1e-6, 1 - 1e-6)
    right = np.concatenate([matched(*one) for one in raw])
    likely = scores >= CALIBRATED
    slope, shift = platt(scores[likely], right[likely]) if likely.any() else (1.0, 0.0)
    model = graph.content(slope, shift, metadata | {"imgsz": str([size[1], size[0]]), "parts": "unknown"})
    found = [[_seen_by(content, size, one) for one in judge] for content in (learner, model)]
    pairs = [[_against(one, boxes) for one, boxes in zip(judge, some, strict=True)] for some in found]
    before, after = (_agreement(judge, some) for some in found)
    made = [(one.boxes, np.ones(len(one.people)), one.labels) for one in judge if one.labels is not None]
    yield Taught(
        model, before, after, average_precision(made) if made else None, len(taught), len(judge),
        sum(len(one.people) for one in lessons), _surer(pairs[0], pairs[1], np.random.default_rng([seed, 1])),
    )  # fmt: skip


def _seen_by(model: bytes, size: tuple[int, int], one: Lesson) -> Boxes:
    return suited(Network(model, size, LOWEST), one.picture).detect(one.picture)


def _against(one: Lesson, found: Boxes) -> Found:
    """Boxes, scores, and the teacher's boxes; boxes that it holds for doubtful are left out."""
    right = matched(found.boxes, found.scores, one.boxes)
    unclear = np.zeros(len(found), bool)
    if len(one.doubtful):
        unclear = ~right & (overlaps(found.boxes, one.doubtful) >= LEAST).any(axis=1)
    return found.boxes[~unclear], found.scores[~unclear], one.boxes


def _agreement(lessons: list[Lesson], found: list[Boxes]) -> Agreement:
    pairs = [_against(one, boxes) for one, boxes in zip(lessons, found, strict=True)]
    hits, seen, people = np.sum([_counted(pair) for pair in pairs], axis=0).tolist()
    empty = [int((scores >= 0.5).sum()) for _, scores, labels in pairs if not len(labels)]
    made = [(b.boxes, b.scores, one.labels) for one, b in zip(lessons, found, strict=True) if one.labels is not None]
    return Agreement(
        average_precision(pairs),
        hits / max(seen, 1),
        hits / max(people, 1),
        float(np.mean(empty)) if empty else None,
        average_precision(made) if made else None,
    )


def _surer(before: list[Found], after: list[Found], chance: np.random.Generator, tries: int = 1000) -> float:
    """Share of resampled sets of pictures (bootstrap; Efron, 1979) on which `after` has the larger F measure."""
    draws = chance.integers(len(before), size=(tries, len(before)))
    old, new = (np.array([_counted(one) for one in some])[draws].sum(axis=1) for some in (before, after))
    measures = [2 * counts[:, 0] / np.maximum(counts[:, 1:].sum(axis=1), 1) for counts in (old, new)]
    return float(np.mean(measures[1] > measures[0]))


def _counted(found: Found) -> tuple[int, int, int]:
    """Right boxes, boxes and people at score .5."""
    sure = found[1] >= 0.5
    return int((matched(*found) & sure).sum()), int(sure.sum()), len(found[2])
