"""Joint associations of targets and detections: ranked, exact where few and bounded where many."""

import math
from operator import itemgetter

FIRST = itemgetter(0)
ABSENT = ((0.0, -1),)


def ranked(priors, options, budget=1000, span=11.5):
    """The likeliest joint associations of several prior hypotheses, each detection used at most once.

    A branch and bound over targets, breadth first: a partial association is dropped when even its best completion
    (each remaining target takes its best detection, used or not) falls `span` nats below a feasible association. While
    no layer holds more than `budget` of them the list is exact down to exp(-span) of the best; beyond, the layer keeps
    those with the best bound (a beam, so the time is bounded).

    priors: list of (log weight, row), row a tuple of one density index per target (-1: target not there).
    options: density index -> list of (log weight, detection), detection -1 for "missed"; best first.
    Returns a list of (log weight, ((density, detection), ...), bit set of the used detections), best first.
    """
    if len(priors[0][1]) == 1:  # one target alone competes with nobody
        found = [
            (weight + gain, ((leaf, j),), 0 if j < 0 else 1 << j)
            for weight, (leaf,) in priors
            for gain, j in (options[leaf] if leaf >= 0 else ABSENT)
        ]
        found.sort(key=FIRST, reverse=True)
        floor = found[0][0] - span - 1e-9
        return [one for one in found if one[0] >= floor]
    beam, greedy = [], (-math.inf,)
    for number, (weight, row) in enumerate(priors):
        bound = weight + math.fsum(options[leaf][0][0] for leaf in row if leaf >= 0)
        beam.append((bound, number, (), 0))
        if bound > greedy[0]:
            greedy = max(greedy, _greedy(weight, row, options), key=FIRST)
    floor = greedy[0] - span - 1e-9
    for depth in range(len(priors[0][1])):
        grown, moves, steps = [], {-1: [(0.0, ((-1, -1),), 0)]}, []
        for _, row in priors:
            leaf = row[depth]
            if leaf not in moves:
                best = options[leaf][0][0]
                moves[leaf] = [(gain - best, ((leaf, j),), 0 if j < 0 else 1 << j) for gain, j in options[leaf]]
            steps.append(moves[leaf])
        for bound, number, taken, used in beam:
            least = floor - bound
            for loss, step, bit in steps[number]:
                if loss < least:
                    break
                if not used & bit:
                    grown.append((bound + loss, number, taken + step, used | bit))
        if len(grown) > budget:
            grown.sort(key=FIRST, reverse=True)
            del grown[budget:]
        beam = grown
    beam.sort(key=FIRST, reverse=True)
    # all that the budget kept may have ended in conflicts
    return [(weight, taken, used) for weight, _, taken, used in beam] or [greedy]


def _greedy(weight, row, options):
    """One feasible association: each target in turn takes its best detection that is left."""
    taken, used = [], 0
    for leaf in row:
        j = -1
        if leaf >= 0:
            for option in options[leaf]:
                gain, j = option
                if j < 0 or not used >> j & 1:
                    break
            weight += gain
            used |= 0 if j < 0 else 1 << j
        taken.append((leaf, j))
    return weight, tuple(taken), used
