"""Every lens model by its name."""

from typing import Any

from avcli.lens.models import BrownConrady, Division, KannalaBrandt, Lens
from avcli.lens.spheres import DoubleSphere, ExtendedUnified, Unified
from avcli.lens.tangential import Rational, TangentialBrownConrady, TangentialKannalaBrandt

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
