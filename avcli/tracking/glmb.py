"""The multi-sensor generalized labelled multi-Bernoulli (GLMB) filter for people in a room.

Labelled people are Bernoullis (a density and a probability of existence, which stands for the pair of GLMB hypotheses
with and without the label) within joint hypotheses about which detection belongs to whom; people who interact share a
cluster of hypotheses. People without a label form a Poisson process: a uniform part, and one Gaussian for each
tentative person, so that clutter costs array rows and no hypotheses. Whether each sensor can detect each person
(occluded, silent) is a hidden two-state Markov chain of the person. Every record updates the filter at its own time, so
sensors may have any rate and offset.

Source:
    B.-N. Vo, B.-T. Vo and M. Beard, "Multi-sensor multi-object tracking with the generalized labeled multi-Bernoulli
    filter", IEEE TSP 67(23), 2019 (the filter);
    J. L. Williams, "Marginal multi-Bernoulli filters", IEEE TAES 51(3), 2015 (the Poisson process) and "Hybrid Poisson
    and multi-Bernoulli filters", FUSION 2012 (recycling);
    S. Reuter, B.-T. Vo, B.-N. Vo and K. Dietmayer, "The labeled multi-Bernoulli filter", IEEE TSP 62(12), 2014 (LMB).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import eq
from typing import Any, NamedTuple

import numpy as np

from avcli.formats.features import Feature
from avcli.formats.sensors import CAMERA
from avcli.tracking import association, blindness, gaussian, hypotheses, journal, partial, prediction
from avcli.tracking.association import Group, Hypothesis, Pair
from avcli.tracking.births import (
    BORN,
    TENTATIVE,
    Birth,
    Undetected,
    births,
    first_detections,
    newcomers,
    other_detections,
    overlooked,
    recurring,
    weighed,
)
from avcli.tracking.coverage import watched
from avcli.tracking.densities import NEVER, Densities
from avcli.tracking.errors import Errors
from avcli.tracking.false_places import FalsePlaces
from avcli.tracking.features import Features
from avcli.tracking.hypotheses import ABSENT, FEATURED, INDEPENDENT, Cluster
from avcli.tracking.learning import SURE_HITS, Habits
from avcli.tracking.model import BLUR, NEAR, REPORT, THERE, Population, Track
from avcli.tracking.posterior import needed, updated
from avcli.tracking.rates import CHECKED, Rates, logit
from avcli.tracking.recognition import Gallery, Left
from avcli.tracking.scales import WIDER, Scales
from avcli.tracking.scan import Scan, distinct, likelihoods, possible, strays
from avcli.tracking.settings import Sensor, Settings
from avcli.tracking.smoothing import End, Node, cut
from avcli.tracking.trust import TRUST
from avcli.tracking.unseen import UnseenMap

# Chosen by hand, as what they save in time against what they cost in accuracy; no command fits them.
PROMOTE = 0.1  # expected number at which a tentative person gets a label
SHOWN = 0.45  # existence, as it is reported, from which a person is: lower, ghosts stay; higher, who is hidden goes
RECYCLE = 0.03  # existence below which a labelled person becomes tentative again
ROUNDS = 20  # of weighing detections that are many more than were expected
PRUNED = 100  # new labels, after which notes about old ones are dropped


class Labelled(NamedTuple):
    """One labelled person now.

    Attributes:
        label: of the person.
        row: the density, that of the best joint hypothesis, so that two people are never taken for one.
        existence: probability.
        meant: probability that the first detection was a person at all, who may have left since.
    """

    label: int
    row: int
    existence: float
    meant: float


class GLMB:
    """The filter: call `update` with records in order of time; ask `tracks` at any time not before the last record.

    >>> from avcli.tracking.settings import Settings, sensor
    >>> tracker = GLMB(Settings(), Population(), [sensor("ceiling")])
    >>> for k in range(10):  # a person walks along x at 1 m/s
    ...     tracker.update(k / 10, "ceiling", np.array([[1 + k / 10, 2.0]]), 0.01 * np.eye(2)[None])
    >>> [(track.label, track.state[:2].round(1).tolist()) for track in tracker.tracks(1.0)]
    [(0, [2.0, 2.0])]
    """

    def __init__(
        self,
        settings: Settings,
        population: Population,
        sensors: Iterable[Sensor] = (),
        *,
        factorise: bool = False,
        record: bool = False,
        explain: bool = False,
    ) -> None:
        """Begin without people.

        Args:
            settings: of which birth, learn, newborn, show and hypotheses are used.
            population: how people come, move, stay and leave.
            sensors: those that may report (others: `add`).
            factorise: keep only each label's marginal after every record (the LMB filter).
            record: keep what smoothing needs.
            explain: keep an account of every record, see `accounts`.
        """
        self.settings, self.population, self.factorise, self.record = settings, population, factorise, record
        self.people = Densities.empty(len(population.motion.models))
        self.features, self.gallery = Features(), Gallery()
        self.clusters: list[Cluster] = []
        self.tentative: list[int] = []  # rows of people without a label
        self.labelled_rows: list[int] = []
        self.likely_rows: list[int] = []  # of those: rows of the best joint hypotheses
        self.habits = Habits(population, settings.learn)
        self.undetected: Undetected | UnseenMap = Undetected(population, self.habits.entries)
        self.time, self.begun = 0.0, False  # s, of the last record; whether there was one
        self.sensors: list[Sensor] = []
        self.column: dict[str, int] = {}
        self.rates: list[Rates] = []
        self.known: dict[str, Any] = {}  # sensor name -> what another run has learnt
        self.detectable, self.turnover = np.zeros(0), np.zeros(0)  # of each sensor: see `rates.Hiding`
        self.last_record: list[float] = []  # s
        self.errors = Errors(settings.learn, population.area)
        self.scales: list[Scales] = []
        self.false_places = FalsePlaces(settings.learn)
        self.pairs = self.near = 0  # of people and detections so far, and those of them within the gate
        self.next_label, self.pruned = 0, PRUNED  # and that at which what is known of labels is pruned next
        self.looked: dict[int, float] = {}  # s, by column: the last record with a direction or a range
        self.retired: dict[int, End] = {}
        self.lost: set[int] = set()  # rows after a record, see `unseen.UnseenMap.lost`
        self.journal: list[dict[str, Any]] | None = [] if explain else None
        self.born: list[dict[str, Any]] = []  # of the last record, as the journal has them
        self.died: list[dict[str, Any]] = []
        for one in sensors:
            self.add(one)

    def add(self, sensor: Sensor) -> None:
        """Let another sensor report from now on."""
        self.column[sensor.name] = len(self.sensors)
        self.sensors.append(sensor)
        self.rates.append(Rates(sensor))
        self.errors.add(sensor)
        self.scales.append(Scales(sensor))
        self.habits.log_clutter.append(math.log(sensor.clutter + 1e-9))
        self.false_places.add()
        if sensor.name in self.known:
            self.rates[-1].restore(self.known[sensor.name])
            self.false_places.restore(-1, self.known[sensor.name].get("false_places", []))
        people = self.people
        people.lean = np.column_stack([people.lean, np.zeros(len(people))])
        people.detectable = np.column_stack([people.detectable, np.full(len(people), sensor.detectable())])
        people.seen = np.column_stack([people.seen, np.full(len(people), NEVER)])
        people.hits = np.column_stack([people.hits, np.zeros(len(people))])
        people.counted = np.column_stack([people.counted, np.zeros(len(people))])
        people.doubt = np.column_stack([people.doubt, np.ones(len(people))])
        if sensor.coverage is None or sensor.coverage.whole or isinstance(self.undetected, UnseenMap):
            self.undetected.add(sensor)
        else:
            self.undetected = UnseenMap(self.population, self.habits, self.sensors)
        self.detectable, self.turnover = np.append(self.detectable, 0.0), np.append(self.turnover, 0.0)
        self._know_hiding(-1)
        self.last_record.append(self.time)

    def state(self) -> dict[str, Any]:
        """Return what was learnt, as `restore` takes it: numbers and lists of numbers."""
        sensors = {
            name: {
                **self.rates[k].state(),
                "errors": self.errors.described(k),
                "false_places": self.false_places.state(k),
            }
            for name, k in self.column.items()
        }
        return {**self.habits.state(), "sensors": {**self.known, **sensors}}

    def news(self) -> list[str]:
        """Return sentences for the user, since the last call: false places that were found, features not used."""
        return self.false_places.news([one.name for one in self.sensors]) + self.features.news()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what another run in the same room has learnt, before the first record.

        Raises:
            ValueError: it was learnt in a room of another size.
        """
        self.habits.restore(state)
        self.known = dict(state["sensors"])
        self.errors.known = {name: one["errors"] for name, one in self.known.items()}

    # --- predict ------------------------------------------------------------------------------------------------------

    def predict(self, time: float) -> None:
        """Predict to a time (s); a time in the past counts as the present."""
        if not self.begun:
            self.time, self.begun = time, True
        dt = round(time - self.time, 9)
        if dt <= 0:
            return
        self.time = time
        population, people = self.population, self.people
        self.habits.wait(time, dt)
        self.undetected.predict(dt)
        if len(people):
            prediction.evade(people, self.labelled_rows, self.likely_rows, population, dt)
            before = people.mean, people.cov, people.mode
            survival = np.exp(-dt * self.habits.leaving(people.mean[:, 0]))
            step = gaussian.predict(*before, population.motion, dt)
            people.mean, people.cov, people.mode = step.mean, step.cov, step.mode
            lasting = self.errors.covariances(people, range(len(people))) if self.record else None
            self.errors.predict(people, dt)
            if lasting is not None:
                people.node = Node.steps(people, before, step, survival, lasting, time)
            people.existence = people.existence * survival
        if self.sensors:
            mix, rest = np.exp(-dt * self.turnover), self.detectable
            self.undetected.relax(rest, mix)
            people.detectable = rest + (people.detectable - rest) * mix

    # --- update -------------------------------------------------------------------------------------------------------

    def update(
        self,
        time: float,
        name: str,
        z: np.ndarray,
        noise: np.ndarray,
        score: np.ndarray | None = None,
        features: Mapping[str, Feature] | None = None,
        shown: partial.Partial | None = None,
    ) -> None:
        """Update with one record of one sensor, see `trackers.Tracker.update` and `trackers.Partly`."""
        self.predict(time)
        now = self.time
        cells: dict[int, int] = {}
        if shown is not None:
            order = partial.in_order(shown, z, noise)
            shown, z, noise = shown.take(order), z[order], noise[order]
            score = None if score is None else score[order]
            features = {kind: one.take(order) for kind, one in (features or {}).items()}
            cells = self._seek(name, shown)
        column = self.column[name]
        rates, since = self.rates[column], now - self.last_record[column]
        if since > CHECKED or rates.weight < 1:
            rates.settle(since)
        scan = self._scan(name, z, noise, score, features or {}, shown, cells)
        tentative = [*self.tentative, *cells]
        settings = self.settings
        poisson = settings.birth == "poisson"
        from_tentative, from_undetected = first_detections(
            scan, self.people, tentative, self.likely_rows, self.population.body, poisson
        )
        if shown is not None:
            from_undetected[shown.columns()] = 0.0  # they are in the cells
        birth = (np.add.reduce(from_tentative, 0) + from_undetected if tentative else from_undetected).tolist()
        background = [c + b for c, b in zip(scan.clutter, birth, strict=True)]
        groups, unclaimed = self._associate(scan, background)
        self.errors.learn(now, scan, groups, self.people)
        if settings.learn and shown is None and self.scales[scan.column].due():
            self._widen(scan)
        more, full = 1.0, False
        if shown is None and rates.doubtful():
            there, false_ones = recurring(
                scan, unclaimed, self.people, tentative, self.likely_rows, self.population.body
            )
            full = bool(there.any())
        if full:
            rates.take_back()
            more = false_ones / scan.expected_clutter
            from_tentative *= np.maximum(there / [max(scan.existence[i], 1e-12) for i in tentative], 1.0)[:, None]
            birth = (np.add.reduce(from_tentative, 0) + from_undetected).tolist()
            background = [c * more + b for c, b in zip(scan.clutter, birth, strict=True)]
        real = [b / whole for b, whole in zip(birth, background, strict=True)]
        others = other_detections if shown is None else partial.other_detections
        room, twice = others(scan, unclaimed, real, self.population.body)
        birth = [b * left for b, left in zip(birth, room, strict=True)]
        if shown is None:
            self.false_places.learn(scan, self.people, self.likely_rows, birth, groups)
        existence, false, again = weighed(scan, unclaimed, birth, twice, more)
        if settings.learn:
            unknown = math.fsum(unclaimed)
            if not full and rates.surprised(unknown, self.undetected.due(scan)):
                for _ in range(ROUNDS):
                    more = rates.clutter_with(math.fsum(false)) / scan.expected_clutter
                    existence, false, again = weighed(scan, unclaimed, birth, twice, more)
            hits, misses = association.hits_and_misses(groups, scan)
            rates.learn(math.fsum(false), hits, misses, math.fsum(again), unknown)
            self._learn(groups, scan)
        self.habits.log_clutter[scan.column] = math.log(max(rates.clutter, 1e-9))
        if score is not None:
            rates.learn_score(scan.odds, scan.near, [1 - f for f in false])
        if scan.evidence:
            self.features.learn(self.people, scan.evidence, groups)
        newborn = None if poisson else settings.newborn
        whole = unclaimed if shown is None else shown.whole_only(unclaimed)
        revealed = births(whole, existence, tentative, from_tentative, from_undetected, newborn)
        if shown is not None:
            revealed += partial.revealed(shown, unclaimed, existence, tentative, from_tentative)
        self.born, self.died = [], []
        if self.journal is not None:
            known = self.labelled()
            before = {str(one.label): one.existence for one in known}
            errors = self.errors.described(scan.column)
            false_places = self.false_places.state(scan.column)
            account = journal.account(
                now, scan, rates, groups, unclaimed, existence, birth, before, errors, false_places
            )
            journal.add_features(account, scan, self.people.label, self.likely_rows)
            rows = [one.row for one in known]
            leaving = self.habits.leaving(self.people.mean.take(rows, 0)[:, 0])
            journal.add_beliefs(account, rates, leaving, self.people.seen.take(rows, 0).max(1, initial=NEVER))
            self.journal.append({**account, "born": self.born, "died": self.died})
        self.last_record[scan.column] = now
        self.habits.absences.record(now)
        self._rebuild(scan, groups, revealed, now, false)
        if scan.doubt is not None and scan.sensor.kind == CAMERA:
            self._believe_who_went(scan.column)
        if self.gallery.fresh and scan.evidence:
            self._recognise()
        self.undetected.update(scan)
        if self.looked:
            self._share(scan)

    def _scan(
        self,
        name: str,
        z: np.ndarray,
        noise: np.ndarray,
        score: np.ndarray | None,
        features: Mapping[str, Feature],
        shown: partial.Partial | None,
        cells: Mapping[int, int],
    ) -> Scan:
        """Weigh a record against each density."""
        if shown is None:
            z, noise, score, order = distinct(z, noise, score)
        else:
            order = list(range(len(z)))
        column, people = self.column[name], self.people
        sensor, rates = self.sensors[column], self.rates[column]
        stated = noise
        z, noise, floor = self.errors.corrected(column, z, noise)
        ahead, between = self.errors.ahead(column), self.errors.between(people.lean, column)
        if len(z):
            expected = gaussian.innovation(people.mean, people.cov, ahead, between.unshared)
        else:
            expected = np.zeros((*people.mode.shape, 6))  # of nobody's detection
        gain, gain_by_model = likelihoods(people.mode, expected, z, noise)
        seen = None
        if shown is not None:
            seen = self._view(column, shown, cells)
            gain, gain_by_model = partial.with_likelihoods(gain_by_model, seen, people, cells)
        likely, evidence = possible(gain), None
        astray = strays(likely, self.labelled_rows, people.mode, expected, z) if shown is None else {}
        if features:
            features = {kind: one.take(order) for kind, one in features.items()}
            anywhere = gain.copy()
            for row, some in astray.items():
                for j, density in some:
                    anywhere[row, j] += density
            evidence = self.features.weigh(people, self.likely_rows, self.time, z, anywhere, features)
            if evidence is not None:
                gain = gain * evidence.ratio
                likely = possible(gain)
                astray = {
                    row: [(j, density * evidence.ratio.item(row, j)) for j, density in some]
                    for row, some in astray.items()
                }
        odds = [math.nan] * len(z) if score is None else [logit(one) for one in score.tolist()]
        near = [1.0] * len(z)
        doubt = None if score is None else np.array([0.0 if one != one else 1 - one for one in score.tolist()])
        if score is not None and len(z) and sensor.score_within < math.inf:  # the score knows nothing of the floor
            near = gaussian.odds_within(stated - sensor.floor**2 * gaussian.EYE2, sensor.score_within)
        surface = sensor.field(self.population.surface)
        clutter = max(rates.clutter, 1e-9) / surface
        local = self.false_places.density(column, z)
        factors = [1.0] * len(z) if score is None else rates.clutter_factors(odds, near)
        clutters = [clutter * factor + more for factor, more in zip(factors, local, strict=True)]
        covered = None
        if sensor.coverage and not sensor.coverage.whole:
            covered = sensor.coverage.about(people.mean[..., :2])
        new = self.undetected.arriving(z, rates.detection, column)
        if shown is not None:
            new = shown.whole_only(new)
            for j in shown.columns():
                clutters[j] *= surface / shown.volume(j, self.population)
        dt = self.time - self.last_record[column]
        # Who was detected once and is missed was hardly a person, and tells nothing of a sensor that may be blind.
        often = (np.add.reduce(people.hits, 1) >= SURE_HITS).tolist()
        known = people, self.labelled_rows, [row for row in self.likely_rows if often[row]], self.habits.leaving
        record = blindness.Record(column, self.time, dt, *known, covered, likely, clutters, new)
        sight = blindness.weigh(record, self.rates)
        return Scan(
            sensor,
            column,
            z,
            noise,
            floor,
            self.errors.common(column, stated),
            ahead,
            between,
            odds,
            doubt,
            near,
            expected,
            gain,
            gain_by_model,
            likely,
            astray,
            sight.existence,
            sight.detectable,
            clutters,
            max(rates.clutter, 1e-9),
            rates.again,
            local,
            sight.p_sensor,
            sight.p_newcomer,
            sight.newcomers,
            sight.p_detect,
            sight.p_hit,
            evidence,
            covered,
            shown,
            seen,
        )

    def _believe_who_went(self, column: int) -> None:
        """Stop doubting the people whom a camera saw walk away: what it falsely takes for people stays where it is."""
        people, doubt = self.people, self.people.doubt[:, column].tolist()
        rows = [row for row in self.labelled_rows if doubt[row]]
        for row, place in zip(rows, people.centres(rows)[:, :2].tolist() if rows else (), strict=True):
            if self.false_places.elsewhere(people.label[row], place):
                people.doubt[row, column] = 0.0

    def _share(self, scan: Scan) -> None:
        """Let the other sensors that miss people for the same reason know what this one told of it."""
        one, reason = scan.column, scan.sensor.unheard
        others = [k for k, sensor in enumerate(self.sensors) if reason and sensor.unheard == reason and k != one]
        self.people.detectable[:, others] = self.people.detectable[:, [one]]
        self.undetected.share_knowledge(one, others)

    def _seek(self, name: str, shown: partial.Partial) -> dict[int, int]:
        """Add people never detected before along rays and rings; returns row -> the detection that it is for."""
        undetected, sensor = self.undetected, self.sensors[self.column[name]]
        density, able_at = undetected.density, undetected.detectable_at
        found, owners = partial.cells(shown, self.population, sensor, density, able_at)
        self.features.fill(found)
        first = len(self.people)
        self.people = Densities.join([self.people, found])
        return {first + k: j for k, j in enumerate(owners)}

    def _view(self, column: int, shown: partial.Partial, cells: Iterable[int]) -> partial.View:
        """Linearise what a record shows beside positions."""
        since = self.time - self.looked.get(column, -math.inf)
        self.looked[column] = self.time
        hold = np.full(len(self.people), max(partial.HOLD / max(since, 1e-3), 1.0))
        hold[[*cells]] = 1.0
        return partial.view(shown, self.people, self.sensors[column], hold)

    def _associate(self, scan: Scan, background: Sequence[float]) -> tuple[list[Group], list[float]]:
        """Update the joint hypotheses; also returns J probabilities that no labelled person caused the detection."""
        options = association.options(scan, self.labelled_rows, background)
        self.pairs += len(self.labelled_rows) * len(scan.z)
        self.near += sum([len(scan.likelihoods[row]) for row in self.labelled_rows])
        unclaimed = [1.0] * len(scan.z)
        most = self.settings.hypotheses
        groups = [
            association.associate(some, kept, unclaimed, most)
            for members in association.competing(self.clusters, options)
            for some, kept in association.apart(members, options, len(scan.z))
        ]
        return groups, [min(max(u, 0.0), 1.0) for u in unclaimed]

    def _widen(self, scan: Scan) -> None:
        """Take the noise of a record's sensor for larger, if its detections certainly say so."""
        scales, surface = self.scales[scan.column], scan.sensor.field(self.population.surface)
        if scales.wider(scan, self.people, self.likely_rows, surface):
            self.errors.widen(scan.column, WIDER)
            scales.begin()

    def _learn(self, groups: Iterable[Group], scan: Scan) -> None:
        """Learn from the known people whom a record detected: they were there since they were detected last."""
        people, column, now = self.people, scan.column, self.time
        dt = now - self.last_record[column]
        detected = [
            (row, math.exp(group.hypotheses[0].weight))
            for group in groups
            for row, j in group.hypotheses[0].pairs
            if j >= 0 and self.habits.sure(people, row)
        ]
        if not detected:
            return
        rows, sure = [row for row, _ in detected], [share for _, share in detected]
        seen = people.seen.take(rows, 0).tolist()
        gone = [(now - max(one)) * share for one, share in zip(seen, sure, strict=True)]
        self.habits.stayed(people.mean[:, 0].take(rows, 0), gone)
        self.habits.absences.back(gone, dt)
        known = [k for k, one in enumerate(seen) if one[column] > NEVER]
        if scan.sensor.hide and known:
            gaps, sure, rates = [now - seen[k][column] for k in known], [sure[k] for k in known], self.rates[column]
            rates.hiding.learn([scan.detectable[rows[k]] for k in known], gaps, sure, dt)
            rates.blindness.learn(gaps, dt)
            self._know_hiding(column)

    def _know_hiding(self, column: int) -> None:
        hiding = self.rates[column].hiding
        hide, show = hiding.hide, hiding.show
        self.detectable[column], self.turnover[column] = show / (hide + show), hide + show

    # --- the densities and hypotheses after a record ------------------------------------------------------------------

    def _rebuild(
        self, scan: Scan, groups: list[Group], revealed: Sequence[Birth], now: float, false: Sequence[float]
    ) -> None:
        """Compute each density that is needed once, and make tentative people and clusters of them.

        false: J probabilities that a detection is usual clutter.
        """
        want = needed(scan, self.people, self.tentative, groups, revealed)
        people = updated(scan, self.people, want, now, self.features)
        if want.fresh:
            able = self.undetected.detectable_at(scan.z[want.fresh])
            cameras = [one.kind == CAMERA and rates.proven for one, rates in zip(self.sensors, self.rates, strict=True)]
            against = overlooked(able, self.detectable, cameras)
            new = newcomers(scan, want.fresh, now, self.population, able, against)
            self.features.fill(new)
            if scan.evidence:
                new.traits = self.features.first(scan.evidence, want.fresh)
            people = Densities.join([people, new])
        if any(false):
            weight = self.rates[scan.column].weight
            found = [*want.detected, *want.renewed, *((-1, j) for j in want.fresh)]
            for k, (row, j) in enumerate(found, len(people) - len(found)):
                if false[j] and (row < 0 or not self.habits.sure(self.people, row)):
                    people.counted[k, scan.column] += weight * false[j]
        if self.record:
            people.node = [Node.fork(node, now) for node in people.node]
        self.people = people
        first = len(want.missed)
        self.tentative = list(range(first, first + len(want.staying)))
        row_of = want.rows()
        if scan.partial is not None:
            revealed = partial.gathered(scan.partial, people, revealed, row_of)
        self._bear(scan, revealed, groups, row_of, want.fresh_rows())
        self._recluster(groups, row_of)
        self.habits.confirm(self.people, self.likely_rows)
        if self.settings.learn and np.count_nonzero(self.people.counted):
            self._give_back()
        if self.next_label >= self.pruned:
            self.pruned = self.next_label + PRUNED
            self.habits.forget(self.people.label)
            self.false_places.forget(self.people.label)

    def _give_back(self) -> None:
        """Let detections of people who are certain by now count as false no more: that would hide who comes next.

        They must be so even if all detections of nobody known were false; else people whom clutter made would say that
        there is none.
        """
        people, most = self.people, [math.log(rates.most_clutter()) for rates in self.rates]
        for row, counted in zip(self.likely_rows, people.counted.take(self.likely_rows, 0).tolist(), strict=True):
            if any(counted) and self.habits.sure(people, row, most):
                for rates, number in zip(self.rates, counted, strict=True):
                    rates.give_back(number)
                people.counted[[label == people.label[row] for label in people.label]] = 0.0

    def _bear(
        self,
        scan: Scan,
        revealed: Sequence[Birth],
        groups: list[Group],
        row_of: dict[Pair, int],
        fresh_rows: dict[int, int],
    ) -> None:
        """Make the people whom a record revealed tentative or, where it is sure enough, labelled."""
        taken = {label for group in groups for label in group.labels}
        users = {j: group for group in groups for j in group.used()} if revealed else {}
        for birth in revealed:
            j = birth.detection
            row = row_of[birth.source, j] if birth.source >= 0 else fresh_rows[j]
            self.people.existence[row] = birth.existence
            if birth.source < 0:
                self.people.told[row] = logit(birth.existence) + math.log(scan.expected_clutter)
            if birth.number >= PROMOTE and birth.placed:
                self._promote(scan, row, j, groups, users, taken)
                row_of[row, BORN] = row
            else:
                self.people.existence[row] = birth.number
                self.tentative.append(row)
        if self.looked:
            self.tentative = partial.merged(self.people, self.tentative)

    def _promote(
        self,
        scan: Scan,
        row: int,
        j: int,
        groups: list[Group],
        users: Mapping[int, Group],
        taken: set[int],
    ) -> None:
        """Give a tentative person a label, in the hypotheses that do not use its detection j otherwise.

        users: by detection, the group that has hypotheses that use it.
        """
        people = self.people
        label = people.label[row]
        if label < 0 or label in taken:
            label, self.next_label = self.next_label, self.next_label + 1
            self.habits.began(label, people.place[row], self.time)
        else:
            self.habits.came_back(label)
            for other in self.tentative:  # what remains of the tentative person is somebody else
                if people.label[other] == label:
                    people.label[other] = -1
        taken.add(label)
        people.label[row] = label
        if scan.partial is None:
            noise = float(scan.noise[j, 0, 0] + scan.noise[j, 1, 1]) / 2
            self.false_places.began(scan.column, label, scan.z[j].tolist(), noise, label == self.next_label - 1)
        self.born.append({"label": label, "detection": j, "existence": float(people.existence[row])})
        self.retired.pop(label, None)
        if self.features.width:
            self.gallery.come(label, self.time)
        if j not in users:
            groups.append(Group([label], [Hypothesis(0.0, ((row, BORN),), 0)]))
            return
        users[j].labels.append(label)
        for h in users[j].hypotheses:
            h.pairs = (*h.pairs, (ABSENT, association.MISSED) if h.used >> j & 1 else (row, BORN))

    def _recluster(self, groups: Iterable[Group], row_of: dict[Pair, int]) -> None:
        """Make clusters of the hypotheses after a record; row_of: (row before, detection) -> row after."""
        self.lost = self._lost(groups, row_of)
        clusters = [
            Cluster(
                group.labels,
                [tuple(map(row_of.__getitem__, h.pairs)) for h in group.hypotheses],
                [h.weight for h in group.hypotheses],
            )
            for group in groups
        ]
        clusters = hypotheses.condensed(clusters, self.people, self.features)
        if self.features.width:
            clusters = [self._exchanged(cluster) for cluster in clusters]
        self.clusters = []
        for cluster in hypotheses.decided(clusters, self.people, self.features):
            self._settle(cluster)
        self.labelled_rows = sorted(
            {row for cluster in self.clusters for joint in cluster.hypotheses for row in joint if row >= 0}
        )
        self.likely_rows = [row for cluster in self.clusters for row in cluster.hypotheses[0] if row >= 0]

    def _exchanged(self, cluster: Cluster) -> Cluster:
        """Keep that two people whose features differ may be exchanged."""
        if len(cluster.labels) < 2:
            return cluster
        cluster, exchanged = cluster.exchanged(self.people, self.features)
        if exchanged:
            self.people = Densities.join([self.people, exchanged])
        return cluster

    def _settle(self, cluster: Cluster) -> None:
        """Keep a cluster: without the labels that hardly exist, and in parts that are independent of each other."""
        likely, kept = cluster.hypotheses[0], []
        existences = cluster.existences(self.people.existence)
        if len(likely) == 1 and existences[0] >= RECYCLE and likely[0] not in self.lost:
            self.clusters.append(cluster)
            return
        for at, existence in enumerate(existences):
            lost = likely[at] in self.lost
            if existence < RECYCLE or lost:
                shares, existence = cluster.marginals(at, self.people.existence)
                self._recycle(cluster.labels[at], shares, existence, lost)
            else:
                kept.append(at)
        if len(kept) < len(cluster.labels):
            cluster = cluster.only(kept)
        if len(kept) < 2:
            self.clusters += [cluster] * len(kept)
            return
        independent = FEATURED if self.features.width else INDEPENDENT
        parts = [[at] for at in range(len(cluster.labels))] if self.factorise else cluster.parts(independent)
        self.clusters += cluster.split(parts) if len(parts) > 1 else [cluster]

    def _lost(self, groups: Iterable[Group], row_of: dict[Pair, int]) -> set[int]:
        """Return the rows of people whom nobody could tell from others any more, where nobody looks everywhere."""
        if not isinstance(self.undetected, UnseenMap):
            return set()
        rows = [row_of[pair] for group in groups for pair in group.hypotheses[0].pairs]
        return set(self.undetected.lost(self.people, [row for row in rows if row >= 0], self.time))

    def _recycle(self, label: int, shares: dict[int, float], existence: float, lost: bool) -> None:
        """Make a label that hardly exists tentative again: its best density, the number of people its existence."""
        people = self.people
        rows = [row for row in shares if row >= 0]
        meant = math.fsum(shares[row] for row in rows)
        because = "its detections belong to others" if meant < 0.5 else "no sensor detects it any more"
        because = "it cannot be told from others who are out of sight" if lost and meant >= 0.5 else because
        self.died.append({"label": label, "existence": existence, "because": because})
        doubt = self.false_places.died(label)
        if not rows:
            return
        best = max(rows, key=lambda row: (shares[row] * people.existence[row], -row))
        if meant >= 0.5:
            if doubt > 0.5:
                self.habits.was_false(label)
            elif not lost:
                self.habits.ended(label, people, best)
            if self.features.width:
                self.gallery.leave(label, self._person(best), self.features)
        node = people.node[best]
        if self.record and node is not None:
            mean, cov = gaussian.moments(people.mean[[best]], people.cov[[best]], people.mode[[best]])
            node.note(people, best, self.errors.covariances(people, [best])[0])
            nobody, contested = people.nobody([best])
            sure = min(existence / meant, 1.0)
            self.retired[label] = End(label, meant, node, mean[0], cov[0], sure, nobody.item(), contested.item())
        if lost and isinstance(self.undetected, UnseenMap):
            mean, cov = gaussian.moments(people.mean[[best]], people.cov[[best]], people.mode[[best]])
            self.undetected.receive(mean[0, :2], cov[0, :2, :2], existence, people.detectable[best])
        elif existence > TENTATIVE:
            people.existence[best] = existence
            self.tentative.append(best)

    def _person(self, row: int) -> Left:
        people = self.people
        return Left(float(people.seen[row].max()), people.place[row].copy(), people.traits[row].copy())

    def _recognise(self) -> None:
        """Give people who came lately and are recognised as somebody who left the label of that person."""
        known = {one.label: self._person(one.row) for one in self.labelled() if one.existence > 0.5}
        again = self.gallery.recognise(known, self.time, self.population.surface, self.features)
        for label, before in again.items():
            self.people.label = [-1 if one == before else before if one == label else one for one in self.people.label]
            for cluster in self.clusters:
                cluster.labels = [before if one == label else one for one in cluster.labels]

    # --- report -------------------------------------------------------------------------------------------------------

    def labelled(self) -> list[Labelled]:
        """Return all labelled people, by label."""
        people = []
        for cluster in self.clusters:
            for at, label in enumerate(cluster.labels):
                shares, existence = cluster.marginals(at, self.people.existence)
                row = cluster.hypotheses[0][at]
                if row < 0:
                    row = max((k for k in shares if k >= 0), key=lambda k: (shares[k], -k))
                meant = math.fsum(w for k, w in shares.items() if k >= 0)
                people.append(Labelled(label, row, min(existence, 1.0), meant))
        return sorted(people)

    def tracks(self, time: float) -> list[Track]:
        """Return the people who are probably there at a time (s) not before the last record, by label."""
        self.predict(time)
        people, least = self.people, 0.0 if self.settings.show == "all" else REPORT
        present = [(one.label, one.row, one.existence) for one in self.labelled() if one.existence > least]
        if self.settings.show == "all":
            taken = {label for label, _, _ in present}
            unsure = sorted(self.tentative, key=lambda row: (people.existence[row], -row))
            # Of each the likeliest: one who left may be kept with several pasts.
            dormant = {people.label[row]: row for row in unsure if people.label[row] not in {-1, *taken}}
            present = sorted(present + [(label, row, float(people.existence[row])) for label, row in dormant.items()])
        if not present:
            return []
        rows = np.array([row for _, row, _ in present])
        densities = people.mean.take(rows, 0), people.cov.take(rows, 0), people.mode.take(rows, 0)
        mean, cov = gaussian.moments(*densities)
        near = gaussian.within(*densities, mean[:, :2], np.maximum(NEAR, BLUR * people.reach.take(rows))).tolist()
        lasting = self.errors.covariances(people, rows)
        nearer = [1.0] * len(rows)  # how much less probable it is that the person is so near as existence means
        cov[:, :2, :2] += lasting
        if self.errors.vague:
            nearer = np.minimum(gaussian.near(cov[:, :2, :2], NEAR) / near, 1.0).tolist()
        seen, detectable = people.seen.take(rows, 0).tolist(), people.detectable.take(rows, 0).tolist()
        last, count = list(map(max, seen)), list(map(math.fsum, people.hits.take(rows, 0).tolist()))
        tracks, doubts, grounds = [], self.false_places.doubts(), self.habits.absences.grounds
        latest = [any(map(eq, one, self.last_record)) for one in seen]
        nobody, contested = people.nobody(rows)
        in_part = isinstance(self.undetected, UnseenMap)
        looks = watched(mean[:, :2], self.sensors) if in_part else [True] * len(present)
        for k, (label, _, existence) in enumerate(present):
            existence *= 1 - doubts.get(label, 0.0)
            believed = existence * near[k]
            there = TRUST.of(grounds(existence, near[k], latest[k], count[k], looks[k], last[k], self.time))
            shown = there * (1 - nobody[k]) if contested[k] else there
            if believed > min(least, THERE) and shown > min(least, SHOWN):
                able = dict(zip(self.column, detectable[k], strict=True))
                there *= (1 - nobody[k]) * nearer[k]
                tracks.append(Track(label, mean[k], cov[k], there, able, last[k]))
        return tracks

    def ends(self) -> Iterator[End]:
        """Yield the latest end of each person's history, also of those who left lately."""
        labelled, people = self.labelled(), self.people
        if labelled:
            rows = [one.row for one in labelled]
            mean, cov = gaussian.moments(people.mean[rows], people.cov[rows], people.mode[rows])
            nobody, contested = people.nobody(rows)
            lasting = self.errors.covariances(people, rows)
            for k, one in enumerate(labelled):
                node = people.node[one.row]
                if node is not None:
                    node.note(people, one.row, lasting[k])
                    existence = min(one.existence / one.meant, 1.0)
                    doubt = nobody.item(k), contested.item(k)
                    yield End(one.label, one.meant, node, mean[k], cov[k], existence, *doubt)
        yield from self.retired.values()

    def forget(self, time: float) -> None:
        """Drop all history before a time (s), so that memory does not grow."""
        for label in [label for label, end in self.retired.items() if end.node.time < time - 1e-6]:
            del self.retired[label]
        cut([*self.people.node, *(end.node for end in self.retired.values())], time)

    def accounts(self) -> list[dict[str, Any]]:
        """Return what each record since the last call meant, as explain.schema.json describes it."""
        if self.journal is None:
            raise ValueError("the tracker keeps no accounts: make it with explain=True")
        accounts, self.journal = self.journal, []
        return accounts
