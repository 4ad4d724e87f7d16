"""The densities after a record: each combination of a density and a detection that is needed, computed once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, count

import numpy as np

from avcli.tracking import gaussian, partial
from avcli.tracking.association import MISSED, STRAY, Group, Pair
from avcli.tracking.births import TENTATIVE, Birth
from avcli.tracking.densities import Densities
from avcli.tracking.errors import followed, leaning
from avcli.tracking.features import Features
from avcli.tracking.hypotheses import ABSENT
from avcli.tracking.scan import Scan

FORGET = 5e-3  # expected number of people below which a tentative person who had a label loses it
TENTATIVES = 150  # tentative densities kept


@dataclass(slots=True)
class Needed:
    """What must be computed after a record; the rows after it stand in this order.

    Attributes:
        missed: rows of labelled people who were not detected.
        staying: rows of tentative people who were not detected.
        strayed: (row, STRAY less the detection) of labelled people whose detection tells nothing of their place.
        detected: (row, detection) of labelled people.
        renewed: (row, detection) of tentative people.
        fresh: detections of people detected for the first time.
    """

    missed: list[int]
    staying: list[int]
    strayed: list[Pair]
    detected: list[Pair]
    renewed: list[Pair]
    fresh: list[int]

    def rows(self) -> dict[Pair, int]:
        """Return (row before, detection) -> row after, of all but the fresh ones."""
        row_of = {(row, MISSED): k for k, row in enumerate(self.missed)}
        old = len(self.missed) + len(self.staying)
        row_of.update(zip(self.strayed + self.detected + self.renewed, count(old), strict=False))
        row_of[ABSENT, MISSED] = ABSENT
        return row_of

    def fresh_rows(self) -> dict[int, int]:
        """Return detection -> row after, of the people detected for the first time."""
        if not self.fresh:
            return {}
        before = len(self.missed) + len(self.staying) + len(self.strayed + self.detected + self.renewed)
        return {j: before + k for k, j in enumerate(self.fresh)}


def needed(
    scan: Scan, people: Densities, tentative: Sequence[int], groups: Iterable[Group], births: Iterable[Birth]
) -> Needed:
    """Find what must be computed: what the hypotheses and births mention, and the tentative people who may be left."""
    pairs = dict.fromkeys(chain.from_iterable([h.pairs for group in groups for h in group.hypotheses]))
    left = {i: scan.existence[i] * (1 - scan.p_detect[i]) for i in tentative}
    staying = [i for i in tentative if left[i] > TENTATIVE]
    for i in staying:
        if left[i] < FORGET:
            people.label[i] = -1
    if len(staying) > TENTATIVES:
        staying = sorted(sorted(staying, key=lambda i: -left[i])[:TENTATIVES])
    return Needed(
        missed=[row for row, j in pairs if row >= 0 and j == MISSED],
        staying=staying,
        strayed=[pair for pair in pairs if pair[1] <= STRAY],
        detected=[pair for pair in pairs if pair[1] >= 0],
        renewed=[(birth.source, birth.detection) for birth in births if birth.source >= 0],
        fresh=[birth.detection for birth in births if birth.source < 0],
    )


def updated(scan: Scan, people: Densities, needed: Needed, time: float, features: Features) -> Densities:
    """Compute the densities after a record at a time in s, all but the fresh ones, in the order of `Needed`."""
    parents, pairs = needed.missed + needed.staying, needed.detected + needed.renewed
    n, unseen, column = len(needed.missed), len(parents), scan.column
    old = unseen + len(needed.strayed)
    existence, detectable, p_detect = scan.existence, scan.detectable, scan.p_detect
    new = people.take(parents + [row for row, _ in needed.strayed + pairs])
    new.existence[unseen:], new.detectable[unseen:, column] = 1.0, 1.0
    if parents:
        overlooked = [1 - p_detect[i] for i in parents]
        kept = [existence[i] * o for i, o in zip(parents, overlooked, strict=True)]
        exist = [e / max(1 - existence[i] + e, 1e-12) for i, e in zip(needed.missed, kept, strict=False)]
        new.existence[:unseen] = exist + kept[n:]
        new.detectable[:unseen, column] = [
            (detectable[i] - p_detect[i]) / max(o, 1e-12) for i, o in zip(parents, overlooked, strict=True)
        ]
    if scan.covered is not None:  # who was missed is rather where the sensor does not see
        able = np.array([scan.p_sensor * detectable[i] for i in parents])
        new.mode[:unseen] *= 1 - able[:, None] * scan.covered[parents]
        new.mode[:unseen] /= new.mode[:unseen].sum(1, keepdims=True)
    if pairs:
        rows, js = np.array(pairs).T
        noise, between = scan.noise.take(js, 0), scan.between.take(rows)
        if scan.common is not None:
            place = gaussian.moments(new.mean[old:], new.cov[old:], new.mode[old:])[1][:, :2, :2]
            new.common[old:] = followed(new.common[old:], scan.common.take(js, 0), place, noise)
        variance = (new.cov[old:, :, 0, 0] + new.cov[old:, :, 1, 1]) / 2
        before = None if scan.view is None else new.take(range(old, len(new)))
        new.mean[old:], new.cov[old:], new.mode[old:] = gaussian.update(
            new.mean[old:],
            new.cov[old:],
            new.mode[old:],
            scan.z.take(js, 0),
            noise,
            scan.expected.take(rows, 0),
            scan.gain_by_model[rows, :, js],
            between.shared,
        )
        new.lean[old:] = leaning(new.lean[old:], column, variance, new.mode[old:], noise, between)
        if before is not None and scan.view is not None:
            some = [k for k, (_, j) in enumerate(pairs) if j in scan.view.number]
            at = [old + k for k in some]
            new.mean[at], new.cov[at], new.mode[at] = partial.update(
                before.take(some), scan.view, [pairs[k] for k in some], scan.gain_by_model[rows, :, js][some]
            )
            new.lean[at] = before.lean[some]
        new.seen[old:, column] = time
        new.place[old:], variance = gaussian.places(new.mean[old:], new.cov[old:], new.mode[old:])
        new.reach[old:] = np.sqrt(variance)
        new.hits[old:, column] += 1
        new.told[old:] += told(scan, pairs, scan.gain[rows, js])
        new.doubt[old:, column] = 0.0 if scan.doubt is None else np.minimum(new.doubt[old:, column], scan.doubt[js])
        if scan.evidence:
            new.traits[old:] = features.update(new.traits[old:], scan.evidence, rows, js)
    return new


def told(scan: Scan, pairs: Sequence[Pair], gain: np.ndarray) -> np.ndarray:
    """Return by how many nats (n,) detections are likelier of people in some rows than of clutter of 1 in a record.

    pairs: row and detection; gain: (n,) of these, see `Scan`.
    """
    able = [scan.p_hit[row] * (scan.expected_clutter / scan.clutter[j]) for row, j in pairs]
    return np.log(np.maximum(able * gain, 1e-300))
