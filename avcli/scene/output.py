"""What is written of a film: the directory of an experiment, COCO annotations, a contact sheet, a glTF model."""

import collections
import contextlib
import io
import json
import os
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from avcli import __version__
from avcli.formats import atomic, media, png, records
from avcli.formats.experiment import Layout, write_config
from avcli.formats.writer import PICTURES, earlier_files
from avcli.scene import annotations, mesh, people
from avcli.scene.film import Film, Frame, Timing
from avcli.scene.scenario import Scenario

_COMMAND = "avsim-scene"
_IN_FLIGHT = 2  # frames that are written while the next one is drawn
_SHEET_ROWS, _SHEET_COLUMNS, _SHEET_WIDTH_PX = 3, 4, 480


class ForeignConfig(ValueError):
    """The directory's config.json was written by another program."""


@dataclass(frozen=True)
class Files:
    """Which files are written.

    Attributes:
        frames: "png", "npy" (raw NumPy arrays) or "none".
        masks: whether to write masks of people.
        coco: file for COCO annotations of all frames; None: not written.
        sheet: file for a contact sheet; None: not written.
    """

    frames: str = "png"
    masks: bool = False
    coco: str | os.PathLike | None = None
    sheet: str | os.PathLike | None = None


def prepare(directory: Path, *, force: bool = False) -> None:
    """Remove what an earlier run wrote into the directory of an experiment: all of it, or nothing after an error.

    Args:
        directory: of the experiment; this process must be its `only_writer`.
        force: also where another program wrote its config.json, and pictures behind a symbolic link.

    Raises:
        ForeignConfig: another program wrote its config.json.
        Linked: there are pictures behind a symbolic link.
    """
    layout = Layout(directory)
    if layout.config.exists() and not force:
        try:
            owner = json.loads(layout.config.read_bytes()).get("written_by", {}).get("command")
        except (ValueError, AttributeError):
            owner = None
        if owner != _COMMAND:
            raise ForeignConfig(
                f"{layout.config}: not written by {_COMMAND}; --force overwrites it and the frames beside it"
            )
    pictures = earlier_files(directory, PICTURES, force=force)
    for path in (layout.config, layout.groundtruth, *pictures):
        path.unlink(missing_ok=True)


def write(film: Film, directory: Path, files: Files, timing: Timing) -> Generator[dict[str, Any], None, None]:
    """Draw a film into a prepared directory, and yield each record as soon as its files are complete.

    config.json is there before the first record; groundtruth_sources.jsonl appears when the last one was taken. Files
    are written in a thread beside the drawing (deflate needs no interpreter).
    """
    kind = files.frames if film.drawing else "none"
    drawing = film.drawing
    depth_too = bool(drawing and drawing.pictures != "rgb")
    writer = _FrameWriter(directory, kind, bool(drawing and drawing.depth_bits == "8"), depth_too)
    background = kind != "none" and depth_too and film.background is not None
    if background and film.background is not None:
        writer.write(Layout.background_depth, writer.encoded("background", film.background, "png"))
    written_by = {
        "command": _COMMAND, "version": __version__, "scenario": film.scenario.name, "seed": film.seed,
    }  # fmt: skip
    write_config(Layout(directory).config, film.config(background=background) | {"written_by": written_by})
    extras: list[_Coco | _Sheet] = []
    if files.coco is not None:
        extras.append(_Coco(files.coco, film.scenario.people))
    if files.sheet is not None:
        extras.append(_Sheet(files.sheet, len(film.scenario.times)))

    def begun(pool: ThreadPoolExecutor) -> Iterator[tuple[dict[str, Any], Future[None]]]:
        """Each frame's record, and the job that writes its files."""
        for frame in film.frames():
            paths = writer.pictures(frame, files.masks)
            with timing("annotate"):
                for extra in extras:
                    extra.add(frame)
            job = pool.submit(writer.save, paths, timing)
            names = {name: path for name, (path, _, _) in paths.items()}
            yield frame.record | ({"frame": names} if names else {}), job

    with contextlib.ExitStack() as stack:
        truth = stack.enter_context(open(stack.enter_context(atomic.replacing(Layout(directory).groundtruth)), "wb"))
        pool = ThreadPoolExecutor(1)
        stack.callback(pool.shutdown, wait=True, cancel_futures=True)
        for record in _complete(begun(pool)):
            truth.write(records.encode({key: value for key, value in record.items() if key != "frame"}))
            yield record
    for extra in extras:
        extra.finish()


def _complete(frames: Iterator[tuple[dict[str, Any], Future[None]]]) -> Iterator[dict[str, Any]]:
    """Yield each record as soon as its files are there; others of a pipe wait for it."""
    waiting: collections.deque[tuple[dict[str, Any], Future[None]]] = collections.deque()
    for item in frames:
        waiting.append(item)
        while waiting and (len(waiting) > _IN_FLIGHT or waiting[0][1].done()):
            record, files = waiting.popleft()
            files.result()
            yield record
    for record, files in waiting:
        files.result()
        yield record


Picture = tuple[str, np.ndarray, str]
"""Path relative to the experiment, array, and "png" or "npy"."""


@dataclass(frozen=True)
class _FrameWriter:
    """Writes the pictures of frames: `kind` "png", "npy" or "none"; `narrow` depth has 8 bits."""

    directory: Path
    kind: str
    narrow: bool
    depth_too: bool
    last: dict[str, tuple[np.ndarray, list[bytes | memoryview]]] = field(default_factory=dict)
    encoders: dict[str, png.Encoder] = field(default_factory=lambda: collections.defaultdict(png.Encoder))

    def pictures(self, frame: Frame, masks: bool) -> dict[str, Picture]:
        """What is to be written of a frame, by its key in the record's "frame"."""
        pictures: dict[str, Picture] = {}
        if frame.picture is None:
            return pictures
        if self.kind != "none" and frame.rgb is not None:
            pictures["rgb"] = Layout.rgb(frame.timestamp, self.kind), frame.rgb, self.kind
        if self.kind != "none" and self.depth_too:
            pictures["depth"] = Layout.depth(frame.timestamp, self.kind), frame.picture.depth, self.kind
        if masks:
            stem = Layout.rgb(frame.timestamp).rsplit("RGB_frame_", 1)[1]
            pictures["mask"] = f"video/masks/Mask_frame_{stem}", frame.picture.ids, "png"
        return pictures

    def save(self, pictures: dict[str, Picture], timing: Timing) -> None:
        """Write a frame's pictures; one that is the same array as the frame before's is not encoded again."""
        with timing("write (beside the drawing)"):
            for name, (path, picture, kind) in pictures.items():
                known = self.last.get(name)
                if known is None or known[0] is not picture:
                    known = self.last[name] = picture, self.encoded(name, picture, kind)
                self.write(path, known[1])

    def bits(self, depth: np.ndarray) -> np.ndarray:
        """A depth picture (height, width) uint16 in the bits that are written; 0 where it is too far for them."""
        return np.where(depth < 256, depth, 0).astype(np.uint8) if self.narrow else depth

    def encoded(self, name: str, picture: np.ndarray, kind: str) -> list[bytes | memoryview]:
        """The parts of the file of a picture (height, width[, 3]), the next of this name; raw pixels are not copied."""
        picture = self.bits(picture) if picture.dtype == np.uint16 else picture
        if kind == "png":
            return [self.encoders[name].encode(picture)]
        head = io.BytesIO()
        picture = np.ascontiguousarray(picture)
        np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(picture))
        return [head.getvalue(), picture.data]

    def write(self, name: str, content: list[bytes | memoryview]) -> None:
        """Write one file, whole or not at all."""
        path = self.directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic.replacing(path) as temporary, open(temporary, "wb") as stream:
            for part in content:
                stream.write(part)


class _Coco:
    """Collects COCO's annotations and writes them at the end."""

    def __init__(self, path: str | os.PathLike, people: Sequence[people.Person]) -> None:
        self.path = path
        self.number = {person.object_id: number for number, person in enumerate(people)}
        self.images: list[dict[str, Any]] = []
        self.annotations: list[dict[str, Any]] = []

    def add(self, frame: Frame) -> None:
        """Take a frame's annotations."""
        if frame.picture is None:
            return
        number = len(self.images) + 1
        height, width = frame.picture.ids.shape
        self.images.append({"id": number, "file_name": Layout.rgb(frame.timestamp), "width": width, "height": height})
        for item in frame.record["objects"]:
            entry = annotations.coco(
                item, self.number[item["object_id"]], frame.picture, number, len(self.annotations) + 1
            )
            if entry is not None:
                self.annotations.append(entry)

    def finish(self) -> None:
        """Write the file."""
        content = {"images": self.images, "annotations": self.annotations, "categories": annotations.COCO_CATEGORIES}
        atomic.write_bytes(self.path, json.dumps(content).encode() + b"\n")


class _Sheet:
    """A contact sheet: twelve frames spread over a film of `count` frames, in three rows of four."""

    def __init__(self, path: str | os.PathLike, count: int) -> None:
        cells = _SHEET_ROWS * _SHEET_COLUMNS
        self.path, self.number = path, 0
        self.pictures: list[np.ndarray] = []
        self.wanted = {round(k * (count - 1) / (cells - 1)) for k in range(cells)}

    def add(self, frame: Frame) -> None:
        """Take a frame, if it is one of the twelve."""
        import cv2

        if self.number in self.wanted and frame.rgb is not None:
            height, width = frame.rgb.shape[:2]
            size = (_SHEET_WIDTH_PX, max(round(_SHEET_WIDTH_PX * height / width), 1))
            small = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
            label, white = f"{frame.timestamp:.1f} s", (255, 255, 255)
            cv2.putText(small, label, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, white, 1, cv2.LINE_AA)
            self.pictures.append(small)
        self.number += 1

    def finish(self) -> None:
        """Write the file."""
        if not self.pictures:
            return
        blank = np.full_like(self.pictures[0], 40)
        cells = self.pictures + [blank] * (-len(self.pictures) % _SHEET_COLUMNS)
        rows = [np.concatenate(cells[k : k + _SHEET_COLUMNS], 1) for k in range(0, len(cells), _SHEET_COLUMNS)]
        media.write_png(self.path, np.concatenate(rows))


def write_gltf(scenario: Scenario, path: str | os.PathLike) -> None:
    """Write a scenario at its middle as a binary glTF file."""
    bodies = people.pose(scenario.people, scenario.times[len(scenario.times) // 2 :][:1])
    atomic.write_bytes(path, mesh.glb(scenario, bodies, 0))
