"""Who speaks when: conversations of groups that run beside each other."""

import numpy as np

_GAP_S = 0.2, 0.35
"""s, mean and spread of the silence between two turns; negative: they overlap (Heldner and Edlund, 2010, figure 2)."""
_NODS = 0.25  # share of turns in which a listener puts in a word
_LAUGHS = 0.06  # share of turns after which all laugh


def conversations(
    groups: list[list[int]], people: int, duration: float, generator: np.random.Generator
) -> list[list[list[float]]]:
    """Draw turns to speak.

    One of a group speaks after another, with short pauses and now and then an overlap; a listener puts in a word, and
    sometimes all laugh at once.

    Args:
        groups: numbers of people who talk to each other; somebody in no group is silent.
        people: how many there are.
        duration: s.
        generator: of all chance.

    Returns:
        Turns [begin, end] in s of each person, in order.
    """
    turns: list[list[list[float]]] = [[] for _ in range(people)]
    for group in groups:
        _converse(group, turns, duration, generator)
    return turns


def _converse(group: list[int], turns: list[list[list[float]]], duration: float, g: np.random.Generator) -> None:
    clock, last = float(g.uniform(0.0, 0.5)), -1
    while group and clock < duration:
        last = int(g.choice([p for p in group if p != last] or group))
        length = float(np.clip(g.exponential(2.5), 0.8, 8.0))
        begin, end = round(clock, 2), round(min(clock + length, duration), 2)
        _speak(turns[last], begin, end)
        listeners = [p for p in group if p != last]
        if listeners and length > 1.5 and g.random() < _NODS:
            word = round(clock + float(g.uniform(0.5, length - 0.7)), 2)
            _speak(turns[int(g.choice(listeners))], word, round(min(word + float(g.uniform(0.3, 0.6)), duration), 2))
        clock = max(end + float(g.normal(*_GAP_S)), begin + 0.3)
        if len(group) > 1 and g.random() < _LAUGHS:
            for person in group:
                start = round(end + float(g.uniform(0.05, 0.4)), 2)
                stop = round(min(start + float(g.uniform(0.5, 1.2)), duration), 2)
                _speak(turns[person], start, stop)
            clock = end + 1.2


def _speak(turns: list[list[float]], begin: float, end: float) -> None:
    """Add a turn, unless the person speaks already."""
    if end > begin and (not turns or begin >= turns[-1][1]):
        turns.append([begin, end])
