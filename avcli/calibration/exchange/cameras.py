"""A camera as a tool describes it, and which lens models each tool knows."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from avcli.calibration.exchange.nearest import Fitted, Projection, Samples, Splined, nearest
from avcli.lens import LENSES, OFF_CENTRE, TANGENTIAL, Lens, name_of

KNOWN = ("theta_max_observed_deg", "theta_max_trusted_deg", "theta_max_valid_deg", "image_circle_px")
"""Keys of camera_config that say where a lens is known. Other tools get them as comments."""


@dataclass(frozen=True)
class Camera:
    """A camera as some tool describes it.

    Attributes:
        lens: a model of avcli.lens, or one that it lacks.
        size: (width, height) px; None where the file does not say.
        name: of the camera in its file.
        known: values of the keys in KNOWN, as far as there are any.
        T_reference_camera: (4, 4), the pose in the room or in the tool's reference frame; None: unknown.
        lost: what the file says that goes nowhere else.
    """

    lens: Projection
    size: tuple[int, int] | None
    name: str = "camera"
    known: Mapping[str, Any] = field(default_factory=dict)
    T_reference_camera: np.ndarray | None = None
    lost: tuple[str, ...] = ()

    @property
    def theta_max(self) -> float:
        """The largest angle from the axis, rad, up to which the lens is known."""
        seen = self.known.get("theta_max_trusted_deg", self.known.get("theta_max_observed_deg", 180.0))
        return float(np.deg2rad(min(seen, self.known.get("theta_max_valid_deg", 180.0))))

    @property
    def model(self) -> str:
        """The name of its lens model."""
        if isinstance(self.lens, Lens):
            return name_of(self.lens)
        return "splined" if isinstance(self.lens, Splined) else getattr(self.lens, "text", "foreign")


_SAME: tuple[tuple[str, str, dict[str, float], dict[str, float]], ...] = (
    ("brown_conrady", "rational", {"k4": 0.0}, {"k4": 0.0}),
    ("rational", "brown_conrady", {"k4": 0.0, "k5": 0.0, "k6": 0.0}, {"k4": 0.0}),
    ("ucm", "eucm", {}, {"beta": 1.0}),
    ("ucm", "double_sphere", {}, {"xi": 0.0}),
    ("eucm", "ucm", {"beta": 1.0}, {}),
    ("eucm", "double_sphere", {"beta": 1.0}, {"xi": 0.0}),
    ("double_sphere", "ucm", {"xi": 0.0}, {}),
    ("double_sphere", "eucm", {"xi": 0.0}, {"beta": 1.0}),
)
"""Lenses of one model that are lenses of another: the models, what the first must have, and what the second gets."""


class Choice(NamedTuple):
    """A lens model of another tool.

    name: what the tool calls it. model: its name in LENSES. names: the coefficients in the tool's order; those of the
    model that are not among them must be 0.
    """

    name: str
    model: str
    names: tuple[str, ...]

    def kind(self, tangential: bool) -> type[Lens]:
        """The class of its lenses, without or with tangential terms."""
        return (TANGENTIAL if tangential and "p1" in self.names else LENSES).get(self.model, LENSES[self.model])

    def values(self, lens: Lens) -> list[float]:
        """The coefficients of a lens in the tool's order."""
        return [float(getattr(lens, name, 0.0)) for name in self.names]

    def lens(self, core: Iterable[float], values: Iterable[float]) -> Lens:
        """The lens of fx, fy, cx, cy (px) and the coefficients in the tool's order; missing ones are 0.

        Raises:
            ValueError: they are not finite, or the model cannot have them.
        """
        given = dict(zip(self.names, map(float, values), strict=False))
        kind = self.kind(any(given.get(name) for name in OFF_CENTRE))
        numbers = [*map(float, core), *(given.get(name, 0.0) for name in kind.names()[4:])]
        if not np.isfinite(numbers).all():
            raise ValueError("the lens has a number that is not finite")
        made = kind(*numbers)
        if not made.is_possible:
            raise ValueError(f"no {self.name} lens has these numbers: {', '.join(f'{v:g}' for v in numbers)}")
        return made

    def same(self, source: Projection) -> Lens | None:
        """A lens as one of this model, where it is exactly one; else None."""
        if not isinstance(source, Lens):
            return None
        given = dict(zip(source.names(), source.parameters, strict=True))
        if name_of(source) != self.model:
            for one, other, needs, gives in _SAME:
                if (name_of(source), self.model) == (one, other) and all(given[key] == needs[key] for key in needs):
                    given = {**{key: value for key, value in given.items() if key not in needs}, **gives}
                    break
            else:
                return None
        core, rest = [given.pop(name) for name in ("fx", "fy", "cx", "cy")], given
        if any(value for name, value in rest.items() if name not in self.names):
            return None
        return self.lens(core, [rest.get(name, 0.0) for name in self.names])

    def nearest(self, source: Projection, seen: Samples) -> Fitted:
        """The lens of this model that comes nearest to another (see `nearest`)."""
        turned = not isinstance(source, Lens) or any(getattr(source, name, 0.0) for name in OFF_CENTRE)
        kind = self.kind(turned)
        free = self.names if turned else tuple(name for name in self.names if name not in OFF_CENTRE)
        return nearest(source, kind, seen, {name: 0.0 for name in kind.names()[4:] if name not in free})


_RADTAN = ("k1", "k2", "p1", "p2")
_FISHEYE = ("k1", "k2", "k3", "k4")
_RATIONAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


OPENCV = (
    Choice("plain", "brown_conrady", (*_RADTAN, "k3")),
    Choice("fisheye", "kannala_brandt", _FISHEYE),
    Choice("rational", "rational", _RATIONAL),
)
ROS = (
    Choice("plumb_bob", "brown_conrady", (*_RADTAN, "k3")),
    Choice("equidistant", "kannala_brandt", _FISHEYE),
    Choice("rational_polynomial", "rational", _RATIONAL),
)
KALIBR = (
    Choice("pinhole-radtan", "brown_conrady", _RADTAN),
    Choice("pinhole-equidistant", "kannala_brandt", _FISHEYE),
    Choice("ds-none", "double_sphere", ("xi", "alpha")),
    Choice("eucm-none", "eucm", ("alpha", "beta")),
)
COLMAP = (
    Choice("PINHOLE", "brown_conrady", ()),
    Choice("OPENCV", "brown_conrady", _RADTAN),
    Choice("OPENCV_FISHEYE", "kannala_brandt", _FISHEYE),
    Choice("FULL_OPENCV", "rational", _RATIONAL),
    Choice("THIN_PRISM_FISHEYE", "kannala_brandt", ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")),
)
MRCAL = (
    Choice("LENSMODEL_PINHOLE", "brown_conrady", ()),
    Choice("LENSMODEL_OPENCV4", "brown_conrady", _RADTAN),
    Choice("LENSMODEL_OPENCV5", "brown_conrady", (*_RADTAN, "k3")),
    Choice("LENSMODEL_OPENCV8", "rational", _RATIONAL),
)
AVCLI = tuple(
    Choice(name, name, TANGENTIAL.get(name, LENSES[name]).names()[4:])
    for name in ("kannala_brandt", "rational", "brown_conrady", "double_sphere", "eucm", "ucm")
)
