"""Measured rooms with microphones and loudspeakers at known places, as they are published.

Each set is a folder beside the others in one directory; none is part of the project. A set says which of its
loudspeakers decided settings ("decide") and which are kept to judge by ("judge").
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile
from scipy.io import loadmat

LINE, RANDOM = "5 on a line of 2 m", "8 of 25 at random"
"""What lines, and other arrays, of VilniusTech's places are called."""


@dataclass(frozen=True)
class Measured:
    """One loudspeaker in one measured room.

    Attributes:
        set, name: which, for the table.
        split: "decide" or "judge".
        room: (3,) m.
        microphones: (m, 3) m.
        source: (3,) m.
        responses: (m, n).
        sample_rate: Hz.
    """

    set: str
    name: str
    split: str
    room: np.ndarray
    microphones: np.ndarray
    source: np.ndarray
    responses: np.ndarray
    sample_rate: int


@dataclass(frozen=True)
class MeasuredSet:
    """A published set: its folder, where it comes from, its licence, and how it is read."""

    folder: str
    source: str
    licence: str
    read: Callable[[Path], Iterator[Measured]]


def delft(folder: Path) -> Iterator[Measured]:
    """Read eight microphones on a circle of 10 cm radius, and six loudspeakers 1.4 to 4.4 m from it (TU Delft).

    The file's places agree with the delays of the direct sound to 0.02 ms; its own other list of places does not.
    """
    for path in sorted(folder.glob("InHouse/bigger/*/RIR_*.mat")):
        content = loadmat(str(path))
        curtains, number = path.parent.name.split()[0].lower(), path.stem.split("_")[1]
        yield Measured(
            "circle of 8, 10 cm",
            f"loudspeaker {number}, curtains {curtains}",
            "decide" if curtains == "closed" and number in "134" else "judge",
            np.array([8.1, 6.8, 3.07]),
            np.asarray(content["loc_microphone"], float),
            np.asarray(content["loc_loudspeaker"], float).ravel(),
            np.asarray(content["RIR"], float).T,
            int(content["Fs"].ravel()[0]),
        )


def variable_lab(folder: Path) -> Iterator[Measured]:
    """Read seven microphones of a sphere of 5 cm radius, loudspeakers around it at 1.5 to 3 m (R3VIVAL).

    Azimuths run clockwise, channel 3 is on the right. The array's place in the room is not stated: the middle of the
    floor is taken, at ear height; only directions are judged.
    """
    slant = 0.05 * np.sqrt(0.5)
    shape = np.array([[0.05, 0, 0], [-0.05, 0, 0], [0, -slant, slant], [0, slant, slant], [0, -slant, -slant],
                      [0, slant, -slant], [0, 0, 0]])  # fmt: skip
    room, centre = np.array([9.7, 5.5, 2.7]), np.array([4.85, 2.75, 1.3])
    pattern = re.compile(r"Absorptive_([0-9A-Z]+)_S(\d+)-(\d+)_")
    for path in sorted(folder.glob("RIRs/FRL_array/*.wav")):
        found = pattern.search(path.name)
        if not found or found[1] not in ("000", "050", "100"):
            continue
        turn, distance = -np.radians(float(found[2])), float(found[3]) / 100.0
        samples, rate = soundfile.read(path)
        yield Measured(
            "sphere of 7, 5 cm",
            f"{found[2]} degrees, {distance:g} m, absorption {found[1]}",
            "decide" if found[1] == "000" else "judge",
            room,
            centre + shape,
            centre + distance * np.array([np.cos(turn), np.sin(turn), 0.0]),
            samples.T,
            rate,
        )


def polarity(responses: np.ndarray, ranges: np.ndarray, rate: int) -> np.ndarray:
    """Return 1 or -1 for each response (m, n), (m, 1): by which the direct sounds from ranges (m,) m are alike."""
    begin = int(np.median(np.abs(responses).argmax(axis=1) - ranges / 343.0 * rate)) - rate // 650
    delays = ranges / 343.0 * rate + begin
    first = delays.astype(int)
    pieces = np.stack([one[at : at + rate // 170] for one, at in zip(responses, first, strict=True)])
    turns = np.exp(2j * np.pi * np.fft.rfftfreq(1024) * (delays - first)[:, None])
    frequency = np.fft.rfftfreq(1024, 1.0 / rate)
    spectra = (np.fft.rfft(pieces, 1024) * turns)[:, (frequency > 300.0) & (frequency < 5000.0)]
    spectra /= np.linalg.norm(spectra, axis=1, keepdims=True)
    common = np.linalg.eigh((spectra @ spectra.conj().T).real)[1][:, -1]
    turned: np.ndarray = np.sign(common * common.sum())[:, None]
    return turned


def vilnius(folder: Path) -> Iterator[Measured]:
    """Read 25 places of a microphone in a grid 50 cm apart, two loudspeakers 1 to 3 m from them (VilniusTech).

    Eight of the places at a time are an array, and each five of a row or a column a line; the delays agree with the
    stated places to 0.01 ms. The polarity of a response is a matter of chance: 8 of one loudspeaker and 12 of the other
    are turned over, mostly at other places. No wiring does that; they are put right by the direct sound.
    """
    grid = np.array([(3.68 - 0.5 * (k % 5), 3.0 + 0.5 * (k // 5), 1.2) for k in range(25)])
    choices = [
        ("8 in a grid of 2 m", "decide", np.array([0, 4, 20, 24, 7, 11, 13, 17])),
        ("8 in a grid of 2 m", "judge", np.array([2, 10, 14, 22, 1, 8, 16, 23])),
        *((RANDOM, "judge", np.random.default_rng(k).choice(25, 8, replace=False)) for k in range(20)),
        *((f"{LINE}, row", "judge", 5 * k + np.arange(5)) for k in range(5)),
        *((f"{LINE}, column", "judge", k + 5 * np.arange(5)) for k in range(5)),
    ]
    sources = np.array([(3.36, 2.0, 1.5), (2.0, 2.0, 1.5)])
    heard = []
    for number in (1, 2):
        paths = [folder / f"Source{number}" / f"S{number}R{place}.Wav" for place in range(1, 26)]
        read = [soundfile.read(path, always_2d=True) for path in paths]
        length = min(len(samples) for samples, _ in read)
        responses, rate = np.array([samples[:length, 0] for samples, _ in read]), read[0][1]
        heard.append((responses * polarity(responses, np.linalg.norm(sources[number - 1] - grid, axis=1), rate), rate))
    for some in (choices[:2], choices[2:]):
        for number, (source, (responses, rate)) in enumerate(zip(sources, heard, strict=True), start=1):
            for array, (name, split, chosen) in enumerate(some):
                yield Measured(
                    name,
                    f"loudspeaker {number}, array {array}",
                    split,
                    np.array([5.36, 5.85, 2.86]),
                    grid[chosen],
                    source,
                    responses[chosen],
                    rate,
                )


SETS = (
    MeasuredSet(
        "extracting-absorption-coefficients",
        "https://github.com/tbloemen/extracting-absorption-coefficients (InHouse, bigger)",
        "none stated: evaluated with only",
        delft,
    ),
    MeasuredSet(
        "R3VIVAL", "https://github.com/facebookresearch/R3VIVAL (Amengual Gari et al.)", "CC BY 4.0", variable_lab
    ),
    MeasuredSet(
        "Room-Impulse-Response-dataset",
        "https://github.com/tamulionism/Room-Impulse-Response-dataset",
        "none stated: evaluated with only",
        vilnius,
    ),
)
