"""Features of detections, as looks and voice: their place in a record, their columns, and the kinds that are known.

A feature is a vector of a declared kind: a measurement of the person who was detected. What is known of a kind over
many people stands in KIND.json beside this file, written by the fit of the stage that measures it.
"""

import functools
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from avcli.formats.schema import Invalid, Key, MapOf, Number, Object, Text, shown

MOST_NAMES, MOST_COMPONENTS = 8, 1024  # in one detection, in one vector
LARGEST = 1e6  # of a component and of a standard deviation
CORRELATED = 0.8  # share of an error's variance that lasts, where a kind does not say it


@dataclass(frozen=True)
class Feature:
    """One feature of the n detections of a record.

    Attributes:
        kind: what the numbers mean.
        vectors: (n, d); NaN where a component was not measured.
        sds: (n, d) standard deviation of each component as a measurement of that person; NaN where it is not told.
    """

    kind: str
    vectors: np.ndarray
    sds: np.ndarray

    def take(self, rows: np.ndarray | list[int]) -> "Feature":
        """Return the feature of some of the detections, by their numbers or by a mask (n,) bool."""
        return Feature(self.kind, self.vectors[rows], self.sds[rows])


# --- in a record ------------------------------------------------------------------------------------------------------


class Measured(NamedTuple):
    """One feature of one detection, as `MEASURED` reads it: d numbers, NaN where null or not told."""

    kind: str
    vector: list[float]
    sd: list[float]


class _Vector:
    """A list of numbers, each of which may be null."""

    def __init__(self, item: Number) -> None:
        self.item = item

    def read(self, value: Any) -> list[float]:
        if not isinstance(value, list | tuple) or not 1 <= len(value) <= MOST_COMPONENTS:
            raise Invalid(f"must be {self.words()}, found {shown(value)}")
        try:
            return [np.nan if number is None else self.item.read(number) for number in value]
        except Invalid:
            raise Invalid(f"must be {self.words()}, found {shown(value)}") from None

    def schema(self) -> dict[str, Any]:
        item = self.item.schema() | {"type": ["number", "null"]}
        return {"type": "array", "items": item, "minItems": 1, "maxItems": MOST_COMPONENTS}

    def words(self) -> str:
        return f"a list of 1 to {MOST_COMPONENTS} numbers {self.item.bounds()}, each of which may be null"


class _Features(MapOf):
    """A few features by their names."""

    def read(self, value: Any) -> dict[str, Any]:
        if isinstance(value, Mapping) and len(value) > MOST_NAMES:
            raise Invalid(f"must have at most {MOST_NAMES} names, found {len(value)}")
        return {name: self._measured(name, item) for name, item in super().read(value).items()}

    @staticmethod
    def _measured(name: str, item: Mapping[str, Any]) -> Measured:
        vector, sd = item["vector"], item["sd"] or [np.nan] * len(item["vector"])
        if len(sd) != len(vector):
            raise Invalid(f'must be a list of {len(vector)}, as "vector" is, found {len(sd)}', (name, "sd"))
        return Measured(item["kind"], vector, sd)

    def schema(self) -> dict[str, Any]:
        return super().schema() | {"maxProperties": MOST_NAMES}


FEATURES = _Features(
    Object(
        {
            "kind": Key(Text(filled=True), "what the numbers mean; vectors of one kind can be compared", required=True),
            "vector": Key(
                _Vector(Number(-LARGEST, most=LARGEST)),
                "measurement of the person; null: this component was not measured",
                required=True,
            ),
            "sd": Key(
                _Vector(Number(above=0, most=LARGEST)),
                "standard deviation of each component as a measurement of that person",
            ),
        }
    )
)
"""The features of a detection: name -> object."""


def columns(rows: dict[int, dict[str, Any]], bad: Callable[[str], None]) -> dict[str, Feature]:
    """Gather the features of a record's detections, name -> feature.

    Args:
        rows: place in the record -> checked object, whose "features" may be None. An object whose feature has another
            kind or length than the first one of that name is removed.
        bad: called with the reason for each of those.
    """
    given: dict[str, Measured] = {}
    for place, row in list(rows.items()):
        for name, one in (row["features"] or {}).items():
            first = given.setdefault(name, one)
            if (one.kind, len(one.vector)) != (first.kind, len(first.vector)):
                bad(
                    f'objects[{place}]: "features.{name}" must have one kind and length in a record, found '
                    f"{shown(one.kind)} of {len(one.vector)} beside {shown(first.kind)} of {len(first.vector)}"
                )
                del rows[place]
                break
    features = {}
    for name, first in given.items():
        unknown = Measured(first.kind, *[[np.nan] * len(first.vector)] * 2)
        each = [(row["features"] or {}).get(name, unknown) for row in rows.values()]
        vectors, sds = (np.array([one[k] for one in each], float) for k in (1, 2))
        if not np.isnan(vectors).all():
            features[name] = Feature(first.kind, vectors, sds)
    return features


def as_objects(features: Mapping[str, Feature], count: int) -> list[dict[str, Any]]:
    """Return the features of each of so many detections as a record has them; empty where there is none."""
    objects: list[dict[str, Any]] = [{} for _ in range(count)]
    for name, one in features.items():
        told = ~np.isnan(one.sds)
        for k in np.flatnonzero(~np.isnan(one.vectors).all(1)).tolist():
            objects[k][name] = {"kind": one.kind, "vector": _with_null(one.vectors[k])}
            if told[k].any():
                objects[k][name]["sd"] = _with_null(one.sds[k])
    return objects


def _with_null(numbers: np.ndarray) -> list[float | None]:
    return [None if number != number else number for number in numbers.tolist()]


def joined(parts: list[Mapping[str, Feature]], counts: list[int]) -> dict[str, Feature]:
    """Return the features of several records of one sensor as those of one record.

    Args:
        parts: the features of each; of a kind or length that differs from the first of its name they are left out.
        counts: number of detections in each.
    """
    first = {name: one for part in reversed(parts) for name, one in part.items()}
    whole = {}
    for name, one in first.items():
        d = one.vectors.shape[1]
        blank = [np.full((count, d), np.nan) for count in counts]
        same = [part.get(name) for part in parts]
        same = [other if other and other.kind == one.kind and other.vectors.shape[1] == d else None for other in same]
        vectors = [other.vectors if other else empty for other, empty in zip(same, blank, strict=True)]
        sds = [other.sds if other else empty for other, empty in zip(same, blank, strict=True)]
        whole[name] = Feature(one.kind, np.concatenate(vectors), np.concatenate(sds))
    return whole


# --- what is known of a kind ------------------------------------------------------------------------------------------


class Population(NamedTuple):
    """How a kind of feature varies over people, and within one: a two-covariance model with independent components.

    Attributes:
        mean: (d,) of all people.
        between: (d,) variances of people's own means.
        within: (d,) variances of one measurement of a person, used where a detection does not tell them.
        correlation_s: s, in which the correlation of a person's errors falls to 1/e.
        correlated: share of an error's variance that is correlated so; the rest is new in each measurement.
    """

    mean: np.ndarray
    between: np.ndarray
    within: np.ndarray
    correlation_s: float
    correlated: float = CORRELATED


@functools.cache
def known(kind: str) -> Population | None:
    """Return what is known of a kind of feature, from its file beside this module; None: nothing."""
    if not re.fullmatch(r"[a-z0-9-]+", kind):
        return None
    path = Path(__file__).with_name(f"{kind}.json")
    if not path.is_file():
        return None
    fitted = json.loads(path.read_bytes())
    mean, between, within = (np.array(fitted[key], float) for key in ("mean", "between", "within"))
    return Population(mean, between, within, fitted["correlation_s"], fitted.get("correlated", CORRELATED))
