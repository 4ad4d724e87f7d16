"""Lens models, exact both ways, each with its own parameters.

A lens maps points in the camera frame (x right, y down, z forward) to pixels, (0, 0) being the centre of the top-left
one. Angles from the optical axis are atan2(hypot(x, y), z), so that rays at and beyond 90 degrees are legal, and what
a lens does not image is NaN.

    >>> from avcli.lens import KannalaBrandt
    >>> lens = KannalaBrandt(862.27, 862.70, 1049.47, 552.76, -0.0269, -0.0038, 0.0016, -0.0006)
    >>> lens.project([[1.0, 0.0, 2.0]]).round(2)
    array([[1446.88,  552.76]])
    >>> lens.unproject([[1446.88, 552.76]]).round(4)
    array([[0.4472, 0.    , 0.8944]])
    >>> lens.project([[0.0, 0.0, -1.0]])  # behind the camera: not imaged
    array([[nan, nan]])

`LENSES` has every model by its name, which is `lens_model` in config.json. A new one is a class and a line in that
table. Every model has fx, fy, cx, cy (px; keys fx_px, fy_px, cx_px, cy_px) and its own coefficients. With theta the
angle from the axis, s = hypot(x, y) / z the slope, and e = (x, y) / hypot(x, y), the pixel is (cx, cy) + (fx, fy) w:

    kannala_brandt  w = e theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    brown_conrady   w = e s (1 + k1 s^2 + k2 s^4 + k3 s^6 + k4 s^8)
    rational        w = e s (1 + k1 s^2 + k2 s^4 + k3 s^6) / (1 + k4 s^2 + k5 s^4 + k6 s^6) + T(s e)
    division        the virtual lens of the thesis: see `Division`
    ucm             w = e sin(theta) / (alpha + (1 - alpha) cos(theta))
    eucm            w = e sin(theta) / (alpha d + (1 - alpha) cos(theta)), d^2 = beta sin(theta)^2 + cos(theta)^2
    double_sphere   w = e sin(theta) / (alpha d + (1 - alpha) k), k = xi + cos(theta), d^2 = sin(theta)^2 + k^2

The last three are as Usenko, Demmel and Cremers (2018, The double sphere camera model) write them, and as Kalibr has
them. The omni model of Mei and Rives (2007) is ucm with alpha = xi / (1 + xi) and fx = gamma / (1 + xi).

kannala_brandt and brown_conrady may have tangential terms p1, p2 as well (absent: 0), which move w by T of the
undistorted point q = theta e, or q = s e:

    T(q) = (2 p1 qx qy + p2 (|q|^2 + 2 qx^2), p1 (|q|^2 + 2 qy^2) + 2 p2 qx qy)

and kannala_brandt a thin prism sx1, sy1, which adds |q|^2 (sx1, sy1). This is OpenCV's definition for perspective
lenses, and COLMAP's THIN_PRISM_FISHEYE for fisheyes. `lens_config` turns a lens into the keys of camera_config,
`Lens.names`, `keys` and `of_image` say and take the parameters in order. OpenCV's vector for `rational` has the order
k1 k2 p1 p2 k3 k4 k5 k6; ours is k1 ... k6 p1 p2.
"""

from typing import Any

from avcli.lens.models import Angular, BrownConrady, Division, FourTerms, KannalaBrandt, Lens, Perspective
from avcli.lens.spheres import DoubleSphere, ExtendedUnified, Unified
from avcli.lens.tangential import Rational, Tangential, TangentialBrownConrady, TangentialKannalaBrandt

__all__ = [
    "LENSES",
    "OFF_CENTRE",
    "TANGENTIAL",
    "Angular",
    "BrownConrady",
    "Division",
    "DoubleSphere",
    "ExtendedUnified",
    "FourTerms",
    "KannalaBrandt",
    "Lens",
    "Perspective",
    "Rational",
    "Tangential",
    "TangentialBrownConrady",
    "TangentialKannalaBrandt",
    "Unified",
    "lens_config",
    "name_of",
    "variants",
]


LENSES: dict[str, type[Lens]] = {
    "kannala_brandt": KannalaBrandt,
    "brown_conrady": BrownConrady,
    "division": Division,
    "rational": Rational,
    "double_sphere": DoubleSphere,
    "eucm": ExtendedUnified,
    "ucm": Unified,
}
"""Every lens model by the name that `lens_model` gives it in config.json."""

TANGENTIAL: dict[str, type[Lens]] = {
    "kannala_brandt": TangentialKannalaBrandt,
    "brown_conrady": TangentialBrownConrady,
}
"""The models of `LENSES` that one of `OFF_CENTRE` in config.json turns into others."""

OFF_CENTRE = ("p1", "p2", "sx1", "sy1")
"""The coefficients of lenses that are not centred on one axis; 0 where they are absent."""


def variants() -> dict[str, type[Lens]]:
    """Every lens that can be fitted: the models of `LENSES`, and NAME+tangential of those in `TANGENTIAL`."""
    return {**LENSES, **{f"{name}+tangential": model for name, model in TANGENTIAL.items()}}


def name_of(lens: Lens) -> str:
    """The name of a lens's model in `LENSES`."""
    return next(name for name in LENSES if type(lens) in (LENSES[name], TANGENTIAL.get(name)))


def lens_config(lens: Lens) -> dict[str, Any]:
    """The lens as keys of a camera_config: lens_model, and its parameters by their keys."""
    return {"lens_model": name_of(lens), **dict(zip(lens.keys(), map(float, lens.parameters), strict=True))}
