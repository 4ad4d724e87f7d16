"""The sound files of an experiment, written while the sound is simulated."""

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avcli.acoustics.recorder import Recorder
from avcli.formats.experiment import Layout
from avcli.formats.media import AudioWriter, is_recording, refuse_sound_format
from avcli.formats.writer import SOUND, earlier_files


@dataclass(frozen=True)
class Chunk:
    """A sound file that is complete.

    Attributes:
        path: relative to the experiment's directory.
        start_sample: index of its first sample on the scene's clock.
        num_samples: its length.
        tail_samples: how many of its samples come after the end of the scene.
        sample_rate_hz: Hz.
        num_channels: one for each microphone.
        clipped: samples beyond full scale.
        activity: id -> list of [start, end] s, when each voice sounds.
    """

    path: str
    start_sample: int
    num_samples: int
    tail_samples: int
    sample_rate_hz: int
    num_channels: int
    clipped: int
    activity: dict[int, list[list[float]]]

    def record(self) -> dict[str, Any]:
        """Return the audio record of the file (avcli-formats(5))."""
        keys = ("path", "start_sample", "num_samples", "tail_samples", "sample_rate_hz", "num_channels")
        return {
            "timestamp": self.start_sample / self.sample_rate_hz,
            "audio": {key: getattr(self, key) for key in keys},
            "activity": {
                str(identity): [[round(start, 6), round(end, 6)] for start, end in intervals]
                for identity, intervals in self.activity.items()
            },
        }


class Tape:
    """The sound files of an experiment, one after another; those of an earlier run are removed.

    Args:
        recorder: gives the sound.
        experiment: directory of the experiment; this process must be its `only_writer`.
        files: holds the file that is being written: leaving it completes the file, or drops it after an error.
        chunk_s: length of a file, s; None: one file for the whole scene.
        extension: "wav" or "flac".
        bit_depth: 16, 24 or 32, where 32 are floats; FLAC has at most 24.

    Raises:
        Linked: sound files of an earlier run are behind a symbolic link.
        ValueError: sound files that have the names of an earlier run's are no simulated ones.
    """

    def __init__(
        self,
        recorder: Recorder,
        experiment: Path,
        files: contextlib.ExitStack,
        *,
        chunk_s: float | None = None,
        extension: str = "wav",
        bit_depth: int = 32,
    ):
        self._recorder, self._experiment, self._files = recorder, experiment, files
        self._chunk = sys.maxsize if chunk_s is None else round(chunk_s * recorder.sample_rate_hz)
        self._extension = extension
        self._bit_depth = min(bit_depth, 24) if extension == "flac" else bit_depth
        channels = len(recorder.surroundings.microphones_m)
        refuse_sound_format(str(experiment), f".{extension}", channels, self._bit_depth)
        self._file: AudioWriter | None = None
        self._path, self._begin, self._now = "", 0, 0
        earlier = earlier_files(experiment, SOUND)
        if recordings := [path for path in earlier if is_recording(path)]:
            raise ValueError(
                f"{recordings[0]}: avsim-audio did not write this sound, and would remove it; use another directory, "
                "or move it away"
            )
        for old in earlier:
            old.unlink(missing_ok=True)
        (experiment / Layout.audio(0.0)).parent.mkdir(parents=True, exist_ok=True)

    def roll(self) -> Iterator[Chunk]:
        """Write the sound that is settled, and yield each file that becomes complete."""
        for piece in self._recorder.pieces():
            self._now = self._recorder.end - len(piece)
            while len(piece):
                if self._file is None:
                    self._file = self._opened()
                part = piece[: self._begin + self._chunk - self._now]
                self._file.write(part)
                self._now, piece = self._now + len(part), piece[len(part) :]
                if self._now == self._begin + self._chunk:
                    yield self._completed(self._file)

    def end(self) -> Iterator[Chunk]:
        """Write what remains after `Recorder.finish`, and yield each file that becomes complete."""
        yield from self.roll()
        if self._file is not None:
            yield self._completed(self._file)

    def _opened(self) -> AudioWriter:
        rate, channels = self._recorder.sample_rate_hz, len(self._recorder.surroundings.microphones_m)
        self._begin = self._now
        self._path = Layout.audio(self._begin / rate, self._extension)
        return self._files.enter_context(AudioWriter(self._experiment / self._path, rate, channels, self._bit_depth))

    def _completed(self, file: AudioWriter) -> Chunk:
        self._files.close()
        self._file = None
        rate = self._recorder.sample_rate_hz
        return Chunk(
            path=self._path,
            start_sample=self._begin,
            num_samples=self._now - self._begin,
            tail_samples=self._recorder.tail_samples(self._begin, self._now),
            sample_rate_hz=rate,
            num_channels=file.channels,
            clipped=file.clipped,
            activity=self._recorder.activity(self._begin / rate, self._now / rate),
        )
