"""Draws the people that were found into a picture."""

import numpy as np

from avcli.detection.body import MID_BODY_M, Person
from avcli.detection.view import View

COLOUR = {"depth": (40, 220, 60), "monocular": (255, 190, 0)}
UNEXPLAINED = (255, 60, 60)


def draw(picture: np.ndarray, people: list[Person], view: View) -> np.ndarray:
    """Draw boxes, body axes from the floor up, two-sigma ellipses on the floor, and positions as text.

    A box is turned as the person stands where that is known, and red if no body explains it.

    Args:
        picture: (height, width, 3) uint8 RGB; it is not changed.
        people: the people found in it.
        view: the camera.
    """
    import cv2

    out = picture.copy()
    scale = max(view.size[0] / 1920, 0.4)
    thick = max(round(2 * scale), 1)
    angles = np.linspace(0, 2 * np.pi, 33)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for person in people:
        colour = COLOUR[person.method] if person.explained else UNEXPLAINED
        x0, y0, x1, y1 = np.rint(person.bbox_px).astype(int).tolist()
        if person.turned_px is None:
            cv2.rectangle(out, (x0, y0), (x1, y1), colour, thick)
        else:
            x, y, width, height, turn = person.turned_px.tolist()
            cv2.polylines(
                out, [np.rint(cv2.boxPoints(((x, y), (width, height), turn))).astype(int)], True, colour, thick
            )
        values, vectors = np.linalg.eigh(person.covariance[:2, :2])
        ellipse = circle * (2 * np.sqrt(values)) @ vectors.T + person.position[:2]
        _polyline(out, view.project(np.column_stack([ellipse, np.zeros(len(ellipse))])), (255, 80, 40), thick)
        heights = np.linspace(0.0, person.height or MID_BODY_M, 9)
        axis = np.column_stack([np.tile(person.position[:2], (9, 1)), heights])
        _polyline(out, view.project(axis), (255, 255, 255), thick)
        _label(out, _words(person), (x0, y0), colour, scale)
    return out


def _words(person: Person) -> list[str]:
    x, y = person.position[:2].tolist()
    tall = f"{person.height:.2f} m tall, " if person.height else ""
    return [f"x {x:.2f}, y {y:.2f} m", f"{tall}score {person.score:.2f}"]


def _label(out: np.ndarray, lines: list[str], at: tuple[int, int], colour: tuple, scale: float) -> None:
    """Write lines on a dark ground above a point, or as near to it as the picture has room."""
    import cv2

    font, size, thick = cv2.FONT_HERSHEY_SIMPLEX, 0.8 * scale, max(round(2 * scale), 1)
    wide = max(cv2.getTextSize(line, font, size, thick)[0][0] for line in lines)
    step = round(30 * scale)
    pad = round(6 * scale)
    x = min(max(at[0], pad), max(out.shape[1] - wide - pad, pad))
    y = min(max(at[1] - step * len(lines) - pad, 0), out.shape[0] - step * len(lines) - pad)
    cv2.rectangle(out, (x - pad, y), (x + wide + pad, y + step * len(lines) + pad), (20, 22, 26), -1)
    for number, line in enumerate(lines, 1):
        cv2.putText(out, line, (x, y + step * number - pad // 2), font, size, colour, thick, cv2.LINE_AA)


def _polyline(out: np.ndarray, pixels: np.ndarray, colour: tuple, thick: int) -> None:
    import cv2

    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    if len(pixels) > 1:
        cv2.polylines(out, [np.rint(pixels).astype(np.int32)], False, colour, thick, cv2.LINE_AA)
