"""Tracks of real people as scenes of the bench: from a checkout of OpenTraj and others, or from ready cases.

OpenTraj (https://github.com/crowdbotp/OpenTraj, Amirian et al., ACCV 2020) gathers public sets of tracks. Other sets
are read from checkouts of their own repositories, in folders of that repository's name inside OpenTraj's, as in
OpenTraj/PedPy. None of them is part of avcli. Sets with `decides` may decide about avcli's settings; the
others judge it, and nobody looks at their results while something is decided.

A track is interpolated to 10 Hz by monotone cubics (PCHIP), cut where nobody looked for 1.5 s, and cut where the
person leaves the area: who comes back is somebody else. Where one ends and, within these 1.5 s, another one begins
within .5 m of where the person was going, the same person was given a new number: they are joined. Where three people
or more, all who were there, end at once in the middle of the area, nobody looked until the next one begins: that time
is not scored, though the sensors go on and find nobody. A case is named SET, SETocc (people hidden from the camera now
and then, and people near each other found as one), either of them with @BEGIN or @any (where it begins, in s; the seed
says) and +SECONDS (how long it is), as in zara02occ@any+60.
"""

import argparse
import gzip
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.io import loadmat

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracking_scenes import KIND, RATE, Look, Rng, Scene, Stay, hidden, perceived, room, turns

from avcli.formats import records
from avcli.formats.experiment import read_config

Walk = tuple[np.ndarray, np.ndarray]
"""Times (n,) s, increasing, and places (n, 2) m of one person."""

LOST = 1.5  # s without an annotation that end a walk
# ETH hotel has 32 such pairs of 389 walks, 25 of them within .25 m; ETH eth 6, uni_examples 1; zara01, zara02, zara03
# and students03, where 428 people walk in a crowd, none.
RENUMBERED, RECENT = 0.5, 1.2  # m from where a person was going by the last s of a walk, within which it goes on
# All 26 times without anybody of ETH hotel begin so, but for the number, and end with up to seven who begin there.
TOGETHER, AT_ONCE, MIDDLE = 3, 0.55, 0.5  # people; s; m from the border of the area
LEAST = 5  # frames of a walk
MERGE = 0.35  # m, occ: people nearer than this are one detection half the time


# --- the formats of the sets ------------------------------------------------------------------------------------------


def of_rows(rows: np.ndarray) -> list[Walk]:
    """Walks of rows (n, 4): person, s, x m, y m."""
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    rows = rows[np.r_[True, (np.diff(rows[:, :2], axis=0) != 0).any(1)]]
    people = np.split(rows, np.flatnonzero(np.diff(rows[:, 0])) + 1)
    return [(one[:, 1], one[:, 2:]) for one in people]


def obsmat(path: str, rate: float) -> Callable[[Path], list[Walk]]:
    """Rows of frame, person, x, z, y, velocities."""
    return lambda root: of_rows(np.loadtxt(root / path, usecols=(1, 0, 2, 4)) / [1, rate, 1, 1])


def columns(
    path: str, rate: float, scale: float = 1.0, order: str = "frame person x y"
) -> Callable[[Path], list[Walk]]:
    """Rows of frame, person, x, y in some order, with - for what is not read; `scale` m. Several files: a pattern.

    Of a .csv the first line names the columns.
    """
    place = [order.split().index(name) for name in ("person", "frame", "x", "y")]

    def read(root: Path) -> list[Walk]:
        files = sorted(root.glob(path))
        if not files:
            raise FileNotFoundError(2, "no such file", str(root / path))
        named = files[0].suffix == ".csv"
        rows = [
            np.loadtxt(file, usecols=place, delimiter="," if named else None, skiprows=int(named)) for file in files
        ]
        return of_rows(np.vstack(rows) * [1, 1 / rate, scale, scale])

    return read


def splines(path: str, homography: str | None, rate: float = 25.0) -> Callable[[Path], list[Walk]]:
    """Control points "x y frame gaze" of each person after a line with their number; m without homography."""

    def read(root: Path) -> list[Walk]:
        rows, person = [], -1
        for line in (root / path).read_text().splitlines():
            if "control points" in line:
                person += 1
            numbers = line.split(" - ")[0].split()
            if len(numbers) == 4:
                rows.append([person, float(numbers[2]) / rate, float(numbers[0]), float(numbers[1])])
        found = np.array(rows)
        if homography:
            found[:, 2:] = on_floor(np.loadtxt(root / homography), found[:, 2:])
        return [dense(*one) for one in of_rows(found) if len(one[0]) > 1]

    def dense(times: np.ndarray, xy: np.ndarray) -> Walk:
        """At 2.5 Hz: control points are far apart where people walk straight, though somebody looked all the time."""
        often = np.linspace(times[0], times[-1], int((times[-1] - times[0]) * 2.5) + 2)
        return often, PchipInterpolator(times, xy)(often)

    return read


def on_floor(homography: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Places (n, 2) m of pixels (n, 2)."""
    mapped = np.column_stack([pixels, np.ones(len(pixels))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def boxes(path: str, rate: float = 30.0) -> Callable[[Path], list[Walk]]:
    """Stanford drone set: person, box, frame, lost, occluded, generated, label; estimated_scales.yaml has the scale."""

    def read(root: Path) -> list[Walk]:
        scene, video = Path(path).parts[2:4]
        scales = (root / "datasets/SDD/estimated_scales.yaml").read_text()
        of_scene = re.search(rf"^{scene}:\n((?:\s.*\n)*)", scales, re.MULTILINE)
        scale = re.search(rf"{video}:\s*\n\s*scale:\s*([\d.]+)", of_scene[1]) if of_scene else None
        if scale is None:
            raise ValueError(f"estimated_scales.yaml has no scale of {scene} {video}")
        rows = []
        for line in (root / path).read_text().splitlines():
            person, x0, y0, x1, y1, frame, lost, _, _, label = line.split()
            if label == '"Pedestrian"' and lost == "0":
                middle = ((int(x0) + int(x1)) / 2, (int(y0) + int(y1)) / 2)
                rows.append([int(person), int(frame) / rate, *(float(scale[1]) * v for v in middle)])
        return [(t[::6], xy[::6]) for t, xy in of_rows(np.array(rows))]  # boxes are steps of pixels: 5 Hz are enough

    return read


def grand_central(path: str, rate: float = 25.0) -> Callable[[Path], list[Walk]]:
    """A file a person of numbers "x y frame" in pixels; the homography of OpenTraj with its scale of 0.8."""

    def read(root: Path) -> list[Walk]:
        homography = np.array(json.loads((root / path / "H.json").read_text())["homog"])
        walks = []
        for file in sorted((root / path / "Annotation").glob("*.txt")):
            numbers = np.array(file.read_text().split(), float)
            rows = numbers[: len(numbers) // 3 * 3].reshape(-1, 3)
            if len(rows):
                xy = 0.8 * on_floor(homography, rows[:, [1, 0]])
                walks += of_rows(np.column_stack([np.zeros(len(rows)), rows[:, 2] / rate, xy]))
        return walks

    return read


def edinburgh(path: str, rate: float = 9.0, scale: float = 0.0247) -> Callable[[Path], list[Walk]]:
    """Lines "TRACK.R1=[[x y frame];[x y frame]…]" in pixels, found by a tracker and not by hand."""

    def read(root: Path) -> list[Walk]:
        rows = []
        for person, line in enumerate(re.findall(r"TRACK\.R\d+=(.*)", (root / path).read_text())):
            points = re.findall(r"(\d+) (\d+) (\d+)", line)
            rows += [[person, int(f) / rate, scale * int(x), scale * int(y)] for x, y, f in points]
        return of_rows(np.array(rows))

    return read


def wildtrack(path: str, rate: float = 10.0) -> Callable[[Path], list[Walk]]:
    """A file a frame, people at positions of a grid of 480 x 1440 points .025 m apart."""

    def read(root: Path) -> list[Walk]:
        rows = []
        for file in sorted((root / path).glob("*.json")):
            for one in json.loads(file.read_text()):
                down, along = divmod(one["positionID"], 480)
                rows.append([one["personID"], int(file.stem) / rate, 0.025 * along, 0.025 * down])
        return of_rows(np.array(rows))

    return read


def conversation(path: str, pause: float = 0.4) -> Callable[[Path], list[Walk]]:
    """Frames of "person x y angle" in cm, about 15 a second, by a tracker; means over `pause` s, since they jitter."""

    def read(root: Path) -> list[Walk]:
        found = loadmat(root / path)
        times = (found["timestamp"][0] - found["timestamp"][0, 0]) * 1e-6
        frames = zip(times, found["features"][0], strict=True)
        rows = np.vstack([np.insert(people[:, :3], 1, t, axis=1) for t, people in frames if len(people)])
        slots = np.round(rows[:, 1] / pause)
        keys, which = np.unique(np.column_stack([rows[:, 0], slots]), axis=0, return_inverse=True)
        count = np.bincount(which)
        mean = [np.bincount(which, rows[:, k]) / count for k in (1, 2, 3)]
        return of_rows(np.column_stack([keys[:, 0], mean[0], mean[1] / 100, mean[2] / 100]))

    return read


# --- the sets ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Dataset:
    """One set of tracks.

    Attributes:
        read: from the checkout's directory to walks, m in the set's own frame.
        begin, seconds: the part that a case has unless it says otherwise, s.
        corner: of the area, m in the set's own frame, None: the least of all places.
        size: of the area, m, None: as far as anybody goes.
        decides: whether it may decide about settings.
    """

    read: Callable[[Path], list[Walk]]
    begin: float
    seconds: float
    source: str
    licence: str
    corner: tuple[float, float] | None = None
    size: tuple[float, float] | None = None
    decides: bool = False


ETH = ("ETH: Pellegrini, Ess, Schindler, van Gool, You'll never walk alone, ICCV 2009", "not stated")
UCY = ("UCY: Lerner, Chrysanthou, Lischinski, Crowds by example, Eurographics 2007", "free with credit")
SDD = ("Stanford drone: Robicquet et al., Learning social etiquette, ECCV 2016", "CC BY-NC-SA 3.0")
GRAND_CENTRAL = ("Grand Central: Zhou, Wang, Tang, CVPR 2011; Yi, Li, Wang, CVPR 2015", "not stated")
EDINBURGH = ("Edinburgh Informatics Forum: Majecka, University of Edinburgh 2009", "not stated")
WILDTRACK = ("WildTrack: Chavdarova et al., CVPR 2018", "not stated")
HERMES = ("HERMES: Holl, Seyfried; Forschungszentrum Jülich", "not stated")
CITR = ("CITR: Yang, Li, Redmill, Özgüner, Top-view trajectories, IV 2019", "not stated")
CMC = ("CMC: Ong, Vo, Vo, Kim, Nordholm, A Bayesian filter for multi-view 3D tracking, TPAMI 2022", "not stated")
CROMA = (
    "Single file, Germany: Paetzke et al. 2023; Forschungszentrum Jülich, doi 10.34735/ped.2021.5",
    "see its archive",
)
QUEUE = (
    "Single file, Palestine: Subaih et al. 2020; Forschungszentrum Jülich, doi 10.34735/ped.2018.5",
    "see its archive",
)
JUELICH = ("Experiments of Forschungszentrum Jülich, in PedPy: Schrödter et al.", "MIT (PedPy)")
LYON = ("Festival of Lights, Lyon: MADRAS, 2022, doi 10.5281/zenodo.10694866", "MIT (madras-data-app)")
CROSSING = ("Experiment of Forschungszentrum Jülich, in JPSreport", "LGPL (JPSreport)")
COCKTAIL = ("CocktailParty: Zen, Lepri, Ricci, Lanz, Space speaks, MPVA 2010", "research, with credit")

_UCY, _SDD = "datasets/UCY/", "datasets/SDD/{}/video{}/annotations.txt"
_CMC = (
    "Multi-view-3D-multi-object-tracking-dataset/release/amilan-motchallenge-devkit-CLEARMOT/GT_{}_WORLD_CENTROID.txt"
)
_SINGLE = "SingleFileMovementAnalysis/notebooks/demo_data/"
_OVAL = _SINGLE + "genderFemale_germany_paetzke2023/traj/00_raw/setupLeft/croma_female_{}_1.txt"
_QUEUE = _SINGLE + "genderMixedAlternating_palestine_subaih2019/traj/00_raw/UX_20_1.txt"
_CITR, _PEDPY = "datasets/CITR/data/trajectories/{}/p*.csv", "PedPy/notebooks/demo-data/"
_MOT, _RAW = "frame person - - - - - x y", "person frame x y"

DATASETS = {
    "hotel": Dataset(
        obsmat("datasets/ETH/seq_hotel/obsmat.txt", 25.0), 200, 180, *ETH, (-3.3, -10.3), (7.7, 14.6), decides=True
    ),
    "zara01": Dataset(obsmat(_UCY + "zara01/obsmat.txt", 25.0), 30, 120, *UCY, (-7.4, 5.0), (13.8, 9.0), decides=True),
    "zara02": Dataset(
        obsmat(_UCY + "zara02/obsmat.txt", 25.0), 240, 120, *UCY, (-8.4, -6.0), (14.8, 11.2), decides=True
    ),
    "eth": Dataset(obsmat("datasets/ETH/seq_eth/obsmat.txt", 15.0), 600, 180, *ETH),
    "zara03": Dataset(splines(_UCY + "zara03/annotation.vsp", _UCY + "zara03/H.txt"), 30, 120, *UCY),
    "students01": Dataset(columns(_UCY + "students01/students001.txt", 25.0), 30, 60, *UCY),
    "students03": Dataset(obsmat(_UCY + "students03/obsmat.txt", 25.0), 30, 60, *UCY),
    "uni_examples": Dataset(splines(_UCY + "uni_examples/annotation.vsp", _UCY + "students03/H.txt"), 10, 60, *UCY),
    "arxiepiskopi": Dataset(splines(_UCY + "arxiepiskopi/annotation.vsp", None), 0, 31, *UCY),
    "grand_central": Dataset(grand_central("datasets/GC"), 600, 60, *GRAND_CENTRAL),
    "edinburgh01Aug": Dataset(edinburgh("datasets/Edinburgh/annotations/tracks.01Aug.txt"), 1140, 180, *EDINBURGH),
    "edinburgh01Jul": Dataset(edinburgh("datasets/Edinburgh/annotations/tracks.01Jul.txt"), 16500, 180, *EDINBURGH),
    "wildtrack": Dataset(wildtrack("datasets/Wild-Track/annotations_positions"), 0, 180, *WILDTRACK),
    "corridor1d": Dataset(
        columns("datasets/HERMES/Corridor-1D/uo-100-180-180.txt", 16.0, 0.01, "person frame x y"), 5, 60, *HERMES
    ),
    "corridor2d": Dataset(
        columns("datasets/HERMES/Corridor-2D/bo-360-075-075.txt", 16.0, 0.01, "person frame x y"), 5, 60, *HERMES
    ),
    **{
        f"cmc{number}": Dataset(columns(_CMC.format(name), 4.0, 1.0, _MOT), 0, 65, *CMC, decides=True)
        for number, name in ((1, "J_1_1"), (2, "J_5_2"), (3, "J_6_1"))
    },
    **{
        f"oval{people}": Dataset(columns(_OVAL.format(people), 25.0, 1.0, _RAW), 5, 110, *CROMA, decides=True)
        for people in ("04", "08", "16")
    },
    **{
        f"citr-{name}": Dataset(columns(_CITR.format(run), 29.97), begin, seconds, *CITR, decides=True)
        for name, run, begin, seconds in (
            ("two-ways", "p2p_bi/bidirection_no_vehicle_3v7_03", 4, 9),
            ("one-way", "p2p_uni/unidirection_no_vehicle_01", 1.2, 9.5),
            ("car", "vci_back/back_interaction_01", 10.5, 14),
        )
    },
    "unicorr": Dataset(
        columns(_PEDPY + "uni-directional/traj_UNI_CORR_500_01.txt", 25.0, 1.0, _RAW), 4, 60, *JUELICH, decides=True
    ),
    "corner": Dataset(
        columns("PedPy/tests/reference_tests/data/corner/traj.txt", 16.0, 1.0, _RAW), 4, 40, *JUELICH, decides=True
    ),
    "cocktail": Dataset(
        conversation("group-assignment-datasets/data/octave/CocktailParty/features.mat"), 60, 120, *COCKTAIL
    ),
    "bottleneck": Dataset(
        columns(_PEDPY + "bottleneck/040_c_56_h-.txt", 25.0, 1.0, _RAW), 0, 60, *JUELICH, decides=True
    ),
    "bicorr": Dataset(columns(_PEDPY + "bi-directional/bi_corr_400_b_03.txt", 25.0, 0.01, _RAW), 25, 30, *JUELICH),
    "pressed": Dataset(
        columns("PedPy/tests/unit_tests/io/test-data/030_c_56_h0.txt", 25.0, 1.0, _RAW), 0, 60, *JUELICH
    ),
    "doorway": Dataset(
        columns("PedPy/tests/reference_tests/data/bottleneck/traj.txt", 16.0, 1.0, _RAW), 10, 15, *JUELICH
    ),
    "packed": Dataset(columns(_PEDPY + "uni-directional/uo-180-180-070.txt", 16.0, 0.01, _RAW), 30, 30, *JUELICH),
    "crossing90": Dataset(
        columns("jpsreport/demos/crossing/traj_crossing_90_c_6_v5.txt", 25.0, 1.0, _RAW), 30, 19, *CROSSING
    ),
    "lyon": Dataset(columns("madras-data-app/data/trajectories/Topview_2D.txt", 30.0, 1.0, _RAW), 60, 30, *LYON),
    "queue": Dataset(columns(_QUEUE, 25.0, 1.0, _RAW), 5, 120, *QUEUE),
    **{
        f"sdd-{scene}{video}": Dataset(boxes(_SDD.format(scene, video)), 2, 60, *SDD)
        for scene, video in (
            ("gates", 2),
            ("gates", 4),
            ("gates", 8),
            ("hyang", 12),
            ("hyang", 13),
            ("hyang", 14),
            ("little", 0),
            ("nexus", 10),
        )
    },
}

_read: dict[tuple[str, Path], list[Walk]] = {}


def dataset(case: str) -> Dataset | None:
    """The set of a case by its name, None: it is none of these."""
    return DATASETS.get(case.split("@")[0].removesuffix("occ"))


def walks_of(name: str, root: Path) -> tuple[list[Walk], tuple[float, float]]:
    """The walks of a set, cut where nobody looked, in a frame whose origin is the area's corner; the area's size, m."""
    one = DATASETS[name]
    if (name, root) not in _read:
        _read[name, root] = one.read(root)
    walks = _read[name, root]
    places = np.vstack([xy for _, xy in walks])
    corner = np.array(one.corner if one.corner else np.floor(places.min(0) * 10) / 10)
    size = one.size or tuple((np.ceil((places.max(0) - corner) * 10) / 10).tolist())
    parts: list[Walk] = []
    for times, xy in walks:
        cuts = np.flatnonzero(np.diff(times) > LOST) + 1
        parts += zip(np.split(times, cuts), np.split(xy - corner, cuts), strict=True)
    return joined([part for part in parts if len(part[0]) > 1]), (size[0], size[1])


def joined(walks: Sequence[Walk]) -> list[Walk]:
    """Return the walks with those joined that go on under another number, the nearest ones first."""
    pairs = []
    for a, (times, xy) in enumerate(walks):
        since = min(int(np.searchsorted(times, times[-1] - RECENT - 1e-6)), len(times) - 2)
        velocity = (xy[-1] - xy[since]) / (times[-1] - times[since])
        for b, (later, places) in enumerate(walks):
            gap = later[0] - times[-1]
            if 0 < gap <= LOST:
                off = float(np.linalg.norm(places[0] - xy[-1] - gap * velocity))
                if off < RENUMBERED:
                    pairs.append((off, a, b))
    after: dict[int, int] = {}
    for _, a, b in sorted(pairs):
        if a not in after and b not in after.values():
            after[a] = b
    out = []
    for first in range(len(walks)):
        if first in after.values():
            continue
        chain = [first]
        while chain[-1] in after:
            chain.append(after[chain[-1]])
        out.append((np.concatenate([walks[k][0] for k in chain]), np.concatenate([walks[k][1] for k in chain])))
    return out


def unlooked(walks: Sequence[Walk], size: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the times, from s to s, at which nobody looked: all who were there have ended at once in the middle."""
    spans = []
    order = sorted(walks, key=lambda walk: float(walk[0][0]))
    for k in range(1, len(order)):
        begin, end = max(float(times[-1]) for times, _ in order[:k]), float(order[k][0][0])
        last = [xy[-1] for times, xy in order[:k] if times[-1] > begin - AT_ONCE]
        middle = all(MIDDLE < x < size[0] - MIDDLE and MIDDLE < y < size[1] - MIDDLE for x, y in last)
        if begin < end and len(last) >= TOGETHER and middle:
            spans.append((begin, end))
    return spans


def inside(walks: Iterable[Walk], size: tuple[float, float], begin: int, end: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (first tick, places (n, 2) m at 10 Hz) of each stay in the area between two ticks."""
    for times, xy in walks:
        ticks = np.arange(np.ceil(times[0] * RATE - 1e-6), np.floor(times[-1] * RATE + 1e-6) + 1).astype(int)
        ticks = ticks[(ticks >= begin) & (ticks <= end)]
        if not len(ticks):
            continue
        places = PchipInterpolator(times, xy)(ticks / RATE)
        here = np.all((places >= 0) & (places <= np.array(size)), axis=1, keepdims=True)[:, 0]
        for run in np.split(np.arange(len(ticks)), np.flatnonzero(np.diff(here)) + 1):
            if here[run[0]] and len(run) >= LEAST:
                yield int(ticks[run[0]]), places[run]


def scene(rng: Rng, name: str, root: Path, sigma: float = 0.12) -> Scene:
    """Make a scene of a case by name, with video noise sigma m."""
    base, _, where = name.partition("@")
    where, _, length = where.partition("+")
    hiding = base.endswith("occ")
    base = base.removesuffix("occ")
    walks, size = walks_of(base, root)
    seconds = float(length or DATASETS[base].seconds)
    begin = float(where) if where and where != "any" else DATASETS[base].begin
    if where == "any":
        first, last = min(t[0] for t, _ in walks), max(t[-1] for t, _ in walks)
        begin = first + rng.uniform(0, max(last - first - seconds, 0))
    first, count = round(begin * RATE), round(seconds * RATE)
    stays = [
        Stay(tick - first, xy, turns(rng, len(xy)), hidden(rng, len(xy)) if hiding else np.zeros(len(xy), bool))
        for tick, xy in inside(walks, size, first, first + count)
    ]
    merge = MERGE if hiding else 0.0
    looks = (Look("audio", 0.25, 0.85, 0.05, area=size), Look("video", sigma, 0.9, 0.05, area=size, merge=merge))
    made = perceived(rng, stays, np.arange(count + 1) / RATE, looks, room(*size))
    spans = unlooked(walks, size)
    return replace(made, unlooked=[(since - first / RATE, until - first / RATE) for since, until in spans])


def ready(folder: Path, sensors: tuple[str, ...] = ("audio", "video")) -> Scene:
    """A case of a directory: config.json, ground truth, {audio,video}_localizations.jsonl, or these as .gz.

    The detections may lie in localization/, as those of an experiment do; one of the sensors may lack.
    """

    def place(name: str) -> Path:
        where = folder / name, folder / "localization" / name, folder / f"{name}.gz"
        return next((one for one in where if one.exists()), where[0])

    def lines(name: str) -> Iterator[Any]:
        path = place(name)
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as file:
            yield from map(records.decode, file)

    people = map(records.identified, lines("groundtruth_sources.jsonl"))
    truth = [(round(one.timestamp, 6), one.ids, one.positions[:, :2]) for one in people]
    found = [
        (round(one.timestamp, 6), name, replace(one, sensor=name, kind=KIND[name]))
        for name in sensors
        if place(f"{name}_localizations.jsonl").exists()
        for one in map(records.detections, lines(f"{name}_localizations.jsonl"))
    ]
    if not found:
        raise FileNotFoundError(f"{folder} has no detections")
    return Scene(truth, config=read_config(folder / "config.json"), ready=sorted(found, key=lambda r: (r[0], r[1])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walks", type=Path, help="a checkout of OpenTraj")
    parser.add_argument("--plot", type=Path, help="draw the walks of each set into a PNG here (needs matplotlib)")
    options = parser.parse_args()
    for name, one in DATASETS.items():
        try:
            walks, size = walks_of(name, options.walks)
        except OSError as error:
            print(f"{name:18s} missing: {error.filename}")
            continue
        begin, end = min(t[0] for t, _ in walks), max(t[-1] for t, _ in walks)
        case = scene(np.random.default_rng(0), name, options.walks)
        counts = np.array([len(ids) for _, ids, _ in case.truth])
        speeds = np.concatenate([np.linalg.norm(np.diff(xy, axis=0), axis=1) / np.diff(t) for t, xy in walks])
        print(
            f"{name:18s} {'decides' if one.decides else 'judges':7s} {len(walks):5d} walks, {begin:5.0f} to {end:5.0f} "
            f"s, {size[0]:5.1f} x {size[1]:4.1f} m; the case: {counts.mean():5.1f} people, {counts.max():3d} at most; "
            f"speed m/s: median {np.median(speeds):.2f}, 99 % {np.percentile(speeds, 99):.2f}"
        )
        if options.plot:
            draw(name, walks, size, options.plot / f"{name}.png")


def draw(name: str, walks: list[Walk], size: tuple[float, float], path: Path) -> None:
    """A picture of all walks of a set."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8, 8))
    for _, xy in walks[:1500]:
        axis.plot(*xy.T, linewidth=0.5)
    axis.plot([0, size[0], size[0], 0, 0], [0, 0, size[1], size[1], 0], "k--")
    axis.set(title=name, aspect="equal")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=70)
    plt.close(figure)


if __name__ == "__main__":
    main()
