"""Fits how true the filter's existence is; writes avcli/tracking/existence.json (`make fit-existence`).

A record of a track is true if the track is matched, one to one, to somebody within 1 m: those that the program shows
take their people first, as in bench-tracking, which sees no others. The laws of
avcli/tracking/trust.py are those of greatest likelihood over all records of the tracks in which the filter believes
with .35 or more, in domains:

- the synthetic cases (seeds from 100 on), those with more scenes in bench-tracking with more here, too;
- the tracks of real people that may decide, at two places: ETH hotel, and the street of UCY zara01 and zara02, with and
  without occlusions, from a checkout of OpenTraj, without the times at which nobody annotated;
- films of real people, as film_cases.py makes them, all that are in --films.

The domains count WORTH, however many records they have. Films are few, and say of whom nobody detects what the others
cannot: how real people leave the place where a detector lost them. In hotel people vanish amid the area, many together:
some left there, of others the annotation ends.

A run that was stopped goes on where it was, if the code of the trackers and of the scenes is the same.
"""

import argparse
import hashlib
import json
import math
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracking_cases import FIRST_DECIDING, MORE, ONCE, SYNTHETIC, scene_of
from tracking_measures import matched
from tracking_runs import Frame, Variant, fuse
from tracking_scenes import Scene, Truth

from avcli.tracking import glmb
from avcli.tracking.model import THERE
from avcli.tracking.trust import FITTED, Grounds, Law, Trust, odds_of

REAL = tuple(f"{name}{hiding}@any+120" for name in ("hotel", "zara01", "zara02") for hiding in ("", "occ"))
LONG = ("long-pair", "long-pair-looks", "ten-looks", "crowd100", "60hz", *ONCE)  # minutes, and nearly all is true
WORTH = {"synthetic": 1.0, "hotel": 0.5, "zara": 0.5, "films": 0.2}
SHRINK = 3e-4  # nats for the square of a term's power, in standard deviations of the term
NOTHING = Law(1.0, 0.0, 0.0)
TERMS = {  # of `Law`, but for the odds: those that are fitted
    "once": ("existence", "near"),
    "once_missed": (),  # too few records: those of `again_missed`
    "again": ("existence", "near"),
    "again_missed": ("existence", "near", "missed", "returned"),
    "unwatched": ("existence", "near"),
}


class Noted:
    """In place of a `Trust`: says what the filter believes, and notes the grounds."""

    def __init__(self) -> None:
        self.grounds: list[Grounds] = []

    def of(self, grounds: Grounds) -> float:
        believed = grounds.existence * grounds.near
        if believed > THERE:
            self.grounds.append(grounds)
        return believed


def records_of(scene: Scene) -> np.ndarray:
    """Records of the tracks of a scene: (n, 9) the grounds, the factor of existence, and whether it is true."""
    noted, usual = Noted(), (glmb.TRUST, glmb.SHOWN)
    glmb.TRUST, glmb.SHOWN = noted, 0.0  # type: ignore[assignment]
    try:
        tracks, _ = fuse(scene, Variant())
    finally:
        glmb.TRUST, glmb.SHOWN = usual
    grounds = np.reshape(np.array(noted.grounds, float), (-1, len(Grounds._fields)))
    said = np.concatenate([np.zeros(0), *(frame.existence for frame in tracks)])
    times = np.array([t for (t, *_), frame in zip(scene.truth, tracks, strict=True) for _ in frame.ids])
    shown = np.array([usual[0].of(one) > usual[1] for one in noted.grounds], bool)
    true = truths(scene.truth, tracks, shown)
    looked = np.ones(len(times), bool)
    for since, until in scene.unlooked:
        looked &= (times < since + 1e-6) | (times > until - 1e-6)
    return np.column_stack([grounds, said / (grounds[:, 0] * grounds[:, 1]), true])[looked]


def truths(truth: Truth, tracks: list[Frame], shown: np.ndarray) -> list[bool]:
    """Whether each record of some tracks is true; shown: (n,) of those that take their people first."""
    first = np.split(shown, np.cumsum([len(frame.ids) for frame in tracks])[:-1])
    mine = matched(truth, [only(frame, some) for frame, some in zip(tracks, first, strict=True)])
    rest = []
    for (t, ids, xy), found in zip(truth, mine, strict=True):
        left = ~np.isin(ids, list(found.values()))
        rest.append((t, ids[left], xy[left]))
    others = matched(rest, [only(frame, ~some) for frame, some in zip(tracks, first, strict=True)])
    return [one in a or one in b for frame, a, b in zip(tracks, mine, others, strict=True) for one in frame.ids]


def only(frame: Frame, some: np.ndarray) -> Frame:
    """A frame without the tracks but some (n,)."""
    ids = [one for one, wanted in zip(frame.ids, some.tolist(), strict=True) if wanted]
    return Frame(ids, frame.xy[some], frame.existence[some])


def features(grounds: np.ndarray) -> np.ndarray:
    """Logarithms (n, 4) of what the powers of a `Law` are of, in its order, for the grounds (n, 7) of n records."""
    existence, near, *_, missed, returned = grounds.T
    return np.log([odds_of(existence), odds_of(near), np.maximum(missed, 1), returned]).T


def fit(rows: np.ndarray, weight: np.ndarray, terms: Sequence[str], given: Law = NOTHING) -> Law:
    """The law of greatest likelihood for n records, with three digits: logistic regression, no power negative.

    Args:
        rows: (n, 9), see `records_of`.
        weight: (n,) of the records.
        terms: what is fitted beside the odds.
        given: the powers of the other terms.
    """
    columns = [Law._fields.index(name) - 1 for name in terms]
    every = features(rows[:, :7])
    scale = every[:, columns].std(0) + 1e-9
    x = np.column_stack([np.ones(len(rows)), every[:, columns] / scale])
    known = every @ np.array(given[1:])
    factor, true, weight = np.minimum(rows[:, 7], 1 - 1e-4), rows[:, 8] > 0, weight / weight.sum()

    def loss(powers: np.ndarray) -> tuple[float, np.ndarray]:
        law = expit(x @ powers + known)
        said = factor * law
        nats = -np.where(true, np.log(np.maximum(said, 1e-12)), np.log(1 - said))
        slope = np.where(true, law - 1, said * (1 - law) / (1 - said))
        shrink = SHRINK * np.r_[0, powers[1:]]
        return float(weight @ nats + shrink @ powers), (weight * slope) @ x + 2 * shrink

    bounds = [(None, None), *((0, None) for name in terms)]
    best = minimize(loss, np.r_[1.0, np.zeros(len(terms))], jac=True, method="L-BFGS-B", bounds=bounds).x
    powers = dict(zip(terms, best[1:] / scale, strict=True))
    return given._replace(
        odds=float(f"{math.exp(best[0]):.3g}"), **{name: float(f"{power:.3g}") for name, power in powers.items()}
    )


def fitted(domains: dict[str, np.ndarray]) -> Trust:
    """The laws that fit the records (n, 9) of some domains best: see `records_of`."""
    rows = np.concatenate(list(domains.values()))
    kinds = np.array([Trust.group(Grounds(*one)) for one in rows[:, :7].tolist()])
    names = np.repeat(list(domains), [len(some) for some in domains.values()])
    laws: dict[str, Law] = {}
    for name in ("once", "again", "again_missed", "once_missed", "unwatched"):
        some = kinds == Trust._fields.index(name)
        weight = np.zeros(len(rows))
        for domain, worth in WORTH.items():
            here = some & (names == domain)
            weight[here] = worth / max(int(here.sum()), 1)
        given = laws["again_missed"] if name == "once_missed" else NOTHING
        laws[name] = fit(rows[some], weight[some], TERMS[name], given)
    return Trust(**laws)


def bins(said: np.ndarray, true: np.ndarray) -> list[list[float]]:
    """Records, what is said and what is true, on average, in bins of .1 from .5 on."""
    place = np.minimum((said * 10).astype(int), 9)
    some = [(place == k) for k in range(5, 10) if (place == k).any()]
    return [[int(one.sum()), round(float(said[one].mean()), 3), round(float(true[one].mean()), 3)] for one in some]


def described(domains: dict[str, np.ndarray], command: str, synthetic: list[str]) -> dict[str, Any]:
    """What the file says of laws that are fitted to the records (n, 9) of some domains."""
    trust = fitted(domains)

    def scores(name: str, rows: np.ndarray) -> dict[str, Any]:
        if name == "synthetic":  # bench-tracking does not score people who are outside the picture
            rows = rows[(rows[:, 2] > 0) | (rows[:, 4] > 0)]
        law = np.array([trust.of(Grounds(*one)) for one in rows[:, :7].tolist()])
        before, after, true = rows[:, 0] * rows[:, 1] * rows[:, 7], law * rows[:, 7], rows[:, 8]
        return {
            when: {"bins": bins(said, true), "brier": round(float(np.square(said - true).mean()), 5)}
            for when, said in (("before", before), ("after", after))
        }

    return {
        "origin": "Fitted by tests/bench/fit_existence.py. UCY zara01 and zara02: A. Lerner, Y. Chrysanthou and D. "
        "Lischinski, Crowds by example, Computer Graphics Forum 26(3), 2007; ETH hotel: S. Pellegrini, A. Ess, K. "
        "Schindler and L. van Gool, You'll never walk alone, ICCV 2009; films: Mirror_World of CERIS_FishEye. None of "
        "their data is part of avcli.",
        "laws": {name: law._asdict() for name, law in trust._asdict().items()},
        "fit": {
            "command": command,
            "first seed": FIRST_DECIDING,
            "synthetic": synthetic,
            "walks": list(REAL),
            "worth": WORTH,
            "bins": "records, said, true",
            **{name: scores(name, rows) for name, rows in domains.items()},
        },
    }


def code() -> str:
    """A mark of the code that decides what the records are: the laws themselves do not."""
    here = Path(__file__).parent
    sources = [*Path(glmb.__file__).parent.glob("*.py"), *here.glob("*track*.py"), *here.glob("*_scenes.py")]
    sources += [*here.glob("walk*.py"), Path(__file__)]
    return hashlib.sha256(b"".join(one.read_bytes() for one in sorted(sources))).hexdigest()[:12]


def records_of_case(task: tuple[str, int], root: Path, kept: Path) -> np.ndarray:
    """See `records_of`; of a file in `kept`, if it is there.

    Ready cases are not kept: they are few, and may be others next time.
    """
    case, seed = task
    if Path(case).is_dir():
        return records_of(scene_of(case, seed, root))
    file = kept / f"{case}-{seed}.npy"
    if not file.exists():
        part = file.with_suffix(f".{os.getpid()}")
        with part.open("wb") as stream:
            np.save(stream, records_of(scene_of(case, seed, root)))
        part.rename(file)
    return np.asarray(np.load(file))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", type=Path, required=True, help="a checkout of OpenTraj")
    parser.add_argument("--films", type=Path, required=True, help="a directory of what film_cases.py makes of films")
    parser.add_argument("--seeds", type=int, default=4, help="scenes of each synthetic case, at least")
    parser.add_argument("--real-seeds", type=int, default=6, help="scenes of each set of real people")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--kept", type=Path, default=Path("bench-out"), help="where what was run is kept")
    parser.add_argument("--out", type=Path, default=FITTED, help="the file to write")
    options = parser.parse_args()
    synthetic = [name for name in SYNTHETIC if name not in LONG]
    films = sorted(str(one) for one in options.films.iterdir() if one.is_dir())
    counts = {
        "synthetic": {name: max(options.seeds, MORE.get(name, 0) // 4) for name in synthetic},
        **{place: {name: options.real_seeds for name in REAL if name.startswith(place)} for place in ("hotel", "zara")},
        "films": dict.fromkeys(films, 1),
    }
    domains, kept = {}, options.kept / f"existence-{code()}"
    kept.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(options.jobs) as pool:
        for domain, cases in counts.items():
            tasks = [(case, FIRST_DECIDING + k) for case, seeds in cases.items() for k in range(seeds)]
            parts = pool.map(partial(records_of_case, root=options.walks, kept=kept), tasks)
            domains[domain] = np.concatenate(list(parts))
            print(f"{domain}: {len(tasks)} scenes, {len(domains[domain])} records", file=sys.stderr)
    command = f"fit_existence.py --seeds {options.seeds} --real-seeds {options.real_seeds}"
    whole = described(domains, command, synthetic)
    options.out.write_text(json.dumps(whole, indent=1) + "\n")
    print(json.dumps(whole["fit"], indent=1))


if __name__ == "__main__":
    main()
