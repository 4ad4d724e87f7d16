"""Where sound comes from: events, generalised cross-correlation, closed-form and steered-response localization."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avcli.localization.methods import localize, localizer

__all__ = ["localize", "localizer"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from avcli.localization import methods  # on demand: settings, which --help reads, shall not import numpy

    return getattr(methods, name)
