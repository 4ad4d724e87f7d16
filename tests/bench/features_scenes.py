"""Scenes in which only looks or voice can tell who is who: people who meet within 0.2 m and go apart again.

Features are drawn from the model that avcli.formats.features has of a kind: a person's own values, and errors of which
a share lasts. Where two people are nearer than 0.35 m, a vector may be a mixture of both.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from tracking_scenes import ROOM, People, Rng, Scene, assemble, clock, long_pair, ten, waypoints

from avcli.formats.features import Feature, Population, known

MIXED = 0.35  # m


@dataclass(frozen=True)
class Drawn:
    """How features of one name are drawn.

    Attributes:
        sensor: that measures them.
        kind: of the vectors.
        population: of people, and of errors.
        told: standard deviation that is told, by the true one.
        given: share of detections that have the feature.
    """

    sensor: str
    kind: str
    population: Population
    told: float = 1.0
    given: float = 1.0


def parting(rng: Rng) -> Scene:
    """Two people walk up to each other, stand within 0.2 m for 1 to 4 s, and walk on or turn back, at random."""
    t = clock(14.0)
    centre, meet = ROOM / 2 + rng.uniform(-0.4, 0.4, 2), 4.0
    part = meet + rng.uniform(1.0, 4.0)
    back = rng.random() < 0.5
    turn = 0.0 if rng.random() < 0.5 else rng.choice([-1.0, 1.0]) * np.pi / (part - meet)  # about each other
    come = rng.uniform(0, 2 * np.pi) + np.array([0.0, np.pi + rng.uniform(-1.0, 1.0)])
    speed = rng.uniform(0.6, 1.2, 2)
    talks = np.repeat(rng.integers(0, 2, len(t) // 20 + 1), 20)[: len(t)]
    people = People()
    for k in (0, 1):
        stand = come[k] + turn * (t - meet).clip(0, part - meet)
        go = come[k] if back else come[1 - k]
        path = centre + 0.09 * _unit(stand) + _unit(come[k]) * (speed[k] * (meet - t).clip(0))[:, None]
        path += _unit(go) * (speed[1 - k] * (t - part).clip(0))[:, None]
        people.add(t, path.clip(0.3, ROOM - 0.3), talks == k)
    return assemble(rng, people, 14.0)


def returning(rng: Rng) -> Scene:
    """Five visits by at most four people, one after the other, through any wall, 3 to 8 s apart."""
    visits, who, begin = People(), rng.integers(0, 4, 5), 0.0
    for _ in who:
        t = begin + clock(rng.uniform(7.0, 10.0))
        come, leave = (ROOM / 2 + 2.1 * _unit(angle) for angle in rng.uniform(0, 2 * np.pi, 2))
        path = waypoints(rng, t, come)
        steps = max(int(np.linalg.norm(leave - path[-1]) / 0.1), 1)
        path = np.vstack([path, path[-1] + np.arange(1, steps + 1)[:, None] / steps * (leave - path[-1])])
        t = np.round(begin + 0.1 * np.arange(len(path)), 6)
        visits.add(t, path, rng.random() < 0.5)
        begin = round(t[-1] + rng.uniform(3.0, 8.0), 1)
    scene = assemble(rng, visits, begin - 3.0)
    person = np.append(who, -1)  # of each visit; the last is for false detections
    truth = [(t, person[ids], xy) for t, ids, xy in scene.truth]
    records = [(t, name, z, sigma, person[owner]) for t, name, z, sigma, owner in scene.records]
    return replace(scene, truth=truth, records=records)


def _unit(angle: "float | np.ndarray") -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def with_features(rng: Rng, scene: Scene, drawn: Mapping[str, Drawn], *, alike: bool = False) -> Scene:
    """The same scene with features: name -> how they are drawn.

    Args:
        rng: for the features alone, so that the detections are the same for all.
        scene: without features.
        drawn: name -> how.
        alike: all people have the same own values and the same lasting errors: only new errors differ.
    """
    at = {round(t, 3): (ids.tolist(), xy) for t, ids, xy in scene.truth}
    people = sorted({i for _, ids, _ in scene.truth for i in ids.tolist()})
    features: list[dict[str, Feature]] = [{} for _ in scene.records]
    for name, how in drawn.items():
        one, d = how.population, len(how.population.mean)
        own = {i: one.mean + np.sqrt(one.between) * rng.standard_normal(d) for i in people}
        own = dict.fromkeys(people, own[people[0]]) if alike else own
        own[-1] = one.mean
        lasting, last = {i: rng.standard_normal(d) for i in own}, 0.0
        for row, (t, sensor, z, _, owner) in zip(features, scene.records, strict=True):
            if sensor != how.sensor:
                continue
            keep, last = np.exp(-(t - last) / one.correlation_s), t
            lasting = {i: keep * u + np.sqrt(1 - keep**2) * rng.standard_normal(d) for i, u in lasting.items()}
            if alike:
                lasting = dict.fromkeys(lasting, lasting[people[0]])
            sds = np.sqrt(one.within) * rng.uniform(0.8, 1.3, (len(z), 1)) * np.ones(d)
            vectors = np.empty((len(z), d))
            for j, i in enumerate(owner.tolist()):
                error = np.sqrt(one.correlated) * lasting[i] + np.sqrt(1 - one.correlated) * rng.standard_normal(d)
                value = _mixed(rng, i, own, *at[round(t, 3)])
                if i < 0:  # a false detection looks like anybody
                    value = one.mean + np.sqrt(one.between) * rng.standard_normal(d)
                vectors[j] = value + sds[j] * error
            vectors[rng.random(len(z)) > how.given] = np.nan
            row[name] = Feature(how.kind, vectors, sds * how.told)
    return replace(scene, features=features)


def _mixed(rng: Rng, i: int, own: dict[int, np.ndarray], ids: list[int], xy: np.ndarray) -> np.ndarray:
    """A person's own value, or a mixture with that of somebody who is near."""
    if i in ids:
        away = np.linalg.norm(xy - xy[ids.index(i)], axis=1)
        away[ids.index(i)] = np.inf
        if away.min(initial=np.inf) < MIXED and rng.random() < 0.6 * (1 - away.min() / MIXED):
            share = rng.random()
            return share * own[i] + (1 - share) * own[ids[int(away.argmin())]]
    return own[i]


def _drawn(sensor: str, kind: str, given: float = 1.0) -> Drawn:
    population = known(kind)
    assert population is not None
    return Drawn(sensor, kind, population, given=given)


LOOKS = {"looks": _drawn("video", "clothes")}
VOICE = {"voice": _drawn("audio", "pitch-envelope", given=0.44)}  # of steps of speech that have a clear pitch


def _case(scene: Callable[[Rng], Scene], drawn: Mapping[str, Drawn], alike: bool = False) -> Callable[[Rng], Scene]:
    def drawn_scene(rng: Rng) -> Scene:
        plain = scene(rng)
        return with_features(rng.spawn(1)[0], plain, drawn, alike=alike)

    return drawn_scene


FEATURED: dict[str, Callable[[Rng], Scene]] = {
    "parting": parting,
    "parting-looks": _case(parting, LOOKS),
    "parting-voice": _case(parting, VOICE),
    "parting-both": _case(parting, {**LOOKS, **VOICE}),
    "parting-alike": _case(parting, {**LOOKS, **VOICE}, alike=True),
    "returning": returning,
    "returning-looks": _case(returning, LOOKS),
    "ten-looks": _case(ten, LOOKS),
    "long-pair-looks": _case(long_pair, LOOKS),
}
"""Cases with and without features, and one in which all people look and sound the same."""
