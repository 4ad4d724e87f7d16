#!/usr/bin/env python3
"""Make an experiment of the tracks of ETH or UCY: config.json, ground truth and, if wanted, simulated detections.

    python examples/datasets/ethucy.py OpenTraj/datasets/ETH/seq_eth/obsmat.txt --rate 15 --simulate -C out/eth
    avfuse -C out/eth --doors anywhere out/eth/detections.jsonl -o t.jsonl
    aveval out/eth/groundtruth_sources.jsonl t.jsonl

The data: S. Pellegrini, A. Ess, K. Schindler, L. van Gool, "You'll Never Walk Alone", ICCV 2009 (ETH); A. Lerner,
Y. Chrysanthou, D. Lischinski, "Crowds by Example", Eurographics 2007 (UCY); both in the layout of OpenTraj
(github.com/crowdbotp/OpenTraj): obsmat.txt has rows of frame, person, x, z, y m and velocities; UCY's .vsp files have
the control points "x y frame gaze" of each person in pixels, which --homography maps to metres.
Frames are counted at 25 Hz, and at 15 Hz in seq_eth (--rate). Places are interpolated to 10 Hz by monotone cubics, and
not across more than 1.5 s without an annotation. UCY is free with credit; ETH states no terms.

--simulate adds detections.jsonl, which no sensor has made: a person is found with probability 0.9, with noise of
0.12 m, and 0.05 false detections are in a record. They are the same for the same --seed.
"""

import argparse
from pathlib import Path

import numpy as np
from experiment import RATE_HZ, people, run, save
from scipy.interpolate import PchipInterpolator

FOUND, NOISE, FALSE = 0.9, 0.12, 0.05
LOST = 1.5
"""s without an annotation that end a walk."""


def of_obsmat(path: Path) -> np.ndarray:
    """Read rows (n, 4) of person, frame, x m, y m."""
    rows = np.loadtxt(path, ndmin=2)
    if rows.shape[1] < 5:
        raise ValueError(f"{path}: its rows have fewer than the columns frame, person, x, z, y")
    return rows[:, [1, 0, 2, 4]]


def of_splines(path: Path, homography: Path | None) -> np.ndarray:
    """Read rows (n, 4) of person, frame, x m, y m from control points."""
    if homography is None:
        raise ValueError(f"{path}: has pixels; --homography H.txt maps them to metres")
    rows, person = [], 0
    for line in path.read_text(encoding="utf-8").splitlines():
        person += "control points" in line
        cells = line.split(" - ")[0].split()
        if len(cells) == 4:
            rows.append([person, float(cells[2]), float(cells[0]), float(cells[1])])
    found = np.array(rows).reshape(-1, 4)
    mapped = np.column_stack([found[:, 2:], np.ones(len(found))]) @ np.loadtxt(homography).T
    found[:, 2:] = mapped[:, :2] / mapped[:, 2:]
    return found


def walks(rows: np.ndarray, rate: float, lost: float) -> dict[int, list[tuple[np.ndarray, np.ndarray]]]:
    """Cut rows into walks: for each person times (n,) s and places (n, 2) m, n of 2 or more."""
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for person in np.unique(rows[:, 0]).astype(int).tolist():
        mine = rows[rows[:, 0] == person]
        mine = mine[np.unique(mine[:, 1], return_index=True)[1]]
        times = mine[:, 1] / rate
        cuts = np.flatnonzero(np.diff(times) > lost) + 1
        parts = zip(np.split(times, cuts), np.split(mine[:, 2:], cuts), strict=True)
        found[person] = [(t, xy) for t, xy in parts if len(t) > 1]
    return found


def simulated(truth: list[dict], room: np.ndarray, seed: int) -> list[dict]:
    """Make detections of ground-truth records in a room (2,) m."""
    rng = np.random.default_rng(seed)
    spread = np.diag([NOISE**2, NOISE**2, 1.0]).tolist()
    records = []
    for one in truth:
        places = [np.array(person["position"][:2]) for person in one["objects"] if rng.random() < FOUND]
        places = [place + rng.normal(0.0, NOISE, 2) for place in places]
        places += [rng.random(2) * room for _ in range(rng.poisson(FALSE))]
        objects = [{"position": [*place.tolist(), 0.0], "covariance": spread, "score": FOUND} for place in places]
        records.append({"timestamp": one["timestamp"], "sensor": "video", "kind": "camera", "objects": objects})
    return records


def convert(
    path: Path,
    out: Path,
    homography: Path | None,
    rate: float,
    span: tuple[float, float],
    simulate: bool,
    seed: int,
) -> None:
    """Write the experiment of one file of tracks.

    Args:
        path: obsmat.txt or annotation.vsp.
        out: of the experiment; it must be empty or missing.
        homography: file of 3 x 3 numbers, pixels to m, for a .vsp file.
        rate: frames a second.
        span: begin in s of the set's clock, and length in s.
        simulate: write detections.jsonl too.
        seed: of the detections.

    Raises:
        ValueError: the file is not of that layout, or nobody walks then; `out` is not empty.
    """
    drawn = path.suffix == ".vsp"
    rows = of_splines(path, homography) if drawn else of_obsmat(path)
    at = np.arange(round(span[1] * RATE_HZ) + 1) / RATE_HZ
    tracks: dict[str, np.ndarray] = {}
    for person, parts in walks(rows, rate, np.inf if drawn else LOST).items():
        for number, (times, xy) in enumerate(parts):
            places = PchipInterpolator(times - span[0], xy, extrapolate=False)(at)
            if np.isfinite(places).any():
                tracks[f"{person}" if number == 0 else f"{person}-{number + 1}"] = places
    if not tracks:
        raise ValueError(f"{path}: nobody walks from {span[0]:g} s to {span[0] + span[1]:g} s")
    everywhere = np.concatenate(list(tracks.values()))
    corner = np.floor(np.nanmin(everywhere, axis=0) * 10) / 10
    room = np.ceil((np.nanmax(everywhere, axis=0) - corner) * 10) / 10
    tracks = {name: places - corner for name, places in tracks.items()}
    truth = [people(time, {name: places[row] for name, places in tracks.items()}) for row, time in enumerate(at)]
    config = {
        "session_id": path.parent.name,
        "room_config": {"room_dimensions_m": [*room.tolist(), 3.0]},
        "sensors": {"video": {"kind": "camera"}},
    }
    streams = {"groundtruth_sources.jsonl": truth}
    if simulate:
        streams["detections.jsonl"] = simulated(truth, room, seed)
    save(out, config, streams)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path, help="obsmat.txt or annotation.vsp")
    parser.add_argument("-C", dest="out", type=Path, required=True, help="the experiment's directory")
    parser.add_argument("--homography", type=Path, help="H.txt beside a .vsp file: pixels to m")
    parser.add_argument("--rate", type=float, default=25.0, help="frames a second")
    parser.add_argument("--begin", type=float, default=0.0, help="s of the set's clock")
    parser.add_argument("--seconds", type=float, default=120.0, help="length of the experiment, s")
    parser.add_argument("--simulate", action="store_true", help="write simulated detections too")
    parser.add_argument("--seed", type=int, default=0, help="of the simulated detections")
    given = parser.parse_args()
    span = (given.begin, given.seconds)
    run(lambda: convert(given.path, given.out, given.homography, given.rate, span, given.simulate, given.seed))


if __name__ == "__main__":
    main()
