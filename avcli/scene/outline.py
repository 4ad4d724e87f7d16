"""The furniture of a scenario as a plan: what each piece covers of the floor."""

from typing import Any

import numpy as np

from avcli.scene import furniture
from avcli.scene.scenario import Scenario


def plan(scenario: Scenario) -> list[dict[str, Any]]:
    """Draw the furniture of a scenario from above; meshes are left out.

    Returns:
        For each piece its "name" (its kind) and its "outline", the corners [x, y] in m of its convex hull.
    """
    import cv2

    drawn = []
    for raw in scenario.raw["furniture"]:
        piece = furniture.PIECE.read(raw)
        if piece["kind"] == "mesh":
            continue
        solids = furniture.build(piece, None)
        sides = solids.half[:, :, None] * solids.axes
        corners = np.einsum("kc,ncj->nkj", furniture.CORNERS, sides) + solids.centre[:, None]
        hull = cv2.convexHull(corners[..., :2].reshape(-1, 1, 2).astype(np.float32))[:, 0]
        drawn.append({"name": piece["kind"].replace("_", " "), "outline": hull.round(3).astype(float).tolist()})
    return drawn
