"""What the errors of each sensor are like, learnt from the detections: the scale of its noise, and its bias.

A detection lies at the person's place, plus the sensor's bias, plus an error that lasts, plus noise that differs from
record to record. The bias is constant: along x, along y, and forward in the direction of walking. The lasting error
(the room's echoes, the body's sway) is a Gauss-Markov process of each person. Its variance and that of the bias are
together the square of `Sensor.floor` before anything is learnt. The noise has the stated covariance times a factor, and
as much as the floor times another one.

A camera whose detections state more than a camera's usual noise, as by colour alone, errs by the same from picture to
picture (`common`). That part of what is stated is kept beside each position, and added to what is reported. Where one
camera sees people, what it states along its line of sight alone is no noise of their way either, but for a fifth: a
track that took it for noise would lag behind who walks.

What lasts must not average away, and cannot be told from the person's place. So the filter considers it without
estimating it: it keeps by what share each position follows the lasting error of each sensor (`Densities.lean`). A
sensor alone keeps its full weight. Of several, each has the weight that its whole error deserves.

Only differences between sensors can be observed. A bias that all have in common stays unknown, and the sensor whose
bias is known best beforehand keeps it best.

Source:
    S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3, 1966
    (considered errors);
    S. Särkkä and A. Nummenmaa, "Recursive noise adaptive Kalman filtering by variational Bayesian approximations", IEEE
    TAC 54(3), 2009 (the scale of noise).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from avcli.formats.sensors import CAMERA
from avcli.tracking import gaussian
from avcli.tracking.densities import Densities
from avcli.tracking.model import Corners, unobserved
from avcli.tracking.settings import Sensor

if TYPE_CHECKING:
    from avcli.tracking.association import Group
    from avcli.tracking.scan import Scan

LEAST, MOST = 0.01, 100.0  # bounds of the factors on variances of noise
WIDE = 1.0  # m², variance of a coordinate that was hardly observed: it says nothing of the noise
SURE = 0.9  # existence of a person, and probability of an association, from which is learnt
DRIFT = 1800.0  # s, after which what was learnt of a bias counts 1/e
SETTLE = 0.5  # s between two estimates of the biases

# Chosen on S1 to S4 (seeds from 100, synthetic and own detections) and on the walks hotel and zara01.
BELIEVED = 20.0  # detections that the stated noise is worth
SOON, LATER, ENOUGH = 4, 32, 60.0  # detections that are learnt from at once, until so many were, and then
KEEP = 0.998  # weight of what was learnt of the noise before, for each detection

# Chosen on eleven films of real people, S1 to S4 and random worlds by colour alone, of 1, .3, .2, .1 and .05.
WHITE = 0.2  # share of what a camera states along its line of sight alone that differs from picture to picture


class Between(NamedTuple):
    """What lasting errors add where n densities meet detections of one sensor.

    Attributes:
        unshared: (n,) m² per axis, to the variance of an innovation.
        shared: (n,) m² per axis, to the covariance of a position's error with its innovation.
    """

    unshared: np.ndarray
    shared: np.ndarray

    def take(self, rows: np.ndarray) -> Between:
        """Return those of some densities."""
        return Between(self.unshared.take(rows), self.shared.take(rows))


class Sure(NamedTuple):
    """The detections of one record whose people are sure; nothing is computed of them before it is learnt from them.

    Attributes:
        weight: K probabilities that these people caused them.
        rows: K densities.
        js: K detections.
        again: records in which a lasting error is about the same.
        scan: the record.
        people: all densities before it.
    """

    weight: list[float]
    rows: list[int]
    js: list[int]
    again: float
    scan: Scan
    people: Densities


class Pairs(NamedTuple):
    """K detections of one sensor, and the people who surely caused them as they were predicted.

    Attributes:
        weight: (K,) probabilities that they did.
        again: (K,) records in which a lasting error is about the same.
        z: (K, 2) m, without the bias.
        noise: (K, 2, 2) m², as corrected.
        floor: (K,) m² per axis of it, from the sensor's floor.
        mean, cov, mode: (K, M, 4), (K, M, 4, 4), (K, M), see `Densities`.
        lean: (K, S), see `Densities`.
        unshared: (K,) m² per axis, see `Between`.
    """

    weight: np.ndarray
    again: np.ndarray
    z: np.ndarray
    noise: np.ndarray
    floor: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    mode: np.ndarray
    lean: np.ndarray
    unshared: np.ndarray

    @staticmethod
    def of(sure: Sequence[Sure], sensors: int) -> Pairs:
        """Gather those of several records of one sensor; sensors: S, of which some may be newer than the records."""
        starts = accumulate([len(one.people) for one in sure], initial=0)
        rows = [start + row for start, one in zip(starts, sure, strict=False) for row in one.rows]
        starts = accumulate([len(one.scan.z) for one in sure], initial=0)
        js = [start + j for start, one in zip(starts, sure, strict=False) for j in one.js]
        of_people = ((one.people.mean, one.people.cov, one.people.mode) for one in sure)
        mean, cov, mode = (np.concatenate(one).take(rows, 0) for one in zip(*of_people, strict=True))
        lean, k = np.zeros((len(rows), sensors)), 0
        for one in sure:
            known = one.people.lean.take(one.rows, 0)
            lean[k : k + len(known), : known.shape[1]] = known
            k += len(known)
        of_scans = ((one.scan.z, one.scan.noise, one.scan.floor) for one in sure)
        z, noise, floor = (np.concatenate(one).take(js, 0) for one in zip(*of_scans, strict=True))
        unshared = np.concatenate([one.scan.between.unshared for one in sure]).take(rows)
        weight = np.array([weight for one in sure for weight in one.weight])
        again = np.array([one.again for one in sure for _ in one.rows])
        return Pairs(weight, again, z, noise, floor, mean, cov, mode, lean, unshared)


class Errors:
    """What is known of the errors of each sensor, in order of the tracker's columns.

    Attributes:
        known: sensor name -> what `described` said of it in another run.
        factor: (S, 2) on the stated noise, and on the floor as noise.
        worth: (S,) detections on which the factors rest.
        bias: (S, 3) m along x, along y, and forward.
        bias_sd: (S, 3) m.
        lasting: (S,) m² per axis, variance of what a sensor's detections of one person have in common.
    """

    def __init__(self, learn: bool = True, area: Corners | None = None) -> None:
        """Begin without sensors.

        Args:
            learn: whether to learn, or to keep what is known beforehand.
            area: two corners, m, where people may be; None: unknown.
        """
        self.learns = learn
        sides = zip(*area, strict=True) if area else ()
        self._unobserved = min((0.999 * unobserved(low, high) for low, high in sides), default=math.inf)  # m²
        self.known: Mapping[str, Mapping[str, Any]] = {}
        self.sensors: list[Sensor] = []
        self.factor, self.worth = np.ones((0, 2)), np.zeros(0)
        self.prior, self.prior_sd = np.zeros(0), np.zeros(0)  # of all biases, (3 S,)
        self.information, self.evidence = np.zeros((0, 0)), np.zeros(0)  # of all biases, from detections
        self.memory, self.rest = np.zeros(0), np.zeros(0)  # s and m² of the lasting errors without the biases
        self.last: list[float] = []  # s, of each sensor's last record
        self.waiting: list[list[Sure]] = []  # of each sensor: what it has not learnt from yet
        self.count: list[int] = []  # of pairs in them
        self.vague = False  # whether a sensor has stated more than usual noise
        self.learnt = self.settled = -math.inf  # s
        self._settle()

    def add(self, sensor: Sensor) -> None:
        """Let another sensor report from now on."""
        known = self.known.get(sensor.name, {})
        self.sensors.append(sensor)
        self.last.append(-math.inf)
        self.waiting.append([])
        self.count.append(0)
        factors = np.array([known.get("noise_factor", 1.0), known.get("floor_factor", 1.0)])
        self.factor = np.vstack([self.factor, factors.clip(LEAST, MOST)])
        self.worth = np.append(self.worth, min(known.get("detections", BELIEVED), 1 / (1 - KEEP)))
        usual = [sensor.bias_sd, sensor.bias_sd, sensor.offset_sd]
        self.prior = np.append(self.prior, known.get("bias", [0.0, 0.0, sensor.mouth_offset]))
        self.prior_sd = np.append(self.prior_sd, np.clip(known.get("bias_sd", usual), 1e-6, None))
        self.information, self.evidence = np.pad(self.information, (0, 3)), np.append(self.evidence, np.zeros(3))
        self.memory = np.append(self.memory, sensor.memory)
        self.rest = np.append(self.rest, max(sensor.floor**2 - np.square(usual).sum() / 2, 0.0))
        self._settle()

    def described(self, column: int) -> dict[str, Any]:
        """Return what is known of one sensor's errors, as plain numbers; lengths in m."""
        return {
            "noise_factor": float(self.factor[column, 0]),
            "floor_factor": float(self.factor[column, 1]),
            "detections": float(self.worth[column]),
            "bias": self.bias[column].tolist(),
            "bias_sd": self.bias_sd[column].tolist(),
            "lasting_sd": math.sqrt(self.lasting[column]),
        }

    # --- what the filter asks -----------------------------------------------------------------------------------------

    def corrected(self, column: int, z: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Correct detections of one sensor by what is known of its errors.

        Args:
            column: number of the sensor.
            z: (J, 2) m.
            noise: (J, 2, 2) m², as stated, with the square of the sensor's floor in it.

        Returns:
            Positions (J, 2) m without the bias, covariances (J, 2, 2) m² of the noise, and (J,) m² per axis of these
            that come from the floor.
        """
        if not len(z):
            return z, noise, np.zeros(0)
        if len(self.sensors) == 1:
            noise = noise - (1 - WHITE) * self._along(column, noise)
        on_told, on_floor = self.factor[column].tolist()
        xx, xy, yy = noise[:, 0, 0], noise[:, 0, 1], noise[:, 1, 1]
        half, middle = np.hypot((xx - yy) / 2, xy), (xx + yy) / 2
        least = np.maximum(middle - half, 0.0)
        floor = np.minimum(least, self.sensors[column].floor ** 2)
        scaled = on_told * noise + ((on_floor - on_told) * floor)[:, None, None] * gaussian.EYE2
        if on_told < 1 and max((middle + half).tolist()) > WIDE:  # what was hardly observed does not become exact
            most = middle + half
            along = (noise - least[:, None, None] * gaussian.EYE2) / np.maximum(2 * half, 1e-12)[:, None, None]
            scaled += np.where(most > WIDE, (1 - on_told) * (most - floor), 0.0)[:, None, None] * along
        return z - self.bias[column, :2], scaled, on_floor * floor

    def ahead(self, column: int) -> float:
        """Return how far in front of the body's axis a sensor localizes people, m."""
        return self.bias.item(column, 2)

    def predict(self, people: Densities, dt: float) -> None:
        """Let lasting errors change for dt s: as far as they do, what they were is noise of the positions."""
        keep = np.exp(-dt / self.memory)
        gone = np.add.reduce(people.lean * people.lean * ((1 - keep * keep) * self.lasting), 1)[:, None]
        people.cov[..., 0, 0] += gone
        people.cov[..., 1, 1] += gone
        people.lean = people.lean * keep

    def variance(self, lean: np.ndarray) -> np.ndarray:
        """Return the variance (n,) m² per axis of positions by lasting errors that they follow by shares (n, S)."""
        return np.add.reduce(
            lean * lean * self.lasting, -1
        )  # a product of matrices would depend on the order of sensors

    def covariances(self, people: Densities, rows: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the covariances (n, 2, 2) m² of the positions in n rows by errors that do not average away.

        The filter takes the common ones for noise; what it still counts of them is in its own covariance.
        """
        own = self.variance(people.lean.take(rows, 0))[:, None, None] * gaussian.EYE2
        if not self.vague:
            return own
        common, reach = people.common.take(rows, 0), people.reach.take(rows)
        whole = np.maximum(np.trace(common, 0, 1, 2), 1e-12)
        return own + common * np.maximum(1 - reach * reach / whole, 0.0)[:, None, None]

    def common(self, column: int, stated: np.ndarray) -> np.ndarray | None:
        """Return the part (J, 2, 2) m² of stated covariances that all detections of one person have in common.

        From picture to picture a camera's detections vary by little. Where it states more than a camera's usual noise,
        the place rests on what it cannot see, a person's height or hidden feet, and is off by the same while that
        holds.

        Args:
            column: number of the sensor that stated them.
            stated: (J, 2, 2) m², with the square of the sensor's floor in it.

        Returns:
            None: no sensor has stated more so far.
        """
        sensor = self.sensors[column]
        usual = sensor.sigma[0] * sensor.sigma[1]
        more = max(stated.ravel().tolist(), default=0.0) > usual
        self.vague = self.vague or more
        if not self.vague:
            return None
        if not more or sensor.kind != CAMERA:
            return np.zeros(stated.shape)
        return _beyond(stated, usual) - WHITE * self._along(column, stated)

    def _along(self, column: int, stated: np.ndarray) -> np.ndarray:
        """Return the part (J, 2, 2) m² of stated covariances along a line of sight alone, where one camera sees people.

        It is what exceeds the usual noise and what is stated across: how far away is somebody of unknown height? Noise
        that a camera states all around is taken as it is, and so is all of it where other sensors tell the distance,
        and where the distance was not observed.
        """
        sensor = self.sensors[column]
        usual = sensor.sigma[0] * sensor.sigma[1]
        if len(self.sensors) > 1 or sensor.kind != CAMERA or max(stated.ravel().tolist(), default=0.0) <= usual:
            return np.zeros(stated.shape)
        variances, axes = np.linalg.eigh(stated)
        along = np.maximum(variances[:, 1] - np.maximum(variances[:, 0], usual), 0.0) * (
            variances[:, 1] < self._unobserved
        )
        return along[:, None, None] * (axes[:, :, 1:] * axes[:, None, :, 1])

    def between(self, lean: np.ndarray, column: int) -> Between:
        """Compute what lasting errors add where densities with shares lean (n, S) meet one sensor's detections."""
        spread, lasting = self.variance(lean), self.lasting.item(column)
        own = lasting * lean[:, column]
        shared = spread - own
        return Between(shared + (lasting - own), shared)

    # --- learning -----------------------------------------------------------------------------------------------------

    def learn(self, time: float, scan: Scan, groups: Iterable[Group], people: Densities) -> None:
        """Learn from the detections of one record whose people are sure.

        Args:
            time: s.
            scan: the record.
            groups: the joint hypotheses after it.
            people: the densities before it.
        """
        column = scan.column
        dt, self.last[column] = time - self.last[column], time
        if not self.learns:
            return
        weight, rows, js = _certain(groups, scan)
        waiting = self.waiting[column]
        if rows:
            again = 1 + 2 * self.memory.item(column) / max(dt, 1e-3)
            waiting.append(Sure(weight, rows, js, again, scan, people))
            self.count[column] += len(rows)
        if waiting and self.count[column] >= (SOON if self.worth[column] < ENOUGH else LATER):
            self.waiting[column], self.count[column] = [], 0
            self._learn(time, column, Pairs.of(waiting, len(self.count)))

    def widen(self, column: int, times: float) -> None:
        """Take a sensor's noise for larger, its variance so many times, and doubt what was learnt of it."""
        self.factor[column, 0] = min(self.factor[column, 0] * times, MOST)
        self.worth[column] = min(self.worth[column], BELIEVED)

    def _learn(self, time: float, column: int, pairs: Pairs) -> None:
        """Learn from detections of one sensor since it learnt the last time."""
        mean, cov = gaussian.moments(pairs.mean, pairs.cov, pairs.mode)
        vx, vy = mean[:, 2], mean[:, 3]
        speed = np.sqrt(vx * vx + vy * vy + cov[:, 2, 2] + cov[:, 3, 3] + 1e-12)
        heading = mean[:, 2:] / speed[:, None]  # as far as it is known, at most 1 long
        innovation = pairs.z - mean[:, :2] - self.bias[column, 2] * heading
        s = cov[:, :2, :2] + pairs.noise + pairs.unshared[:, None, None] * gaussian.EYE2
        self._learn_noise(column, pairs, innovation, s)
        if len(self.sensors) > 1:
            self._learn_bias(time, column, pairs, innovation, heading, (s[:, 0, 0] + s[:, 1, 1]) / 2)

    def _learn_noise(self, column: int, pairs: Pairs, innovation: np.ndarray, s: np.ndarray) -> None:
        """Learn the factors of the noise: inverse-gamma posteriors of both, given the expected squares of their noise.

        innovation: (K, 2) m; s: (K, 2, 2) m², its covariance.
        """
        det = s[:, 0, 0] * s[:, 1, 1] - s[:, 0, 1] * s[:, 1, 0]
        inverse = s[:, ::-1, ::-1] * gaussian.COFACTOR / det[:, None, None]
        excess = inverse @ (innovation[:, :, None] * innovation[:, None] - s) @ inverse  # 0 in the mean if all is right
        all_told, floor = (excess * pairs.noise).sum((1, 2)), pairs.floor * (excess[:, 0, 0] + excess[:, 1, 1])
        new, on_told, on_floor = (pairs.weight @ np.column_stack([np.ones(len(s)), all_told - floor, floor])).tolist()
        before = self.worth.item(column) * KEEP**new
        for k, off in enumerate((on_told, on_floor)):
            factor = self.factor.item(column, k) * (before + new + off / 2) / (before + new)
            self.factor[column, k] = min(max(factor, LEAST), MOST)
        self.worth[column] = before + new

    def _learn_bias(
        self,
        time: float,
        column: int,
        pairs: Pairs,
        innovation: np.ndarray,
        heading: np.ndarray,
        variance: np.ndarray,
    ) -> None:
        """Learn how the sensor's bias differs from those of the sensors that the positions follow.

        innovation: (K, 2) m; heading: (K, 2) direction of walking; variance: (K,) m² per axis, of the innovation.
        """
        lean = -pairs.lean / np.maximum(pairs.lean.sum(1), 1e-9)[:, None]
        lean[:, column] += 1  # by what share of each bias an innovation is off
        parts = np.zeros((len(lean), 2, len(self.sensors), 3))
        parts[:, 0, :, 0] = parts[:, 1, :, 1] = lean
        parts[..., 2] = lean[:, None] * heading[:, :, None]
        of = parts.reshape(2 * len(lean), -1)
        weight = pairs.weight / (variance + pairs.unshared * pairs.again)
        weight = (weight[:, None, None, None] * parts).reshape(of.shape)
        unbiased = innovation.ravel() + of @ (self.bias.ravel() - self.prior)  # by the prior's bias
        keep = math.exp((self.learnt - time) / DRIFT)
        self.information = self.information * keep + weight.T @ of
        self.evidence = self.evidence * keep + weight.T @ unbiased
        self.learnt = time
        if time - self.settled >= SETTLE:
            self.settled = time
            self._settle()

    def _settle(self) -> None:
        """Estimate the biases from prior and detections, a Bayesian linear regression, and what is left to consider.

        The last digits, which depend on the order of the sensors, are rounded away, so that names have no influence.
        """
        cov = np.linalg.inv(self.information + np.diag(self.prior_sd**-2))
        self.bias = (self.prior + cov @ self.evidence).reshape(-1, 3).round(9)
        self.bias_sd = np.sqrt(cov.diagonal().reshape(-1, 3)).round(9)
        self.lasting = self.rest + np.square(self.bias_sd).sum(1) / 2


def _certain(groups: Iterable[Group], scan: Scan) -> tuple[list[float], list[int], list[int]]:
    """Return the detections whose people are sure: probabilities, rows and detections."""
    weight, rows, js = [], [], []
    for group in groups:
        for at, (row, j) in enumerate(group.hypotheses[0].pairs):
            if row < 0 or j < 0 or scan.existence[row] < SURE or scan.noise[j, 0, 0] + scan.noise[j, 1, 1] > WIDE:
                continue
            share = math.fsum([math.exp(one.weight) for one in group.hypotheses if one.pairs[at] == (row, j)])
            if share > SURE:
                weight.append(min(share, 1.0))
                rows.append(row)
                js.append(j)
    return weight, rows, js


def leaning(
    lean: np.ndarray, column: int, variance: np.ndarray, mode: np.ndarray, noise: np.ndarray, between: Between
) -> np.ndarray:
    """Return by what shares (n, S) positions follow lasting errors after density k was updated by detection k.

    Args:
        lean: (n, S) before.
        column: number of the sensor.
        variance: (n, M) m² per axis, of the position in each model before.
        mode: (n, M) probabilities of the models after.
        noise: (n, 2, 2) m².
        between: of the n densities and the sensor.
    """
    shared = np.maximum(between.shared[:, None], gaussian.LEAST_SHARED * variance)
    added = (noise[:, 0, 0] + noise[:, 1, 1]) / 2 + between.unshared
    pull = np.add.reduce(mode * (variance + shared) / (variance + added[:, None]), 1)
    lean = lean * (1 - pull)[:, None]
    lean[:, column] += pull
    return lean


def followed(common: np.ndarray, detected: np.ndarray, place: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the covariances (n, 2, 2) m² of common errors after density k was updated by detection k.

    The errors of a person's detections agree, so that those of a weighted mean are their weighted mean.

    Args:
        common: (n, 2, 2) m², before.
        detected: (n, 2, 2) m², of the detections, see `common`.
        place: (n, 2, 2) m², of the positions before.
        noise: (n, 2, 2) m².
    """
    change = place @ np.linalg.solve(place + noise, detected - common)
    return _beyond(common + (change + change.swapaxes(1, 2)) / 2, 0.0)


def _beyond(cov: np.ndarray, usual: float) -> np.ndarray:
    """Return how far the variances along the axes of covariances (n, 2, 2) m² exceed a usual one in m²."""
    variances, axes = np.linalg.eigh(cov)
    return (axes * np.maximum(variances - usual, 0.0)[:, None]) @ axes.swapaxes(1, 2)
