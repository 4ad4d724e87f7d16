"""T-GOSPA, a metric between sets of trajectories, solved exactly where that is affordable."""

import numpy as np

from avcli.metrics.sequence import Sequence

_STATES = 600
_STEPS = 2e8
"""Most assignments of one frame, and most transitions in all, that are tried: about a second."""


def tgospa(
    sequence: Sequence, cutoff: float, order: float = 1.0, switch: float | None = None
) -> tuple[float, float] | None:
    """Measure how far the tracked trajectories are from the true ones: localization, misses, false tracks and switches.

    The assignment of tracks to people may change from frame to frame at a price, so the best course is a shortest path
    through all partial assignments of all frames. A track is assigned only to people that it comes nearer to than the
    cutoff, since any other pair costs as much as leaving both unassigned. These pairs form a graph; its connected
    components are solved separately.

    Args:
        sequence: ground truth and tracks.
        cutoff: c in m; a missed or a false point costs c^p / 2.
        order: p >= 1.
        switch: gamma in m, the price of a change from one track to another, by default the cutoff; a change from or to
            none costs gamma^p / 2.

    Returns:
        The distance over all frames, m, and the part of its p-th power that switches cost, m^p. None if a component has
        too many people and tracks for an exact solution.

    Source: A. F. García-Fernández, A. S. Rahmathullah and L. Svensson, "A metric on the space of finite sets of
    trajectories for evaluation of multi-target tracking algorithms", IEEE TSP 68, 2020, definition 1.
    """
    gamma = (cutoff if switch is None else switch) ** order
    frame, true, tracked, gain = _gains(sequence, cutoff, order)
    component = _components(sequence.truth.label.size, sequence.track.label.size, true, tracked)
    part = component[true]
    saved = paid = 0.0
    assigned = 0
    for number in np.unique(part):
        inside = part == number
        solved = _best_course(sequence.time.size, frame[inside], true[inside], tracked[inside], gain[inside], gamma)
        if solved is None:
            return None
        saved, paid, assigned = saved + solved[0], paid + solved[1], assigned + solved[2]
    half = cutoff**order / 2
    missed, false = (sequence.truth.identity.size - assigned) * half, (sequence.track.identity.size - assigned) * half
    localization = max(0.0, 2 * half * assigned - saved)
    return (localization + missed + false + paid) ** (1 / order), paid


def _gains(sequence: Sequence, cutoff: float, order: float) -> tuple[np.ndarray, ...]:
    """Frame, identities and gain c^p - d^p over leaving both alone, of each pair nearer than the cutoff."""
    found = [(np.zeros(0, int), np.zeros(0, int), np.zeros(0, int), np.zeros(0))]
    for groups in sequence.blocks():
        for group in groups:
            f, row, column = np.nonzero(group.distance < cutoff)
            found.append(
                (
                    group.frame[f],
                    sequence.truth.identity[group.truth[f, row]],
                    sequence.track.identity[group.track[f, column]],
                    cutoff**order - group.distance[f, row, column] ** order,
                )
            )
    return tuple(np.concatenate(column) for column in zip(*found, strict=True))


def _components(people: int, tracks: int, true: np.ndarray, tracked: np.ndarray) -> np.ndarray:
    """Number (people,) of the connected component of each person in the graph of the pairs."""
    person, track = np.arange(people), np.full(tracks, people)
    while True:
        np.minimum.at(track, tracked, person[true])
        joined = person.copy()
        np.minimum.at(joined, true, track[tracked])
        if (joined == person).all():
            return person
        person = joined


def _best_course(
    frames: int, frame: np.ndarray, true: np.ndarray, tracked: np.ndarray, gain: np.ndarray, gamma: float
) -> tuple[float, float, int] | None:
    """Gain, price of the switches and number of assigned points of the best course of assignments of one component."""
    people, true = np.unique(true, return_inverse=True)
    tracks, tracked = np.unique(tracked, return_inverse=True)
    pairs = np.unique(true * tracks.size + tracked)
    states = _partial_assignments(people.size, [(p // tracks.size, p % tracks.size) for p in pairs.tolist()])
    if states is None or len(states) ** 2 * frames > _STEPS:
        return None
    switch = np.zeros((len(states), len(states)))
    for column in states.T:
        differs = column[:, None] != column[None, :]
        none = (column[:, None] < 0) | (column[None, :] < 0)
        switch += gamma * np.where(differs, np.where(none, 0.5, 1.0), 0.0)
    rewards = np.zeros((frames, people.size, tracks.size + 1))
    rewards[frame, true, tracked] = gain
    reward = rewards[:, np.arange(people.size), states].sum(axis=2)
    near = (rewards > 0)[:, np.arange(people.size), states].sum(axis=2)

    best, came = reward[0], np.zeros((frames, len(states)), dtype=int)
    for t in range(1, frames):
        through = best[None, :] - switch
        came[t] = through.argmax(axis=1)
        best = through[np.arange(len(states)), came[t]] + reward[t]
    state, paid, assigned, saved = int(best.argmax()), 0.0, 0, 0.0
    for t in range(frames - 1, -1, -1):
        saved, assigned = saved + reward[t, state], assigned + int(near[t, state])
        if t:
            paid += switch[state, came[t, state]]
            state = int(came[t, state])
    return saved, paid, assigned


def _partial_assignments(people: int, pairs: list[tuple[int, int]]) -> np.ndarray | None:
    """All maps (s, people) of people to different tracks or -1 along these pairs; None if there are too many."""
    choices = [[-1] + [track for person, track in pairs if person == k] for k in range(people)]
    states: list[tuple[int, ...]] = [()]
    for choice in choices:
        states = [(*state, track) for state in states for track in choice if track < 0 or track not in state]
        if len(states) > _STATES:
            return None
    return np.array(states)
