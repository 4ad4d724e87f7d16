"""The multi-sensor generalized labelled multi-Bernoulli filter (Vo, Vo and Beard 2019) for people in a room.

Labelled people are Bernoullis (a density and a probability of existence, which stands for the pair of GLMB hypotheses
with and without the label) within joint hypotheses about which detection belongs to whom; people who interact share a
cluster of hypotheses. People not yet believed in form a Poisson process: a uniform part, and one Gaussian for each
tentative person (Williams 2015, with recycling: Williams 2012), so that clutter costs array rows and no hypotheses.
Whether each sensor can find each person (hidden from the camera, silent) is a hidden two-state Markov chain of the
person. Every record updates the filter at its own time, so sensors may have any rate and offset.
"""

import math
from itertools import chain, pairwise

import numpy as np

from avcli.tracking import gaussian
from avcli.tracking.assignment import ranked
from avcli.tracking.hypotheses import Cluster, Densities
from avcli.tracking.model import Track
from avcli.tracking.rates import Rates, logit
from avcli.tracking.smoothing import Node

GATE = 30.0  # squared Mahalanobis distance: 3e-7 of a person's detections lie outside
PRUNE = 1e-3  # weight of a joint hypothesis relative to the best
LOG_PRUNE = math.log(PRUNE)
BUDGET = 3
PROMOTE, RECYCLE = 0.1, 0.03  # existence at which a tentative person becomes labelled, and a labelled one tentative
TWICE = 0.05  # detections of a person that a sensor has found in the same record already, expected
FORGET = 5e-3  # expected number of people below which a tentative person who was labelled loses the label
TENTATIVE, TENTATIVES = 1e-4, 150  # least expected number of people in a tentative Gaussian; how many are kept
BUMP = 0.2  # m; people whose courses come nearer to one another than this would bump
SOON, JUST = 0.3, 0.1  # s; the nearest point of two courses counts while it is so near in the future or the past
BODY = 0.2  # m; nobody's axis is nearer to a wall
INWARD = 0.8  # m/s, mean pace away from a wall of who turns at it; in proportion less towards the middle of the room
AHEAD = 0.5  # s; who would be at a wall so soon turns at TURN a second, who is there at HALT a second
TURN, HALT = 1.0, 10.0
FACING = -0.9  # cosine of the angle between the courses of people who walk face to face


class GLMB:
    """The filter: feed `scan` with records in order of time; ask `tracks` at any time not before the last record."""

    def __init__(self, settings, sensors=(), factorise=False, record=False):
        """settings: Settings; sensors: Sensor of each that may report (others: `add`); factorise: keep only each
        label's marginal after every record (the LMB filter, Reuter et al. 2014); record: keep what smoothing needs.
        """
        self.settings, self.factorise, self.record = settings, factorise, record
        m = len(settings.motion.models)
        self.people = Densities(
            np.zeros((0, m, 4)), np.zeros((0, m, 4, 4)), np.zeros((0, m)), np.zeros(0), np.zeros((0, 0)), [], []
        )
        self.clusters, self.tentative = [], []
        self.leaves, self.likeliest = [], []  # densities of labelled people: all, and those of the best hypotheses
        self.time = None
        self.unseen, self.unseen_found = np.array([settings.present, 0.0]), np.zeros(0)  # anywhere, near the walls
        self.sensors, self.column, self.rates = [], {}, []
        self.next_label, self.scans, self.retired = 0, 0, {}
        self.journal, self.born, self.died = None, [], []  # a list as journal: `scan` accounts for each record in it
        self.stationary = settings.motion.stationary()
        for one in sensors:
            self.add(one)

    def add(self, sensor):
        """Let another sensor report from now on."""
        self.column[sensor.name] = len(self.sensors)
        self.sensors.append(sensor)
        self.rates.append(Rates(sensor))
        people = self.people
        people.found = np.column_stack([people.found, np.full(len(people), sensor.findable())])
        self.unseen_found = np.append(self.unseen_found, sensor.findable())
        self.findable = np.array([one.findable() for one in self.sensors])
        self.turnover = np.array([one.hide + one.show for one in self.sensors])

    def advance(self, time):
        """Predict to a time (s); a time in the past counts as the present."""
        if self.time is None:
            self.time = time
        dt = round(time - self.time, 9)
        if dt <= 0:
            return
        self.time = time
        settings, people = self.settings, self.people
        survive = settings.staying(people.mean[:, 0], dt)
        self.unseen = self.unseen * math.exp(-dt / settings.stay) + settings.coming * dt
        if len(people):
            self._evade(dt)
            before = people.mean, people.cov, people.mode
            people.mean, people.cov, people.mode, half, mixed = gaussian.predict(*before, settings.motion, dt)
            if settings.walls:
                self._meet_walls(before[0], dt)
            if self.record:
                people.node = Node.steps(people, before, half, mixed, survive, time)
            people.exist = people.exist * survive
        if self.sensors:
            mix = np.exp(-dt * self.turnover)
            self.unseen_found = self.findable + (self.unseen_found - self.findable) * mix
            people.found = self.findable + (people.found - self.findable) * mix

    def _meet_walls(self, before, dt):
        """Hold predictions inside the room that were inside it before, and let those who come to a wall turn inwards.

        before: (n, M, 4) mean states dt seconds ago.
        """
        centre, inner, motion = self.settings.centre, self.settings.half - BODY, self.settings.motion
        place, pace, mode = self.people.mean[..., :2], self.people.mean[..., 2:], self.people.mode
        away = place - centre
        if motion.turn >= 0:
            drawn = -INWARD * math.expm1(-dt / motion.models[motion.turn].memory)
            pace[:, motion.turn] -= away[:, motion.turn] * (drawn / self.settings.half)
        near = abs(away + pace * AHEAD) > inner
        if np.count_nonzero(near):
            inside = abs(before[..., :2] - centre) <= inner
            near &= inside
            over = inside & (abs(away) > inner)
            if np.count_nonzero(over):
                pace[over] = 0.0
                place[over] = np.clip(place, centre - inner, centre + inner)[over]
            if motion.turn >= 0:
                share = mode * -np.expm1(-dt * (TURN * near.any(2) + HALT * over.any(2)))
                mode -= share
                mode[:, motion.turn] += share.sum(1)

    def _evade(self, dt):
        """Let those who walk into each other face to face stop, within the next dt seconds.

        Two bodies cannot pass through each other, and what is seen of two people near each other hardly tells whether
        they did; who comes from the side may pass behind.
        """
        rate, stand, people = self.settings.evade, self.settings.motion.stand, self.people
        if len(self.likeliest) < 2 or stand < 0 or not rate:
            return
        own = plane(people.centres(self.leaves))
        other = own.take([self.leaves.index(leaf) for leaf in self.likeliest], 0)
        place, pace = (own[:, None] - other).transpose(2, 0, 1)
        fastest = 2 * max(abs(own[:, 1]).tolist())
        if np.count_nonzero(abs(place) < BUMP + SOON * fastest) == len(other):  # everybody is near himself alone
            return
        soon = -(place * pace.conj()).real / (np.square(abs(pace)) + 1e-9)  # seconds until they are nearest
        bump = (abs(soon - (SOON - JUST) / 2) < (SOON + JUST) / 2) & (abs(place + pace * np.maximum(soon, 0.0)) < BUMP)
        if not np.count_nonzero(bump):
            return
        own, other = own[:, 1:], other[:, 1]
        bump &= (own * other.conj()).real < FACING * abs(own) * abs(other)  # never somebody and himself
        if bump.any():
            rows = np.array(self.leaves)[bump.any(1)]
            left = math.exp(-rate * dt)
            mode = people.mode[rows] * left
            mode[:, stand] += 1 - left
            people.mode[rows] = mode

    # --- one record ---------------------------------------------------------------------------------------------------

    def scan(self, time, name, z, noise, score=None):
        """Update with one record of one sensor.

        time: s. name: of a known sensor. z: (J, 2) m. noise: (J, 2, 2) m^2. score: (J,) probability that each detection
        is a person (NaN: not said), or None.
        """
        self.advance(time)
        self.scans += 1
        z, noise, score = distinct(z, noise, score)
        column = self.column[name]
        sensor, rates = self.sensors[column], self.rates[column]
        people, settings = self.people, self.settings
        gain, in_model = gains(people, z, noise, sensor.lead)
        exist, found, likely = people.exist.tolist(), people.found[:, column].tolist(), gain.tolist()

        # What is small is reckoned in lists: numbers for each detection (J) or density (n) cost less so than in arrays.
        odds = [math.nan] * len(z) if score is None else [logit(one) for one in score.tolist()]
        kappa = max(rates.clutter, 1e-9) / settings.surface
        kappa = [kappa * doubt for doubt in rates.doubt(odds)]
        if sensor.coverage:
            covered = sensor.coverage.at(people.mean[:, 0, :2])
            reach = [findable * share for findable, share in zip(found, covered, strict=True)]
        else:
            reach = found
        ratio = self._recognised(exist, reach, likely, kappa, rates.detection)
        detection = rates.detection * (1 - rates.blindness(self.time, ratio))
        chance = [one * detection for one in reach]

        finds = detection * self.unseen_found[column]
        from_tentative, strangers = self._unclaimed(z, noise, exist, chance, gain, finds)
        rho = (from_tentative.sum(0) + strangers).tolist()
        background = [k + r for k, r in zip(kappa, rho, strict=True)]
        options = self._options(exist, chance, likely, background)
        free = [1.0] * len(z)  # probability that no labelled person caused the detection
        groups = [self._associate(members, options, free) for members in self._groups(options)]
        free = [min(max(f, 0.0), 1.0) for f in free]
        real = [r / b for r, b in zip(rho, background, strict=True)]
        room, twice = self._seen_already(z, noise, free, real)
        rho = [r * left for r, left in zip(rho, room, strict=True)]
        background = [k + r + t for k, r, t in zip(kappa, rho, twice, strict=True)]
        existence = [r / b for r, b in zip(rho, background, strict=True)]
        false = [f * k / b for f, k, b in zip(free, kappa, background, strict=True)]

        if settings.adapt:
            rates.learn(math.fsum(false), *self._hits_and_misses(groups, exist, chance, detection))
        rates.learn_score(odds, [1 - f for f in false])
        births = self._births(free, existence, from_tentative, strangers)
        self.born, self.died = [], []
        if self.journal is not None:
            account = self._account(name, z, groups, free, existence, kappa, rho)
        self._rebuild(column, z, noise, groups, births, exist, found, chance, in_model)
        if self.journal is not None:
            self.journal.append({**account, "born": self.born, "died": self.died})
        self.unseen *= 1 - finds
        self.unseen_found[column] *= (1 - detection) / max(1 - finds, 1e-12)

    def _recognised(self, exist, reach, likely, kappa, detection):
        """How much likelier a record is with the people that are known than as clutter alone.

        exist, reach: probabilities that each density exists and can be found; likely: its likelihoods of the
        detections; kappa: their densities as clutter; detection: probability of finding whoever can be found.
        """
        ratio = 1.0
        for leaf in self.likeliest:
            present = exist[leaf] * reach[leaf] * detection
            more = math.fsum(g / k for g, k in zip(likely[leaf], kappa, strict=True) if g)
            ratio *= min(1 - present + present * more, 1e3)
        return ratio

    def _unclaimed(self, z, noise, exist, chance, gain, finds):
        """Densities of detecting, at z, each tentative person, (T, J), and anybody never seen before, (J,).

        exist, chance: lists of n; gain (n, J); finds: probability of finding somebody never seen who is there.
        """
        at, people = self.tentative, self.people
        places = np.concatenate([z, people.mean[at, 0, :2]])
        spread = np.concatenate([noise, people.cov[at, 0, :2, :2]])
        room = self._elbow_room(places, spread[:, 0, 0] + spread[:, 1, 1])
        number = room[len(z) :] * [exist[i] * chance[i] for i in at]
        strangers = room[: len(z)] * self.settings.crowd(z, *(finds * self.unseen).tolist())
        return number[:, None] * gain[at], strangers if self.settings.birth == "poisson" else 0.0 * strangers

    def _elbow_room(self, places, spread):
        """Probability (n,) that someone new at places (n, 2) m is not inside a known person.

        spread: (n,) m^2, the sum of the variances along x and y to which the places are known.
        """
        if not self.likeliest or not len(places):
            return np.ones(len(places))
        known = plane(self.people.centres(self.likeliest))[:, 0]
        apart, width = abs(plane(places) - known), 2 * self.settings.body**2 + spread
        taken = np.exp(-apart * apart / width[:, None]) * self.people.exist.take(self.likeliest)
        return (1 - taken).prod(1)

    def _seen_already(self, z, noise, free, real):
        """What other detections of a record say of each as a stranger: they may be of the same person.

        z (J, 2) m in order of x, noise (J, 2, 2) m^2; free: probabilities of being no known person's; real: of being a
        stranger's then. Returns the probability of room for somebody else beside whom the others found, and the
        density of finding one of those a second time, a list of J each.
        """
        room, twice = [1.0] * len(z), [0.0] * len(z)
        if len(z) < 2:
            return room, twice
        places, spread, body = z.tolist(), (noise[:, 0, 0] + noise[:, 1, 1]).tolist(), 2 * self.settings.body**2
        reach = GATE * (body + 2 * max(spread))  # m^2
        for k, (x, y) in enumerate(places):
            for j in range(k - 1, -1, -1):
                if (x - places[j][0]) ** 2 > reach:
                    break
                apart = (x - places[j][0]) ** 2 + (y - places[j][1]) ** 2
                width = spread[j] + spread[k]
                again = TWICE / math.pi * math.exp(-apart / width) / width
                for one, other in ((j, k), (k, j)):
                    found = min((1 - free[other]) / max(free[one], 1e-9), 1.0)  # if one is nobody's, the other may be
                    if one == k:
                        found = max(found, free[j] * real[j])  # the first of two strangers counts
                    room[one] *= 1 - found * math.exp(-apart / (body + spread[one]))
                    twice[one] += again * found
        return room, twice

    def _options(self, exist, chance, likely, background):
        """What each labelled density may have caused: index -> [(log weight, detection or -1)], best first."""
        options = {}
        for leaf in self.leaves:
            present = exist[leaf] * chance[leaf]
            missed = max(1 - present, 1e-12)
            least = missed * PRUNE  # the same hypothesis but for a miss is likelier by so much
            hits = enumerate(zip(likely[leaf], background, strict=True))
            found = [(math.log(present * g / b), j) for j, (g, b) in hits if present * g > least * b]
            options[leaf] = sorted([(math.log(missed), -1), *found], reverse=True)
        return options

    def _groups(self, options):
        """The clusters that compete for a detection, together: a list of lists of clusters."""
        groups = []
        for cluster in self.clusters:
            leaves = {leaf for row in cluster.rows for leaf in row if leaf >= 0}
            wanted = {j for leaf in leaves for _, j in options[leaf] if j >= 0}
            members = [cluster]
            for group in [g for g in groups if not wanted.isdisjoint(g[1])]:
                groups.remove(group)
                members = group[0] + members
                wanted |= group[1]
            groups.append((members, wanted))
        return [members for members, _ in groups]

    def _associate(self, members, options, free):
        """Update the joint hypotheses of a group of clusters; lowers `free` where they took detections.

        Returns (labels, [[log weight, ((density, detection), ...), used bits]]), normalised, best first.
        """
        settings, priors = self.settings, list(zip(members[0].weights, members[0].rows, strict=True))
        for cluster in members[1:]:
            pairs = list(zip(cluster.weights, cluster.rows, strict=True))
            priors = [(w + v, left + right) for w, left in priors for v, right in pairs]
            if len(priors) > settings.hypotheses:
                priors.sort(key=lambda prior: -prior[0])
                del priors[settings.hypotheses :]
        kept = ranked(priors, options, BUDGET * settings.hypotheses, -LOG_PRUNE)[: settings.hypotheses]
        top = kept[0][0]
        kept = [list(one) for one in kept if one[0] - top > LOG_PRUNE]
        total = top + math.log(math.fsum(math.exp(h[0] - top) for h in kept))
        for hypothesis in kept:
            hypothesis[0] -= total
            share, used = math.exp(hypothesis[0]), hypothesis[2]
            while used:
                low = used & -used
                free[low.bit_length() - 1] -= share
                used ^= low
        return [label for cluster in members for label in cluster.labels], kept

    def _hits_and_misses(self, groups, exist, chance, detection):
        """Expected numbers of people found, and of those missed who could be found, among who surely exists."""
        hits = misses = 0.0
        for _, hypotheses in groups:
            for leaf, j in hypotheses[0][1]:
                if leaf >= 0 and exist[leaf] > 0.9:
                    if j >= 0:
                        hits += 1
                    else:
                        misses += chance[leaf] * (1 - detection) / max(detection * (1 - chance[leaf]), 1e-12)
        return hits, misses

    # --- the densities after a record ---------------------------------------------------------------------------------

    def _births(self, free, existence, from_tentative, strangers):
        """People that detections may reveal: [(detection, tentative density or -1, number, existence)]."""
        least, poisson = TENTATIVE, self.settings.birth == "poisson"
        births = []
        for j, (f, e) in enumerate(zip(free, existence, strict=True)):
            if f * e > least:
                source = from_tentative[:, j].argmax() if self.tentative else -1
                known = source >= 0 and from_tentative[source, j] > strangers[j]
                if known or poisson:
                    births.append((j, self.tentative[source] if known else -1, f * e, e))
        if not poisson:  # strangers are born for the next record, as many as are expected (Trezza et al. 2022)
            stranger = [f * (1 - e) for f, e in zip(free, existence, strict=True)]
            share = self.settings.newborn / max(math.fsum(stranger), 1e-12)
            births += [(j, -1, share * s, 0.0) for j, s in enumerate(stranger) if share * s > least]
        return births

    def _rebuild(self, column, z, noise, groups, births, exist, found, chance, in_model):
        """Compute each density that is needed once, and make tentative people and clusters of them.

        births: as `_births` returns them; exist, found, chance: lists of n, probabilities of existing, and of those who
        exist: that they can be found, and that they are; in_model (n, M, J): likelihoods in each model.
        """
        people, sensor = self.people, self.sensors[column]
        pairs = dict.fromkeys(chain.from_iterable(h[1] for _, hs in groups for h in hs))
        left = {i: exist[i] * (1 - chance[i]) for i in self.tentative}
        stay = [i for i in self.tentative if left[i] > TENTATIVE]
        for i in stay:
            if left[i] < FORGET:
                people.label[i] = -1
        if len(stay) > TENTATIVES:
            stay = sorted(sorted(stay, key=lambda i: -left[i])[:TENTATIVES])
        miss = [leaf for leaf, j in pairs if j < 0 <= leaf]
        hit = [pair for pair in pairs if pair[1] >= 0]
        renewed = [(at, j) for j, at, _, _ in births if at >= 0]
        fresh = [j for j, at, _, _ in births if at < 0]

        parents, seen, n, old = miss + stay, hit + renewed, len(miss), len(miss) + len(stay)
        new = people.take(parents + [leaf for leaf, _ in seen])
        overlooked = [1 - chance[i] for i in parents]
        kept = [exist[i] * o for i, o in zip(parents, overlooked, strict=True)]
        new.exist[:old] = [e / max(1 - exist[i] + e, 1e-12) for i, e in zip(miss, kept, strict=False)] + kept[n:]
        new.found[:old, column] = [
            (found[i] - chance[i]) / max(o, 1e-12) for i, o in zip(parents, overlooked, strict=True)
        ]
        if seen:
            js, states = [j for _, j in seen], (new.mean, new.cov, new.mode)
            found_in = z.take(js, 0), noise.take(js, 0), sensor.lead, in_model[[leaf for leaf, _ in seen], :, js]
            updated = gaussian.update(*(state[old:] for state in states), *found_in)
            for state, now in zip(states, updated, strict=True):
                state[old:] = now
            new.exist[old:], new.found[old:, column] = 1.0, 1.0
        if fresh:
            new = Densities.join([new, self._newcomers(column, z[fresh], noise[fresh])])
        if self.record:
            new.node = [Node.fork(node, self.time) for node in new.node]
        self.people = people = new

        place = {(leaf, -1): k for k, leaf in enumerate(miss)}
        place.update((pair, old + k) for k, pair in enumerate(seen))
        place[-1, -1] = -1
        newcomer = {j: old + len(seen) + k for k, j in enumerate(fresh)}
        self.tentative = list(range(n, old))
        labels_taken = {label for labels, _ in groups for label in labels}
        for j, at, number, existence in births:
            row = place[at, j] if at >= 0 else newcomer[j]
            people.exist[row] = existence
            if number >= PROMOTE:
                self._promote(row, groups, j, labels_taken, place)
            else:
                people.exist[row] = number
                self.tentative.append(row)
        self._recluster(groups, place)

    def _recluster(self, groups, place):
        """Make clusters of updated hypotheses; place: (density, detection) -> row of the updated density."""
        people, self.clusters = self.people, []
        for labels, hypotheses in groups:
            rows = [tuple([place[pair] for pair in h[1]]) for h in hypotheses]
            cluster = Cluster(labels, rows, [h[0] for h in hypotheses])
            if len(rows) > 1:
                cluster = cluster.condensed(people)
            if len(labels) > 1 and len(cluster.rows) > 1:
                cluster = cluster.decided(people)
            self._settle(cluster)
        self.leaves = sorted({leaf for cluster in self.clusters for row in cluster.rows for leaf in row if leaf >= 0})
        self.likeliest = [leaf for cluster in self.clusters for leaf in cluster.rows[0] if leaf >= 0]

    def _newcomers(self, column, z, noise):
        """Densities of people seen for the first time by one sensor's detections."""
        n, m, sensor = len(z), len(self.stationary), self.sensors[column]
        mean, cov = np.zeros((n, m, 4)), np.zeros((n, m, 4, 4))
        mean[..., :2] = z[:, None]
        cov[..., :2, :2] = noise[:, None] + sensor.lead**2 / 2 * np.eye(2)
        cov[..., 2:, 2:] = self.settings.speed**2 * np.eye(2)
        found = np.tile(self.unseen_found, (n, 1))
        found[:, column] = 1.0
        mode = np.tile(self.stationary, (n, 1))
        return Densities(mean, cov, mode, np.ones(n), found, [-1] * n, [None] * n)

    def _promote(self, row, groups, j, taken, place):
        """Give a tentative person a label and a place in the hypotheses that leave its detection free."""
        people = self.people
        label = people.label[row]
        if label < 0 or label in taken:
            label, self.next_label = self.next_label, self.next_label + 1
        else:
            for other in self.tentative:  # what remains of the tentative person is somebody else
                if people.label[other] == label:
                    people.label[other] = -1
        taken.add(label)
        people.label[row] = label
        self.born.append({"label": label, "detection": j, "existence": float(people.exist[row])})
        self.retired.pop(label, None)
        place[row, "new"] = row
        for labels, hypotheses in groups:
            if any(h[2] >> j & 1 for h in hypotheses):
                labels.append(label)
                for h in hypotheses:
                    h[1] = (*h[1], (-1, -1) if h[2] >> j & 1 else (row, "new"))
                return
        groups.append(([label], [[0.0, ((row, "new"),), 0]]))

    def _settle(self, cluster):
        """Keep a cluster: without the labels that hardly exist, and in parts that are independent of each other."""
        people = self.people
        at = 0
        while at < len(cluster.labels):
            shares, exists = cluster.marginals(at, people.exist)
            if exists < RECYCLE:
                self._recycle(cluster.labels[at], shares, exists)
                cluster = cluster.only([k for k in range(len(cluster.labels)) if k != at])
            else:
                at += 1
        if len(cluster.labels) < 2:
            self.clusters += [cluster] * len(cluster.labels)
            return
        parts = [[at] for at in range(len(cluster.labels))] if self.factorise else cluster.parts()
        self.clusters += [cluster.only(part) for part in parts] if len(parts) > 1 else [cluster]

    def _recycle(self, label, shares, exists):
        """Make a label that hardly exists tentative again: its best density, the number of people its existence."""
        people = self.people
        leaves = [leaf for leaf in shares if leaf >= 0]
        explained = math.fsum(shares[leaf] for leaf in leaves) < 0.5
        because = "its detections are somebody else's" if explained else "nobody finds it any more"
        self.died.append({"label": label, "existence": exists, "because": because})
        if not leaves:
            return
        best = max(leaves, key=lambda leaf: (shares[leaf] * people.exist[leaf], -leaf))
        if self.record:
            mean, cov = gaussian.moments(people.mean[[best]], people.cov[[best]], people.mode[[best]])
            meant = math.fsum(shares[leaf] for leaf in leaves)
            self.retired[label] = people.node[best], mean[0], cov[0], min(exists / meant, 1.0), meant
        if exists > TENTATIVE:
            people.exist[best] = exists
            self.tentative.append(best)

    def _account(self, name, z, groups, free, existence, kappa, rho):
        """What one record meant, as a record of its own: before the people who were born or died are known."""
        found, hypotheses = {}, []
        for labels, kept in groups:
            for at, label in enumerate(labels):
                shares = {}
                for weight, pairs, _ in kept:
                    leaf, j = pairs[at]
                    what = "absent" if leaf < 0 else "missed" if j < 0 else j
                    shares[what] = shares.get(what, 0.0) + math.exp(weight)
                what = max(shares, key=lambda key: (shares[key], str(key)))
                found[label] = {"label": label, "most_likely": what, "probability": min(shares[what], 1.0)}
            best = [
                {"weight": min(math.exp(weight), 1.0), "detections": [None if j < 0 else j for _, j in pairs]}
                for weight, pairs, _ in kept[:5]
            ]
            hypotheses.append({"labels": list(labels), "count": len(kept), "best": best})
        rates = self.rates[self.column[name]]
        return {
            "timestamp": self.time,
            "sensor": name,
            "expected_clutter": float(rates.clutter),
            "detection_probability": float(rates.detection),
            "detections": [
                {
                    "position": place,
                    "unclaimed": f,
                    "person_if_unclaimed": r,
                    "clutter_density": k,
                    "stranger_density": s,
                }
                for place, f, r, k, s in zip(z.tolist(), free, existence, kappa, rho, strict=True)
            ],
            "people": [found[label] for label in sorted(found)],
            "clusters": hypotheses,
            "existence_before": {str(label): exists for label, _, exists, _ in self.labelled()},
        }

    # --- what is known now --------------------------------------------------------------------------------------------

    def labelled(self):
        """All labelled people by label: [(label, density index, probability of existence, of being meant)].

        A label is meant in the hypotheses in which its first detection was a person at all, who may have left since.
        Densities are those of the likeliest joint hypothesis, so that two people are never taken for one.
        """
        found = []
        for cluster in self.clusters:
            for at, label in enumerate(cluster.labels):
                shares, exists = cluster.marginals(at, self.people.exist)
                leaf = cluster.rows[0][at]
                if leaf < 0:
                    leaf = max((k for k in shares if k >= 0), key=lambda k: (shares[k], -k))
                found.append((label, leaf, min(exists, 1.0), math.fsum(w for k, w in shares.items() if k >= 0)))
        return sorted(found)

    def tracks(self, time):
        """The people who probably exist at a time (s) not before the last record: a list of Track by label."""
        self.advance(time)
        found = [one for one in self.labelled() if one[2] > 0.5]
        if not found:
            return []
        rows = [leaf for _, leaf, *_ in found]
        people = self.people
        mean, cov = gaussian.moments(*(state.take(rows, 0) for state in (people.mean, people.cov, people.mode)))
        findable = people.found.take(rows, 0).tolist()
        return [
            Track(label, mean[k], cov[k], exists, dict(zip(self.column, findable[k], strict=True)))
            for k, (label, _, exists, _) in enumerate(found)
        ]


def plane(rows):
    """Pairs of coordinates along the last axis, (..., 2 k), as complex numbers (..., k)."""
    return np.ascontiguousarray(rows).view(complex)


def gains(people, z, noise, lead):
    """Likelihood of each detection under each density, 0 outside the gate: (n, J), and (n, M, J) in each model."""
    log, distance = gaussian.loglikelihood(people.mean, people.cov, z, noise, lead)
    gain = np.where(distance < GATE, np.exp(log), 0.0)
    return (people.mode[:, None] @ gain)[:, 0], gain


def distinct(z, noise, score):
    """Detections in a defined order, without exact repetitions: the same arguments, (J, 2), (J, 2, 2), (J,) or None."""
    if len(z) < 2:
        return z, noise, score
    places = z.tolist()
    order = sorted(range(len(places)), key=places.__getitem__)
    if any(places[a] == places[b] for a, b in pairwise(order)):
        order = np.lexsort((*noise.reshape(-1, 4).T, z[:, 1], z[:, 0])).tolist()
        order = order[:1] + [b for a, b in pairwise(order) if places[a] != places[b]]
    return z.take(order, 0), noise.take(order, 0), None if score is None else score.take(order)
