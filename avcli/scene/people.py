"""People as posable bodies of rounded cones: skeleton, gait, gestures, clothes.

A body is posed for many times at once, by closed formulas from its motion. A rounded cone is the hull of two balls; it
may be flattened along one axis (chests, feet and hands are not round).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avcli.scene.dress import dress, shadow_balls, touching
from avcli.scene.person import LOOKS, Look, Person, speaking
from avcli.scene.skeleton import skeleton

__all__ = ["KEYPOINTS", "LOOKS", "Bodies", "Look", "Person", "pose", "speaking"]

KEYPOINTS = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle",
)  # fmt: skip
"""The 17 keypoints of COCO, in COCO's order."""


@dataclass
class Bodies:
    """Bodies at n times, p cones in all; room frame, metres.

    Attributes:
        times: (n,) s.
        a, b: (n, p, 3) ends of the axes of the cones.
        ra, rb: (p,) radii there.
        flat_axis: (n, p, 3) unit axis along which a cone is flattened about its middle, by flat (p,) in (0, 1].
        front: (n, p, 3) unit vector to the front of the part, which anchors what is painted on it.
        person: (p,) index of the person.
        touching: (p, 4) indices of cones whose surfaces blend smoothly with this one's, -1 for none.
        material: (p,) SKIN, KNIT...
        colours: (p, 3, 3) sRGB fractions of the cone before and beyond `split` (p,), a fraction of its axis, and of
            what is printed on it.
        balls: (n, people, 20, 4) a coarse body for soft shadows: centre and radius.
        keypoints: (n, people, 17, 3) COCO's keypoints.
        mouths: (n, people, 3).
    """

    times: np.ndarray
    a: np.ndarray
    b: np.ndarray
    ra: np.ndarray
    rb: np.ndarray
    flat_axis: np.ndarray
    flat: np.ndarray
    front: np.ndarray
    person: np.ndarray
    touching: np.ndarray
    material: np.ndarray
    colours: np.ndarray
    split: np.ndarray
    balls: np.ndarray
    keypoints: np.ndarray
    mouths: np.ndarray


def pose(people: Sequence[Person], t: np.ndarray) -> Bodies:
    """Pose people.

    Args:
        people: any number.
        t: (n,) s.
    """
    t = np.asarray(t, float)
    bones = [skeleton(person, t) for person in people]
    dressed = [dress(body, person) for body, person in zip(bones, people, strict=True)]
    offsets = np.cumsum([0] + [len(parts) for parts in dressed])
    parts = [part for one in dressed for part in one]
    n, p = len(t), len(parts)

    def stacked(rows: list[np.ndarray]) -> np.ndarray:
        points = np.empty((len(rows), n, 3))
        for place, row in zip(points, rows, strict=True):
            place[:] = row
        return points.swapaxes(0, 1)

    blends = [
        np.where(found >= 0, found + offset, -1)
        for found, offset in zip(map(touching, dressed), offsets[:-1], strict=True)
    ]
    joints = [found[name] for found in (body.joints() for body in bones) for name in KEYPOINTS]
    return Bodies(
        times=t,
        a=stacked([part.a for part in parts]),
        b=stacked([part.b for part in parts]),
        ra=np.array([part.ra for part in parts]),
        rb=np.array([part.rb for part in parts]),
        flat_axis=stacked([part.flat_axis for part in parts]),
        flat=np.array([part.flat for part in parts]),
        front=stacked([part.front for part in parts]),
        person=np.repeat(np.arange(len(people)), np.diff(offsets)),
        touching=np.concatenate(blends or [np.zeros((0, 4), int)]),
        material=np.array([part.material for part in parts], int),
        colours=np.array([[part.colour, part.beyond, part.second] for part in parts]).reshape(-1, 3, 3),
        split=np.array([part.split for part in parts]),
        balls=np.stack([shadow_balls(body) for body in bones], 1) if p else np.zeros((n, 0, 20, 4)),
        keypoints=stacked(joints).reshape(n, len(people), len(KEYPOINTS), 3),
        mouths=stacked([body.mouth for body in bones]),
    )
