"""Densities of single people, and clusters of joint hypotheses about them."""

import math

import numpy as np

INDEPENDENT = 0.05  # total variation of two labels' joint weights from their product that passes for independence
ALIKE = np.array([0.14, 0.14, 0.6, 0.6])  # m, m/s; densities of a label as near as this pass for one
TWINS = np.array([0.035, 0.035, 0.14, 0.14])  # m, m/s; densities of two labels as near as this are of the same person
TWIN_FOUND = 0.2  # as far as the probabilities that sensors find them are as near as this


class Densities:
    """Rows of single-person densities.

    mean (n, M, 4), cov (n, M, 4, 4), mode (n, M): the mixture over motion models. exist (n,): probability of existence,
    or of a tentative person the expected number. found (n, S): probability that each sensor can find the person.
    label (-1: none yet), node (for smoothing): lists of n.
    """

    def __init__(self, mean, cov, mode, exist, found, label, node):
        self.mean, self.cov, self.mode, self.exist, self.found = mean, cov, mode, exist, found
        self.label, self.node = label, node

    def __len__(self):
        return len(self.label)

    def take(self, rows):
        """The given rows (a list), in that order."""
        at = np.array(rows, int)
        arrays = [a.take(at, 0) for a in (self.mean, self.cov, self.mode, self.exist, self.found)]
        return Densities(*arrays, [self.label[i] for i in rows], [self.node[i] for i in rows])

    @staticmethod
    def join(parts):
        """All rows of several, one after another."""
        arrays = (np.concatenate([getattr(p, k) for p in parts]) for k in ("mean", "cov", "mode", "exist", "found"))
        lists = ([value for p in parts for value in getattr(p, k)] for k in ("label", "node"))
        return Densities(*arrays, *lists)

    def centres(self, rows):
        """Mean states of some rows (a list of n): (n, 4)."""
        return (self.mode.take(rows, 0)[:, None] @ self.mean.take(rows, 0))[:, 0]

    def match(self, rows, shares):
        """Give the first of some rows (a list of n) the moments of all, by their shares (n,), model by model."""
        share, first = np.array(shares) / math.fsum(shares), rows[0]
        modes = self.mode.take(rows, 0)
        self.mode[first] = mode = share @ modes
        weight = (share[:, None] * modes / mode).T[:, None]  # (M, 1, n)
        means = self.mean.take(rows, 0).swapaxes(0, 1)
        self.mean[first] = mean = (weight @ means)[:, 0]
        away = (means - mean[:, None]) * np.sqrt(weight).swapaxes(1, 2)
        covs = self.cov.take(rows, 0).reshape(len(rows), -1, 16).swapaxes(0, 1)
        self.cov[first] = (weight @ covs).reshape(-1, 4, 4) + away.swapaxes(1, 2) @ away
        self.exist[first] = share @ self.exist.take(rows)
        self.found[first] = share @ self.found.take(rows, 0)


class Cluster:
    """Joint hypotheses about some labels: rows of one density per label (-1: no such person) and their log weights."""

    def __init__(self, labels, rows, weights):
        self.labels, self.rows, self.weights = labels, rows, weights
        self.shares = [math.exp(weight) for weight in weights]

    def marginals(self, at, exist):
        """Of the label in column `at`: {density: its probability}, and the probability that the label exists."""
        if len(self.rows) == 1:
            leaf = self.rows[0][at]
            return {leaf: 1.0}, float(exist[leaf]) if leaf >= 0 else 0.0
        shares = {}
        for row, share in zip(self.rows, self.shares, strict=True):
            leaf = row[at]
            shares[leaf] = shares.get(leaf, 0.0) + share
        return shares, math.fsum(share * exist[leaf] for leaf, share in shares.items() if leaf >= 0)

    def merged(self, labels, rows):
        """The cluster of other rows, one for each of this one's, about `labels`; equal rows become one."""
        shares = {}
        for row, share in zip(rows, self.shares, strict=True):
            shares[row] = shares.get(row, 0.0) + share
        rows = sorted(shares, key=lambda row: -shares[row])
        return Cluster(labels, rows, [math.log(shares[row]) for row in rows])

    def only(self, columns):
        """The cluster of some of the labels, by their columns."""
        rows = [tuple([row[at] for at in columns]) for row in self.rows]
        return self.merged([self.labels[at] for at in columns], rows)

    def parts(self):
        """Columns in parts, between which no two labels depend on each other but for INDEPENDENT: a list of lists."""
        count, shares, held, owner = len(self.labels), np.array(self.shares), [], []
        for column, leaves in enumerate(zip(*self.rows, strict=True)):
            distinct = set(leaves)
            if len(distinct) > 1:  # whoever is the same in all rows depends on nobody
                held += [[leaf == one for leaf in leaves] for one in sorted(distinct)]
                owner += [column] * len(distinct)
        held, owner = np.array(held, float).reshape(-1, len(shares)), np.array(owner)[:, None] == np.arange(count)
        alone = held @ shares
        linked = owner.T @ abs(held * shares @ held.T - alone[:, None] * alone) @ owner > 2 * INDEPENDENT
        parts, left = [], set(range(count))
        while left:
            part = reach = {min(left)}
            while reach:
                left -= reach
                reach = {b for a in reach for b in left if linked[a, b]}
                part = part | reach
            parts.append(sorted(part))
        return parts

    def condensed(self, people):
        """The cluster with each label's densities that are ALIKE merged, in people: Densities, and so equal rows."""
        shares = {}
        for row, share in zip(self.rows, self.shares, strict=True):
            for leaf in row:
                if leaf >= 0:
                    shares[leaf] = shares.get(leaf, 0.0) + share
        leaves = sorted(shares, key=lambda leaf: (people.label[leaf], -shares[leaf], leaf))
        if len(leaves) <= len(self.labels):
            return self
        states = (people.centres(leaves) / ALIKE).view(complex).tolist()
        heads, groups, label = [], [], None  # of one label: likeliest densities, and which are like each of them
        for leaf, (place, pace) in zip(leaves, states, strict=True):
            if people.label[leaf] != label:
                heads, label = [], people.label[leaf]
            for there, that, group in heads:
                if abs(place - there) ** 2 + abs(pace - that) ** 2 < 1:
                    group.append(leaf)
                    break
            else:
                groups.append([leaf])
                heads.append((place, pace, groups[-1]))
        if len(groups) == len(leaves):
            return self
        same = {-1: -1}
        for group in groups:
            same.update(dict.fromkeys(group, group[0]))
            if len(group) > 1:
                people.match(group, [shares[leaf] for leaf in group])
        return self.merged(self.labels, [tuple([same[leaf] for leaf in row]) for row in self.rows])

    def decided(self, people):
        """The cluster without hypotheses that differ from a likelier one in who is who alone, in people: Densities.

        Where the same people stand in the same places under other names, no later record can tell which is right: the
        likelier names stay, so that they do not come and go with the last digits of the weights.
        """
        leaves = sorted({leaf for row in self.rows for leaf in row if leaf >= 0})
        if len(leaves) <= len(self.labels):
            return self
        state = people.centres(leaves) / TWINS
        apart = np.square(state[:, None] - state).sum(-1)
        found = people.found.take(leaves, 0) / TWIN_FOUND
        apart += np.square(found[:, None] - found).sum(-1)
        twin = (apart < 1).argmax(1).tolist()
        place = {-1: -1, **dict(zip(leaves, twin, strict=True))}
        shares, first = {}, {}
        for row, share in zip(self.rows, self.shares, strict=True):
            row = first.setdefault(tuple(sorted([place[leaf] for leaf in row])), row)
            shares[row] = shares.get(row, 0.0) + share
        if len(shares) == len(self.rows):
            return self
        rows = sorted(shares, key=lambda row: -shares[row])
        return Cluster(self.labels, rows, [math.log(shares[row]) for row in rows])
