"""What was learnt of a room and its sensors, as a picture (`avfuse --map`): two maps and a table."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from avcli.tracking.learning import Habits
from avcli.tracking.model import WALK, Population

if TYPE_CHECKING:
    from avcli.tracking.coverage import Coverage
    from avcli.tracking.places import Places

WIDTH, LEFT, TOP, BOX = 1480, 90, 100, (500, 620)  # px, of the picture, to the first map, into which a map fits
LINE = 28  # px between the lines of the legend and the table
KNOWN = 0.1  # share of what was learnt in a place's own factor, below which it is hatched
SEEN = 0.5  # share of the detection probability in full view, where an outline runs
INK, GREY, WHITE = (30, 30, 30), (110, 110, 110), (255, 255, 255)
OUTLINES = ((255, 255, 255), (120, 120, 255), (255, 200, 120), (200, 120, 255))  # BGR, of what sensors cover
COLUMNS = {
    "sensor": 30,
    "false detections|in a record": 190,
    "detects whom|it can, %": 340,
    "hides a person|after, s": 470,
    "for, s": 610,
    "nobody detected:|all left, %": 690,
    "noise,|times stated": 840,
    "bias along x, along y, forward|and standard deviations, cm": 960,
    "lasting|error, cm": 1320,
}


def picture(
    state: Mapping[str, Any], population: Population, coverage: Mapping[str, Coverage], hidden: bool = True
) -> bytes:
    """Draw where people come and where they leave, and what is known of each sensor.

    Args:
        state: what was learnt, see `trackers.Learning.state`.
        population: how people come and leave before anything was learnt.
        coverage: name of a sensor or a kind of sensors -> where it detects people.
        hidden: whether people can be hidden from sensors.

    Returns:
        A PNG file; the same arguments give the same bytes.

    Raises:
        ValueError: it was learnt in a room of another size.
    """
    import cv2

    habits = Habits(population, learn=False)
    habits.restore(state)
    coming, leaving = _rates(habits)
    partly = {name: area for name, area in coverage.items() if not area.whole}
    scale = float((np.array(BOX) / (population.corners[1] - population.corners[0])).min())
    sides = np.maximum(np.round(scale * (population.corners[1] - population.corners[0])), 1).astype(int)
    false = [one for known in state["sensors"].values() for one in known.get("false_places") or []]
    legend = TOP + int(sides[1]) + 80
    table = legend + LINE * (len(partly) + 2 + bool(false)) + 30
    canvas = np.full((table + LINE * (len(state["sensors"]) + 2) + 20, WIDTH, 3), WHITE, np.uint8)
    titles = (
        ("Where people come", "people per hour and m²"),
        ("Where people leave", "per minute that somebody walks there"),
    )
    for k, (title, rates, places) in enumerate(
        zip(titles, (coming, leaving), (habits.entries, habits.exits), strict=True)
    ):
        left = LEFT + k * WIDTH // 2
        _write(canvas, title[0], (left, TOP - 46), 22, weight=700)
        _write(canvas, title[1], (left, TOP - 18), 15, GREY)
        frame = canvas[TOP : TOP + sides[1], left : left + sides[0]]
        low, high = bounds(rates)
        _paint(frame, np.log(rates / low) / math.log(high / low), places, population.corners, partly)
        for one in false:
            _cross(frame, _pixel(frame, population.corners, one["position"]))
        cv2.rectangle(canvas, (left - 1, TOP - 1), (left + int(sides[0]), TOP + int(sides[1])), INK)
        _axes(canvas, population.corners, left, sides)
        _bar(canvas, left + int(sides[0]) + 24, int(sides[1]), low, high)
    _legend(canvas, list(partly), legend, bool(false))
    _table(canvas, state["sensors"], table, hidden)
    return cv2.imencode(".png", canvas)[1].tobytes()


def _rates(habits: Habits) -> tuple[np.ndarray, np.ndarray]:
    """Return at which rates people come, (nx, ny) per hour and m², and leave, per minute that somebody walks there."""
    population, shape = habits.population, habits.entries.shape
    cells = habits.entries.centres().reshape(-1, 2)
    coming = population.density(cells, *population.birth_rate).reshape(shape) * habits.entries.factor
    walking = np.column_stack([cells, np.full(len(cells), WALK), np.zeros(len(cells))])
    return 3600 * coming.clip(1e-12), 60 * habits.leaving(walking).reshape(shape).clip(1e-12)


def bounds(values: np.ndarray) -> tuple[float, float]:
    """Return two numbers, each 1, 2 or 5 times a power of ten, around positive values and at least a decade apart."""
    low, high = float(values.min()), float(values.max())
    middle = math.sqrt(low) * math.sqrt(high)
    low, high = min(low, middle / 3.2), max(high, middle * 3.2)
    return max(one for one in ticks(low / 10, high) if one <= low), min(
        one for one in ticks(low, high * 10) if one >= high
    )


def ticks(low: float, high: float) -> list[float]:
    """Return the numbers between two positive numbers that are 1, 2 or 5 times a power of ten."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [one for k in powers for one in (10.0**k, 2 * 10.0**k, 5 * 10.0**k) if low * 0.999 < one < high * 1.001]


# --- drawing ----------------------------------------------------------------------------------------------------------


def _paint(
    frame: np.ndarray, shares: np.ndarray, places: Places, corners: np.ndarray, partly: Mapping[str, Coverage]
) -> None:
    """Paint a map, by shares (nx, ny) of the scale of its colours, with what happened there and what sensors cover."""
    import cv2

    rows, columns = frame.shape[:2]
    low, size = corners[0], corners[1] - corners[0]
    x = low[0] + size[0] * (np.arange(columns) + 0.5) / columns
    y = low[1] + size[1] * (np.arange(rows)[::-1] + 0.5) / rows
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    cells = places.cells(points)
    shade = np.round(255 * shares[cells].clip(0, 1)).astype(np.uint8).reshape(rows, columns)
    frame[:] = cv2.applyColorMap(shade, cv2.COLORMAP_VIRIDIS)
    unknown = (places.learnt()[cells] < KNOWN).reshape(rows, columns) & _hatching(rows, columns)
    frame[unknown] = frame[unknown] * 0.7 + 0.3 * 255
    for colour, area in zip(_outline_colours(len(partly)), partly.values(), strict=True):
        share = cv2.GaussianBlur(area.at(points).reshape(rows, columns), (0, 0), area.step / size[0] * columns)
        inside = (share >= SEEN).astype(np.uint8)
        cv2.drawContours(frame, cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0], -1, colour, 2)
    for (at_x, at_y), number in zip(places.centres().reshape(-1, 2), places.happened.ravel(), strict=True):
        if number > 0.5:
            _ring(frame, _pixel(frame, corners, (at_x, at_y)), number)


def _pixel(frame: np.ndarray, corners: np.ndarray, position: Sequence[float]) -> tuple[int, int]:
    """Return where a position (2,) m is in a map."""
    (x, y), (rows, columns) = (np.array(position) - corners[0]) / (corners[1] - corners[0]), frame.shape[:2]
    return round(float(x) * columns), round(rows - float(y) * rows)


def _ring(image: np.ndarray, where: tuple[int, int], number: float) -> None:
    """Draw a ring whose area says how often something happened."""
    import cv2

    radius = min(round(4 * math.sqrt(number)), 40)
    cv2.circle(image, where, radius, INK, 3, cv2.LINE_AA)
    cv2.circle(image, where, radius, WHITE, 1, cv2.LINE_AA)


def _cross(image: np.ndarray, where: tuple[int, int]) -> None:
    import cv2

    cv2.drawMarker(image, where, INK, cv2.MARKER_TILTED_CROSS, 16, 4, cv2.LINE_AA)
    cv2.drawMarker(image, where, WHITE, cv2.MARKER_TILTED_CROSS, 14, 2, cv2.LINE_AA)


def _hatching(rows: int, columns: int) -> np.ndarray:
    return np.add.outer(np.arange(rows), np.arange(columns)) % 8 == 0


def _outline_colours(count: int) -> list[tuple[int, int, int]]:
    return [OUTLINES[k % len(OUTLINES)] for k in range(count)]


def _axes(canvas: np.ndarray, corners: np.ndarray, left: int, sides: Sequence[int]) -> None:
    """Draw ticks and labels in metres on the lower and the left side of a map."""
    import cv2

    bottom = TOP + int(sides[1])
    step = next(one for one in ticks(1e-3, 1e7) if (corners[1] - corners[0]).max() / one <= 10)
    for low, high, length, along_x in zip(*corners, sides, (True, False), strict=True):
        for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1):
            at = round((k * step - low) / (high - low) * int(length))
            if along_x:
                cv2.line(canvas, (left + at, bottom), (left + at, bottom + 6), INK)
                _write(canvas, f"{k * step:g}", (left + at, bottom + 24), 14, anchor=0.5)
            else:
                cv2.line(canvas, (left - 7, bottom - at), (left - 1, bottom - at), INK)
                _write(canvas, f"{k * step:g}", (left - 12, bottom - at + 5), 14, anchor=1.0)
    _write(canvas, "x, m", (left + int(sides[0]) // 2, bottom + 46), 15, anchor=0.5)
    _write(canvas, "y, m", (left - 44, TOP - 18), 15)


def _bar(canvas: np.ndarray, left: int, height: int, low: float, high: float) -> None:
    """Draw the scale of a map's colours."""
    import cv2

    shade = np.repeat(np.linspace(255, 0, height).round().astype(np.uint8)[:, None], 18, 1)
    canvas[TOP : TOP + height, left : left + 18] = cv2.applyColorMap(shade, cv2.COLORMAP_VIRIDIS)
    cv2.rectangle(canvas, (left - 1, TOP - 1), (left + 18, TOP + height), INK)
    marks = ticks(low, high)
    for one in marks if len(marks) < 12 else [low, *(one for one in marks if f"{one:.0e}"[0] == "1"), high]:
        at = TOP + height - round(math.log(one / low) / math.log(high / low) * height)
        cv2.line(canvas, (left + 18, at), (left + 23, at), INK)
        _write(canvas, f"{one:g}", (left + 28, at + 5), 14)


def _legend(canvas: np.ndarray, partly: Sequence[str], top: int, false: bool) -> None:
    """Say what rings, outlines and, if there are any, crosses mean."""
    import cv2

    _ring(canvas, (LEFT + 12, top - 5), 1.0)
    _ring(canvas, (LEFT + 34, top - 5), 4.0)
    _write(canvas, "one person, four people who came, or left, by the tracks", (LEFT + 56, top), 15)
    box = canvas[top + LINE - 14 : top + LINE + 2, LEFT : LEFT + 42]
    box[:] = cv2.applyColorMap(np.full(box.shape[:2], 80, np.uint8), cv2.COLORMAP_VIRIDIS)
    box[_hatching(*box.shape[:2])] = WHITE
    text = "little was learnt here: the prior rate, times one factor for the whole room"
    _write(canvas, text, (LEFT + 56, top + LINE), 15)
    for k, (name, colour) in enumerate(zip(partly, _outline_colours(len(partly)), strict=True), start=2):
        at = top + k * LINE
        cv2.line(canvas, (LEFT, at - 5), (LEFT + 42, at - 5), INK, 5, cv2.LINE_AA)
        cv2.line(canvas, (LEFT + 1, at - 5), (LEFT + 41, at - 5), colour, 2, cv2.LINE_AA)
        _write(canvas, f"what is seen by {name}", (LEFT + 56, at), 15)
    if false:
        at = top + (len(partly) + 2) * LINE
        _cross(canvas, (LEFT + 20, at - 5))
        _write(canvas, "a sensor detects somebody here falsely, again and again", (LEFT + 56, at), 15)


def _table(canvas: np.ndarray, sensors: Mapping[str, Mapping[str, Any]], top: int, hidden: bool) -> None:
    """Write what is known of each sensor."""
    import cv2

    for head, left in COLUMNS.items():
        for k, part in enumerate(head.split("|")):
            _write(canvas, part, (left, top + 18 * k - 6), 14, GREY)
    cv2.line(canvas, (30, top + 20), (WIDTH - 30, top + 20), INK)
    for row, (name, known) in enumerate(sensors.items()):
        for text, left in zip(_cells(name, known, hidden), COLUMNS.values(), strict=True):
            _write(canvas, text, (left, top + 20 + LINE * (row + 1) - 4), 15)


def _cells(name: str, known: Mapping[str, Any], hidden: bool) -> Iterator[str]:
    """Yield what the columns of the table say of one sensor."""
    hiding, blindness, errors = known["hiding"], known["blindness"], known["errors"]
    yield name if len(name) <= 18 else name[:17] + "…"
    yield f"{known['clutter_sum'] / known['clutter_count']:.2g}"
    yield f"{100 * known['hit_sum'] / known['hit_count']:.0f}"
    if hidden:
        yield f"{hiding['in_sight'] / hiding['events']:.3g}"
        yield f"{hiding['hidden'] / hiding['events']:.2g}"
        yield f"{100 * blindness['emptied'] / (blindness['emptied'] + blindness['returned']):.0f}"
    else:
        yield from ("never", "", "")
    yield f"{math.sqrt(errors['noise_factor']):.2g}"
    yield "   ".join(
        f"{round(100 * one, 1) + 0.0:+.1f} ± {100 * sd:.1f}"
        for one, sd in zip(errors["bias"], errors["bias_sd"], strict=True)
    )
    yield f"{100 * errors['lasting_sd']:.1f}"


@cache
def _font() -> Any:
    import cv2

    return cv2.FontFace("sans")


def _write(
    canvas: np.ndarray,
    text: str,
    at: tuple[int, int],
    size: int,
    colour: tuple[int, int, int] = INK,
    weight: int = 400,
    anchor: float = 0.0,
) -> None:
    """Write a text whose baseline begins at a pixel, or is moved to the left by a share of its length."""
    import cv2

    long = cv2.getTextSize((0, 0), text, (0, 0), _font(), size, weight)[2] if anchor else 0
    cv2.putText(canvas, text, (at[0] - round(anchor * long), at[1]), colour, _font(), size, weight)
