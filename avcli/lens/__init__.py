"""Lens models, exact both ways: Kannala-Brandt (OpenCV's fisheye), Brown-Conrady, and the thesis's division model.

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

`LENSES` names every model. A new one is a class in `models` and a line in that table.
"""

from avcli.lens.models import LENSES, Angular, BrownConrady, Division, KannalaBrandt, Lens, Perspective, name_of

__all__ = ["LENSES", "Angular", "BrownConrady", "Division", "KannalaBrandt", "Lens", "Perspective", "name_of"]
