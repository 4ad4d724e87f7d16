"""The file in which avfuse keeps what it has learnt of a room and its sensors (`--learn`)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import orjson

from avcli.formats import atomic, bounds
from avcli.formats.descriptions import ERRORS, FALSE_PLACE, Format, always
from avcli.formats.schema import Invalid, Key, ListOf, MapOf, Number, Numbers, OrNull
from avcli.tracking.rates import AGAIN, PRIOR_AGAIN

_MOST = 1e12
_AMOUNT, _DIVISOR, _SIGNED = Number(0, most=_MOST), Number(1e-6, most=_MOST), Number(-_MOST, most=_MOST)
_LOG_ODDS = Number(-10, most=10)


_MAP = always(
    happened=(ListOf(ListOf(_SIGNED)), "how often it happened in each cell of a grid over the room, along x, then y"),
    expected=(ListOf(ListOf(_AMOUNT)), "how often it was expected there before anything was learnt"),
)
_SENSOR = always(
    typical=(OrNull(_LOG_ODDS), "log odds of the scores of people"),
    clutter_sum=(_AMOUNT, "false detections"),
    clutter_count=(_DIVISOR, "records in which they were counted"),
    hit_sum=(_AMOUNT, "people who were detected"),
    hit_count=(_DIVISOR, "people who could be detected"),
    hiding=(
        always(
            events=(_DIVISOR, "how often a person was hidden and came back"),
            in_sight=(_DIVISOR, "time that people could be detected, s"),
            hidden=(_DIVISOR, "time that they could not, s"),
        ),
        "how the sensor loses people",
    ),
    blindness=(
        always(
            returned=(_DIVISOR, "how often the sensor lost everybody and found somebody again"),
            emptied=(_AMOUNT, "how often it found nobody again"),
        ),
        "how it loses everybody",
    ),
    errors=(ERRORS, "how exact it is"),
)
_SENSOR.keys = {
    **_SENSOR.keys,
    "again_sum": Key(_AMOUNT, "further detections of people in one record", default=PRIOR_AGAIN * AGAIN),
    "again_count": Key(_DIVISOR, "people in whose records they were counted", default=PRIOR_AGAIN),
    "false_places": Key(ListOf(FALSE_PLACE), "places where it detects somebody falsely, again and again", default=[]),
}
LEARNT = Format(
    "learnt",
    "What the tracker has learnt of a room and its sensors (avfuse --learn)",
    always(
        area=(Numbers(4, bounds.COORDINATE), "the room: least x, least y, largest x, largest y, m"),
        entries=(_MAP, "people who came"),
        exits=(_MAP, "people who left"),
        sensors=(MapOf(_SENSOR), "what was learnt of each sensor, by its name; all sums contain the prior"),
    ),
)


def read_learnt(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read what an earlier run has learnt.

    Raises:
        ValueError: the file does not hold that.
        OSError: it cannot be read.
    """
    with open(path, "rb") as stream:
        text = stream.read(bounds.LARGEST_JSON_FILE + 1)
    try:
        return LEARNT.content.read(orjson.loads(text))
    except (orjson.JSONDecodeError, Invalid) as error:
        raise ValueError(f"not what avfuse --learn writes: {error}") from None


def write_learnt(path: str | os.PathLike[str], state: Mapping[str, Any]) -> None:
    """Write what a tracker has learnt, whole or not at all."""
    atomic.write_bytes(path, orjson.dumps(state, option=orjson.OPT_APPEND_NEWLINE))
