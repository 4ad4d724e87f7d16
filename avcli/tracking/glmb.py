"""The multi-sensor generalized labelled multi-Bernoulli filter (Vo, Vo and Beard 2019) for people in a room.

Labelled people are Bernoullis (a density and a probability of existence, which stands for the pair of GLMB hypotheses
with and without the label) within joint hypotheses about which detection belongs to whom; people who interact share a
cluster of hypotheses. People not yet believed in form a Poisson process: a uniform part, and one Gaussian for each
tentative person (Williams 2015, with recycling: Williams 2012), so that clutter costs array rows and no hypotheses.
Whether each sensor can find each person (hidden from the camera, silent) is a hidden two-state Markov chain of the
person. Every record updates the filter at its own time, so sensors may have any rate and offset.
"""

import math
from itertools import chain

import numpy as np

from avcli.tracking import gaussian
from avcli.tracking.assignment import ranked
from avcli.tracking.model import Track
from avcli.tracking.smoothing import Node

GATE = 30.0  # squared Mahalanobis distance: 3e-7 of a person's detections lie outside
LOG_PRUNE = math.log(1e-3)  # weight of a joint hypothesis relative to the best
BUDGET = 3
INDEPENDENT = 1e-3  # total variation at which a label's hypotheses count as independent of its cluster's others
PROMOTE, RECYCLE = 0.1, 0.03  # existence at which a tentative person becomes labelled, and a labelled one tentative
FORGET = 5e-3  # expected number of people below which a tentative person who was labelled loses the label
TENTATIVE, TENTATIVES = 1e-5, 150  # least expected number of people in a tentative Gaussian; how many are kept


class Densities:
    """Rows of single-person densities.

    mean (n, M, 4), cov (n, M, 4, 4), mode (n, M): the mixture over motion models. exist (n,): probability of existence,
    or of a tentative person the expected number. found (n, S): probability that each sensor can find the person.
    label (-1: none yet), past (last associations), node (for smoothing): lists of n.
    """

    def __init__(self, mean, cov, mode, exist, found, label, past, node):
        self.mean, self.cov, self.mode, self.exist, self.found = mean, cov, mode, exist, found
        self.label, self.past, self.node = label, past, node

    def __len__(self):
        return len(self.label)

    def take(self, rows):
        """The given rows (a list), in that order."""
        at = np.array(rows, int)
        lists = ([values[i] for i in rows] for values in (self.label, self.past, self.node))
        return Densities(self.mean[at], self.cov[at], self.mode[at], self.exist[at], self.found[at], *lists)

    @staticmethod
    def join(parts):
        """All rows of several, one after another."""
        arrays = (np.concatenate([getattr(p, k) for p in parts]) for k in ("mean", "cov", "mode", "exist", "found"))
        lists = ([value for p in parts for value in getattr(p, k)] for k in ("label", "past", "node"))
        return Densities(*arrays, *lists)


class Cluster:
    """Joint hypotheses about some labels: rows of one density per label (-1: no such person) and their log weights."""

    def __init__(self, labels, rows, weights):
        self.labels, self.rows, self.weights = labels, rows, weights
        self.shares = [math.exp(weight) for weight in weights]

    def marginals(self, at, exist):
        """Of the label in column `at`: {density: its probability}, and the probability that the label exists."""
        shares = {}
        for row, share in zip(self.rows, self.shares, strict=True):
            leaf = row[at]
            shares[leaf] = shares.get(leaf, 0.0) + share
        return shares, math.fsum(share * exist[leaf] for leaf, share in shares.items() if leaf >= 0)

    def without(self, at):
        """The cluster of the other labels; equal rows are merged."""
        merged = {}
        for row, share in zip(self.rows, self.shares, strict=True):
            row = row[:at] + row[at + 1 :]
            merged[row] = merged.get(row, 0.0) + share
        rows = sorted(merged, key=lambda row: -merged[row])
        return Cluster(self.labels[:at] + self.labels[at + 1 :], rows, [math.log(merged[row]) for row in rows])


class GLMB:
    """The filter: feed `scan` with records in order of time; ask `tracks` at any time not before the last record."""

    def __init__(self, settings, sensors=(), factorise=False, record=False):
        """settings: Settings; sensors: Sensor of each that may report (others: `add`); factorise: keep only each
        label's marginal after every record (the LMB filter, Reuter et al. 2014); record: keep what smoothing needs.
        """
        self.settings, self.factorise, self.record = settings, factorise, record
        m = len(settings.motion.models)
        self.people = Densities(
            np.zeros((0, m, 4)), np.zeros((0, m, 4, 4)), np.zeros((0, m)), np.zeros(0), np.zeros((0, 0)), [], [], []
        )
        self.clusters, self.tentative = [], []
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

    def advance(self, time):
        """Predict to a time (s); a time in the past counts as the present."""
        if self.time is None:
            self.time = time
        dt = round(time - self.time, 9)
        if dt <= 0:
            return
        self.time = time
        settings, people = self.settings, self.people
        survive = np.exp(-dt * settings.leaving(people.mean[:, 0, :2]))
        inside = settings.arrivals * settings.appear
        come = np.array([inside, settings.arrivals - inside])
        self.unseen = self.unseen * math.exp(-dt / settings.stay) + come * dt
        if len(people):
            before = people.mean, people.cov, people.mode
            people.mean, people.cov, people.mode, half, mixed = gaussian.predict(*before, settings.motion, dt)
            if self.record:
                people.node = Node.steps(people, before, half, mixed, survive, time)
            people.exist = people.exist * survive
        if self.sensors:
            mix = np.array([math.exp(-(s.hide + s.show) * dt) for s in self.sensors])
            rest = np.array([s.findable() for s in self.sensors])
            self.unseen_found = rest + (self.unseen_found - rest) * mix
            people.found = rest + (people.found - rest) * mix

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
        people, surface = self.people, self.settings.surface
        chance = people.found[:, column] * rates.detection
        gain = gains(people, z, noise, sensor.lead)

        odds = None if score is None or np.isnan(score).all() else logit(score)
        kappa = max(rates.clutter, 1e-9) / surface * rates.doubt(odds)
        strangers = rates.detection * self.unseen_found[column] * (self.settings.whereabouts(z) @ self.unseen)
        if self.settings.birth != "poisson":
            strangers = strangers * 0.0
        at = self.tentative
        room = self._elbow_room(
            np.concatenate([z, people.mean[at, 0, :2]]),
            np.concatenate([noise[:, 0, 0] + noise[:, 1, 1], people.cov[at, 0, 0, 0] + people.cov[at, 0, 1, 1]]) / 2,
        )
        strangers = strangers * room[: len(z)]
        from_tentative = (people.exist[at] * chance[at] * room[len(z) :])[:, None] * gain[at]
        rho = from_tentative.sum(0) + strangers
        background = kappa + rho
        free = np.ones(len(z))  # probability that no labelled person caused the detection
        options = self._options(people.exist, chance, gain, background)
        groups = [self._associate(members, options, free) for members in self._groups(options)]
        free = np.minimum(np.maximum(free, 0.0), 1.0)
        existence = rho / background

        if self.settings.adapt:
            rates.learn(float((free * (1 - existence)).sum()), *self._hits_and_misses(groups, chance, rates.detection))
        rates.learn_score(odds, 1 - free * (1 - existence))
        source = np.where(
            from_tentative.max(0, initial=0.0) > strangers, from_tentative.argmax(0) if self.tentative else -1, -1
        )
        births = self._births(free, existence, source)
        self.born, self.died = [], []
        if self.journal is not None:
            account = self._account(name, z, groups, free, existence, kappa, rho)
        self._rebuild(column, z, noise, groups, births)
        if self.journal is not None:
            self.journal.append({**account, "born": self.born, "died": self.died})
        missed = self.unseen_found[column] * sensor.detection
        self.unseen *= 1 - missed
        self.unseen_found[column] *= (1 - sensor.detection) / max(1 - missed, 1e-12)

    def _elbow_room(self, places, spread):
        """Probability (n,) that someone new at places (n, 2), known to variances (n,), is not inside a known person."""
        leaves = [leaf for c in self.clusters for leaf in c.rows[0] if leaf >= 0]
        if not leaves or not len(places):
            return np.ones(len(places))
        away = places - (self.people.mode[leaves, None] @ self.people.mean[leaves, :, :2])
        body = self.settings.body**2
        width = body + spread
        taken = body / width * np.exp(-(away * away).sum(-1) / (2 * width)) * self.people.exist[leaves, None]
        return (1 - taken).prod(0)

    def _options(self, exist, chance, gain, background):
        """What each labelled density may have caused: index -> [(log weight, detection or -1)], best first."""
        rows = sorted({leaf for c in self.clusters for row in c.rows for leaf in row if leaf >= 0})
        if not rows:
            return {}
        present = exist[rows] * chance[rows]
        missed = np.log(np.maximum(1 - present, 1e-12)).tolist()
        hits = (present[:, None] * gain[rows] / background).tolist()
        options = {}
        for leaf, miss, hit in zip(rows, missed, hits, strict=True):
            found = [(math.log(h), j) for j, h in enumerate(hit) if h > 1e-300]
            options[leaf] = sorted([(miss, -1), *found], reverse=True) if found else [(miss, -1)]
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
        settings, people = self.settings, self.people
        priors = [(0.0, ())]
        for cluster in members:
            pairs = list(zip(cluster.weights, cluster.rows, strict=True))
            priors = [(w + v, left + right) for w, left in priors for v, right in pairs]
            if len(priors) > settings.hypotheses:
                priors.sort(key=lambda prior: -prior[0])
                del priors[settings.hypotheses :]
        numbers, same = {}, {-1: -1}  # densities of a label with the same recent past count as one
        for leaf in sorted({leaf for _, row in priors for leaf in row if leaf >= 0}):
            same[leaf] = numbers.setdefault(
                (people.label[leaf], people.past[leaf][1 - settings.memory :]), len(numbers)
            )
        pasts = [tuple([same[leaf] for leaf in row]) for _, row in priors]
        merged = {}
        for weight, number, taken, used in ranked(priors, options, BUDGET * settings.hypotheses, -LOG_PRUNE):
            key = pasts[number], taken
            best = merged.get(key)
            if best:
                best[0] += math.log1p(math.exp(weight - best[0]))
            else:
                merged[key] = [weight, number, taken, used]
        kept = sorted(merged.values(), key=lambda h: -h[0])[: settings.hypotheses]
        top = kept[0][0]
        kept = [
            [weight, tuple(zip(priors[number][1], taken, strict=True)), used]
            for weight, number, taken, used in kept
            if weight - top > LOG_PRUNE
        ]
        total = top + math.log(math.fsum(math.exp(h[0] - top) for h in kept))
        for hypothesis in kept:
            hypothesis[0] -= total
            share, used = math.exp(hypothesis[0]), hypothesis[2]
            while used:
                low = used & -used
                free[low.bit_length() - 1] -= share
                used ^= low
        return [label for cluster in members for label in cluster.labels], kept

    def _hits_and_misses(self, groups, chance, detection):
        """Expected numbers of people found, and of those missed who could be found, among who surely exists."""
        hits = misses = 0.0
        for _, hypotheses in groups:
            for leaf, j in hypotheses[0][1]:
                if leaf >= 0 and self.people.exist[leaf] > 0.9:
                    if j >= 0:
                        hits += 1
                    else:
                        misses += chance[leaf] * (1 - detection) / max(detection * (1 - chance[leaf]), 1e-12)
        return hits, misses

    # --- the densities after a record ---------------------------------------------------------------------------------

    def _births(self, free, existence, source):
        """People that detections may reveal: [(detection, tentative density or -1, number, existence)]."""
        if self.settings.birth == "poisson":
            number, least = existence * free, 10 * TENTATIVE
        else:  # known people only; strangers are born for the next record, as many as are expected (Trezza et al. 2022)
            number, least = existence * free * (source >= 0), 10 * TENTATIVE
        births = []
        for j in np.flatnonzero(number > least).tolist():
            at = self.tentative[source[j]] if source[j] >= 0 else -1
            births.append((j, at, float(number[j]), float(existence[j])))
        if self.settings.birth != "poisson":
            stranger = free * (1 - existence)
            share = np.minimum(self.settings.newborn, stranger / max(stranger.sum(), 1e-12) * self.settings.newborn)
            births += [(j, -1, float(share[j]), 0.0) for j in np.flatnonzero(share > least).tolist()]
        return births

    def _rebuild(self, column, z, noise, groups, births):
        """Compute each density that is needed once, and make clusters and tentative people of them."""
        people, sensor, detection = self.people, self.sensors[column], self.rates[column].detection
        pairs = dict.fromkeys(chain.from_iterable(h[1] for _, hs in groups for h in hs))
        hidden = people.found[:, column]
        left = people.exist * (1 - hidden * detection)
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

        parts = [people.take(miss + stay)]
        old, parents = parts[0], miss + stay
        seen = old.found[:, column]
        overlooked = 1 - seen * detection
        n = len(miss)
        present = old.exist[:n]
        explained = np.maximum(1 - present * seen[:n] * detection, 1e-12)
        old.exist = old.exist * overlooked
        old.exist[:n] /= explained
        old.found[:, column] = seen * (1 - detection) / np.maximum(overlooked, 1e-12)
        old.past = [(*past[1 - self.settings.memory :], 0) for past in old.past]
        stamp = self.scans << 16
        if hit or renewed:
            new = people.take([leaf for leaf, _ in hit + renewed])
            js = [j for _, j in hit + renewed]
            new.mean, new.cov, new.mode = gaussian.update(new.mean, new.cov, new.mode, z[js], noise[js], sensor.lead)
            new.exist, new.found[:, column] = np.ones(len(js)), 1.0
            memory = 1 - self.settings.memory
            new.past = [(*past[memory:], stamp | j) for past, j in zip(new.past, js, strict=True)]
            parts.append(new)
        if fresh:
            parts.append(self._newcomers(column, z[fresh], noise[fresh], [stamp | j for j in fresh]))
        if self.record:
            for part in parts:
                part.node = [Node.fork(node, self.time) for node in part.node]
        self.people = people = Densities.join(parts) if len(parts) > 1 else old

        place = {(leaf, -1): k for k, leaf in enumerate(miss)}
        place.update((pair, len(parents) + k) for k, pair in enumerate(hit + renewed))
        place[-1, -1] = -1
        newcomer = {j: len(parents) + len(hit) + len(renewed) + k for k, j in enumerate(fresh)}
        self.tentative = list(range(len(miss), len(parents)))
        self.clusters, labels_taken = [], {label for labels, _ in groups for label in labels}
        for j, at, number, existence in births:
            row = place[at, j] if at >= 0 else newcomer[j]
            people.exist[row] = existence
            if number >= PROMOTE:
                self._promote(row, groups, j, labels_taken, place)
            else:
                people.exist[row] = number
                self.tentative.append(row)
        for labels, hypotheses in groups:
            rows = [tuple([place[pair] for pair in h[1]]) for h in hypotheses]
            self._settle(Cluster(labels, rows, [h[0] for h in hypotheses]))

    def _newcomers(self, column, z, noise, stamps):
        """Densities of people seen for the first time by one sensor's detections."""
        n, m, sensor = len(z), len(self.stationary), self.sensors[column]
        mean, cov = np.zeros((n, m, 4)), np.zeros((n, m, 4, 4))
        mean[..., :2] = z[:, None]
        cov[..., :2, :2] = noise[:, None] + sensor.lead**2 / 2 * np.eye(2)
        cov[..., 2:, 2:] = self.settings.speed**2 * np.eye(2)
        found = np.tile(self.unseen_found, (n, 1))
        found[:, column] = 1.0
        mode = np.tile(self.stationary, (n, 1))
        return Densities(mean, cov, mode, np.ones(n), found, [-1] * n, [(stamp,) for stamp in stamps], [None] * n)

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
        """Keep a cluster: without the labels that hardly exist, and apart from those that are independent."""
        people = self.people
        at = 0
        while at < len(cluster.labels):
            shares, exists = cluster.marginals(at, people.exist)
            if exists < RECYCLE:
                self._recycle(cluster.labels[at], shares, exists)
                cluster = cluster.without(at)
            elif len(cluster.labels) > 1 and (self.factorise or self._independent(cluster, at, shares)):
                self._keep_alone(cluster.labels[at], shares)
                cluster = cluster.without(at)
            else:
                at += 1
        if cluster.labels:
            self.clusters.append(cluster)

    def _independent(self, cluster, at, shares):
        """Whether the joint weights are the product of one label's and the others', but for INDEPENDENT."""
        if len(shares) == 1:
            return True
        joint, rest = {}, {}
        for row, share in zip(cluster.rows, cluster.shares, strict=True):
            others = row[:at] + row[at + 1 :]
            rest[others] = rest.get(others, 0.0) + share
            joint[others, row[at]] = share
        if len(rest) == 1:
            return True
        if len(joint) < len(rest) + len(shares) - 1:
            return False
        apart = 0.0
        for others, share in rest.items():
            for leaf, own in shares.items():
                apart += abs(joint.get((others, leaf), 0.0) - share * own)
        return apart < 2 * INDEPENDENT

    def _keep_alone(self, label, shares):
        rows = sorted(shares, key=lambda leaf: (-shares[leaf], leaf))
        self.clusters.append(Cluster([label], [(leaf,) for leaf in rows], [math.log(shares[leaf]) for leaf in rows]))

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
                {"weight": math.exp(weight), "detections": [None if j < 0 else j for _, j in pairs]}
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
                for place, f, r, k, s in zip(
                    z.tolist(),
                    free.tolist(),
                    existence.tolist(),
                    np.broadcast_to(kappa, free.shape).tolist(),
                    rho.tolist(),
                    strict=True,
                )
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
        mean, cov = gaussian.moments(people.mean[rows], people.cov[rows], people.mode[rows])
        return [
            Track(label, mean[k], cov[k], exists, dict(zip(self.column, people.found[leaf].tolist(), strict=True)))
            for k, (label, leaf, exists, _) in enumerate(found)
        ]


class Rates:
    """A sensor's clutter and detection probability as believed now, and how sure its detections usually are."""

    def __init__(self, sensor):
        self.clutter, self.detection, self.typical = sensor.clutter, sensor.detection, None
        self.clutter_sum, self.clutter_count = 3.0 * sensor.clutter, 3.0
        self.hit_sum, self.hit_count = 60.0 * sensor.detection, 60.0

    def learn(self, clutter, hits, misses):
        """Take in one record: expected false detections, people found, findable people missed."""
        keep = 0.995
        self.clutter_sum, self.clutter_count = self.clutter_sum * keep + clutter, self.clutter_count * keep + 1
        self.hit_sum, self.hit_count = self.hit_sum * keep + hits, self.hit_count * keep + hits + misses
        self.clutter = min(max(self.clutter_sum / self.clutter_count, 1e-3), 1e3)
        self.detection = min(max(self.hit_sum / self.hit_count, 0.05), 0.99)

    def learn_score(self, odds, real):
        """Take in the scores' log odds (J,) of one record, each as far as it probably was a person: real (J,)."""
        if odds is None:
            return
        known = ~np.isnan(odds)
        weight = float(real[known].sum())
        if weight > 1e-3:
            share = 1.0 if self.typical is None else 0.1 * min(weight, 1.0)
            now = float(odds[known] @ real[known]) / weight
            self.typical = now if self.typical is None else self.typical + share * (now - self.typical)

    def doubt(self, odds):
        """How much more clutter than usual each detection stands for, by its log odds (J,) against people's: (J,)."""
        if odds is None:
            return 1.0
        typical = float(odds[~np.isnan(odds)].max()) if self.typical is None else self.typical
        return np.exp(np.minimum(np.maximum(np.where(np.isnan(odds), 0.0, typical - odds), -1.0), 4.0))


def logit(score):
    """Log odds of probabilities, held within 0.01 % and 99.99 %."""
    score = np.minimum(np.maximum(score, 1e-4), 1 - 1e-4)
    return np.log(score / (1 - score))


def gains(people, z, noise, lead):
    """Likelihood of each detection under each density, 0 outside the gate: (n, J)."""
    if not len(people) or not len(z):
        return np.zeros((len(people), len(z)))
    log, distance = gaussian.loglikelihood(people.mean, people.cov, z, noise, lead)
    return (people.mode[:, None] @ np.where(distance < GATE, np.exp(log), 0.0))[:, 0]


def distinct(z, noise, score):
    """Detections in a defined order, without exact repetitions: the same arguments, (J, 2), (J, 2, 2), (J,) or None."""
    if len(z) < 2:
        return z, noise, score
    order = np.lexsort((z[:, 1], z[:, 0]))
    same = (z[order[1:]] == z[order[:-1]]).all(1)
    if same.any():
        order = np.lexsort((*noise.reshape(-1, 4).T, z[:, 1], z[:, 0]))[np.r_[True, ~same]]
    return z[order], noise[order], None if score is None else score[order]
