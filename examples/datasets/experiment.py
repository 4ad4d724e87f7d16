"""What the importers of this folder share: an experiment directory, written whole or not at all."""

import json
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

RATE_HZ = 10.0
"""Records a second."""
SOUND = "audio/wav/multichannel_audio_0.0000000000.wav"


def sampled(times: np.ndarray, places: np.ndarray, at: np.ndarray, gap: float = 0.5) -> np.ndarray:
    """Interpolate annotated places, and only where somebody annotated them.

    Args:
        times: (n,) s, increasing.
        places: (n, d) m.
        at: (m,) s.
        gap: s between two annotations that end an interpolation.

    Returns:
        (m, d) m; NaN before the first annotation, after the last one and in gaps.
    """
    found = np.stack([np.interp(at, times, column, np.nan, np.nan) for column in places.T], axis=1)
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    if len(times) > 1:
        inside = (times[after] - times[after - 1] > gap) & ~np.isin(at, times)
        found[inside] = np.nan
    return found


def people(time: float, places: Mapping[Any, np.ndarray], **keys: Mapping[Any, Any]) -> dict[str, Any]:
    """Make a ground-truth record.

    Args:
        time: s.
        places: by identity, x, y m of a body, or x, y, z m of a mouth; NaN: nobody knows.
        keys: further keys of a person, by name and then by identity.
    """
    objects = []
    for identity, place in places.items():
        if np.isfinite(place).all():
            one: dict[str, Any] = {"object_id": identity, "position": [*np.asarray(place)[:2].tolist(), 0.0]}
            if len(place) == 3:
                one["mouth_position"] = np.asarray(place).tolist()
            objects.append(one | {key: of[identity] for key, of in keys.items() if identity in of})
    return {"timestamp": round(float(time), 10), "objects": objects}


def only(folder: Path, name: str) -> Path:
    """Find a file in a folder or in those inside it."""
    found = sorted(folder.rglob(name))
    if len(found) != 1:
        raise ValueError(f"{folder}: expected one {name}, found {len(found)}")
    return found[0]


def save(
    out: Path,
    config: Mapping[str, Any],
    streams: Mapping[str, Sequence[Mapping[str, Any]]],
    sound: np.ndarray | None = None,
    bits: int = 24,
) -> None:
    """Write an experiment: config.json, streams of records and sound.

    Args:
        out: its directory; it must be empty or missing.
        config: config.json; its microphone_config has the sample rate of `sound`.
        streams: records by the name of their file.
        sound: (n, channels), -1 to 1; audio.jsonl then names it.
        bits: of a sample.

    Raises:
        ValueError: the directory is not empty.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"{out}: is not empty")
    streams = dict(streams)
    part = out.with_name(out.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        if sound is not None:
            rate = config["microphone_config"]["audio_sample_rate_hz"]
            (part / SOUND).parent.mkdir(parents=True)
            soundfile.write(part / SOUND, sound, rate, subtype=f"PCM_{bits}")
            heard = {"path": SOUND, "start_sample": 0, "num_samples": len(sound), "sample_rate_hz": rate}
            streams["audio.jsonl"] = [{"timestamp": 0.0, "audio": heard | {"num_channels": sound.shape[1]}}]
        (part / "config.json").write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
        for name, records in streams.items():
            with open(part / name, "w", encoding="utf-8") as lines:
                lines.writelines(json.dumps(record, allow_nan=False) + "\n" for record in records)
        if out.exists():
            out.rmdir()
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def run(convert: Callable[[], None]) -> None:
    """Run an importer; what is wrong with its input is one line, and exit 1."""
    try:
        convert()
    except (ValueError, OSError, KeyError, soundfile.LibsndfileError) as error:
        text = f"there is no key {error}" if isinstance(error, KeyError) else error
        sys.exit(f"{Path(sys.argv[0]).name}: {text}")
