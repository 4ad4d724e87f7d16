"""Scoring of records: from ground truth and tracks or detections to metrics records, alone and combined."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avcli.formats.records import Detections, Identified, printable
from avcli.formats.sensors import MICROPHONES, sensor_kind
from avcli.metrics import registry
from avcli.metrics.detections import SensorCase
from avcli.metrics.matching import speakers
from avcli.metrics.metric import Case
from avcli.metrics.registry import summary_fields
from avcli.metrics.run import Detected, Run, Tracked
from avcli.metrics.sequence import Mismatch, align
from avcli.metrics.settings import Settings


def score(
    truth: Sequence[Identified],
    tracks: Sequence[Identified],
    *,
    d0: float = Settings.d0,
    dims: int = Settings.dims,
    tolerance: float = Settings.tolerance,
    speaking: bool = Settings.speaking,
    cutoff: float | None = Settings.cutoff,
    order: float = Settings.order,
    window: int = Settings.window,
) -> dict[str, float | None]:
    """Score tracks against ground truth.

    >>> import numpy as np
    >>> from avcli.formats.records import Identified
    >>> from avcli.metrics import score
    >>> times = np.arange(41) / 10
    >>> truth = [Identified(t, np.array([0]), np.array([[t, 1.0, 0.0]])) for t in times]
    >>> tracks = [Identified(t, np.array([7]), np.array([[t, 1.3, 0.0]])) for t in times]  # 0.3 m beside the person
    >>> scores = score(truth, tracks)
    >>> print(f"HOTA {scores['HOTA']:.3f}, MOTA {scores['MOTA']:.3f}, RMSE {scores['RMSE']:.3f} m")
    HOTA 0.895, MOTA 1.000, RMSE 0.300 m

    Args:
        truth: people, one record for each time.
        tracks: tracks, one record for each time; what has no partner in time counts as missed or false.
        d0: m, distance at which the similarity 1 - d / d0 reaches zero; CLEAR and Identity match within half of it.
        dims: 2 to compare x and y, 3 for the height too.
        tolerance: s, largest difference in time of records that match.
        speaking: score people only while they speak.
        cutoff: m, cost of a missed or false point in the OSPA family; by default d0 / 2.
        order: of the OSPA family.
        window: frames, of OSPA2.

    Returns:
        The summary: TrackEval's names where it has one, fractions from 0 to 1, distances in m, delays in s; None where
        a score has no meaning. `score_tracks` gives the full record.

    Raises:
        ValueError: a setting is out of its range; an identity occurs twice at a time; dims is 3 and a height is
            missing; or speaking is true and the ground truth does not give it for everybody.
    """
    settings = Settings(
        dims=dims, d0=d0, tolerance=tolerance, speaking=speaking, cutoff=cutoff, order=order, window=window
    )
    return score_tracks(truth, tracks, settings)[0].record["summary"]


def score_tracks(
    truth: Sequence[Identified],
    tracks: Sequence[Identified],
    settings: Settings | None = None,
    sequence: str = "",
    tracker: str = "",
    *,
    keep_first: bool = False,
) -> tuple[Tracked, Mismatch]:
    """Score one tracker on one sequence.

    Args:
        truth, tracks: one record for each time.
        settings: how they are compared.
        sequence, tracker: their names, for the record.
        keep_first: drop the points of an identity that occurs twice at a time, all but the first.

    Returns:
        The scored sequence with its metrics record, and what did not match in time.

    Raises:
        ValueError: as `score`.
    """
    settings = settings or Settings()
    frames, mismatch = align(truth, tracks, settings.dims, settings.tolerance, keep_first)
    case = Case(speakers(frames, settings.d0) if settings.speaking else frames, settings)
    record = {"sequence": sequence, "tracker": tracker, **_people(settings), **registry.score_case(case)}
    return Tracked(case, record), mismatch


def score_sensor(
    truth: Sequence[Identified],
    found: Sequence[Detections],
    settings: Settings | None = None,
    sequence: str = "",
    sensor: str = "",
    *,
    sensors: Mapping[str, str] | None = None,
    keep_first: bool = False,
) -> tuple[Detected, Mismatch]:
    """Score one sensor on one sequence.

    Args:
        truth: people, one record for each time.
        found: the sensor's detections, at least one record; those without a position are left out. Microphones hear
            mouths: their detections are compared with mouths where the ground truth gives all of them, and otherwise,
            as a camera's, with bodies.
        settings: how they are compared.
        sequence, sensor: their names, for the record.
        sensors: name -> kind, as config.json gives it.
        keep_first: drop the points of an identity that occurs twice at a time in the ground truth, all but the first.

    Returns:
        The scored sequence with its metrics record, and what did not match in time.

    Raises:
        ValueError: as `score`.
    """
    settings, found = settings or Settings(), [each.located() for each in found]
    total = np.cumsum([0, *map(len, found)])
    numbered = [
        Identified(each.timestamp, np.arange(first, first + len(each)), each.positions)
        for each, first in zip(found, total.tolist(), strict=False)
    ]
    stated = next((each.kind for each in found if each.kind), None)
    kind, guessed = sensor_kind(found[0].sensor or sensor, stated, sensors)
    known = all(np.isfinite(each.mouths).all() for each in truth)
    mouths = known and kind == MICROPHONES
    reference = [replace(each, positions=each.mouths) for each in truth] if mouths else truth
    frames, mismatch = align(reference, numbered, settings.dims, settings.tolerance, keep_first)
    if settings.speaking:
        frames = speakers(frames, settings.d0)
    number = frames.track.label[frames.track.identity]
    covariance = np.concatenate([each.covariances for each in found])[number, : settings.dims, : settings.dims]
    case = SensorCase(frames, covariance, "mouth" if mouths else "body", settings.d0 / 2)
    scores = registry.SENSOR_METRIC.score(case)
    record = {"sequence": sequence, "sensor": sensor, **_people(settings), "Detections": scores}
    return Detected(case, record, kind, guessed and known), mismatch


def score_sensors(
    truth: Sequence[Identified],
    files: Iterable[tuple[str, Iterable[Detections]]],
    settings: Settings | None = None,
    sequence: str = "",
    *,
    sensors: Mapping[str, str] | None = None,
    keep_first: bool = False,
) -> Iterator[tuple[str, str, Detected, Mismatch]]:
    """Score every sensor in some files of detections.

    Args:
        truth: people, one record for each time.
        files: path and detections of each file. A sensor without a name is called by its file's; if two files have
            detections of one sensor, the second is called "SENSOR of FILE".
        settings, sequence, sensors, keep_first: as for `score_sensor`.

    Yields:
        Path and name of the sensor, its scored detections, and what did not match in time.

    Raises:
        ValueError: as `score`; the message names the file and the sensor.
    """
    names: set[str] = set()
    for path, found in files:
        by_sensor: dict[str, list[Detections]] = {}
        for each in found:
            name = each.sensor or printable(Path(path).stem.removesuffix("_localizations"))
            by_sensor.setdefault(name, []).append(each)
        for sensor, own in by_sensor.items():
            name = f"{sensor} of {Path(path).name}" if sensor in names else sensor
            names.add(name)
            try:
                detected, mismatch = score_sensor(
                    truth, own, settings, sequence, name, sensors=sensors, keep_first=keep_first
                )
            except ValueError as error:
                raise ValueError(f"{path}: {sensor}: {error}") from None
            yield path, name, detected, mismatch


def combined(runs: Sequence[Run], say: Callable[[str], None] = lambda text: None) -> Iterator[dict]:
    """Combine sequences: for each tracker and sensor one record over all, of several sequences also the plain mean.

    Args:
        runs: the scored sequences.
        say: is called with a sentence where a score leaves out a sequence.
    """
    for tracker in dict.fromkeys(name for run in runs for name in run.trackers):
        own = [(run.name, run.trackers[tracker]) for run in runs if tracker in run.trackers]
        names, records = [name for name, _ in own], [tracked.record for _, tracked in own]
        blank = [name for name, record in zip(names, records, strict=True) if not record["HOTA"]["HOTA_TP"].any()]
        if blank and len(own) > 1:
            say(f"combined {tracker}: AssA and LocA leave out {', '.join(blank)}, where nothing matches")
        of = {"tracker": tracker, **_people(own[0][1].case.settings), "sequences": names}
        together = registry.combine(records, [tracked.case for _, tracked in own])
        yield {"sequence": "combined", "average": "micro", **of, **together}
        if len(own) > 1:
            yield {"sequence": "mean", "average": "macro", **of, "summary": registry.mean(records)}
    settings = next((tracked.case.settings for run in runs for tracked in run.trackers.values()), Settings())
    for sensor in dict.fromkeys(name for run in runs for name, found in run.sensors.items() if found.scored):
        found = [(run.name, run.sensors[sensor]) for run in runs if sensor in run.sensors]
        found = [(name, each) for name, each in found if each.scored]
        scores = [each.record["Detections"] for _, each in found]
        together = registry.SENSOR_METRIC.combine(scores, [each.case for _, each in found])
        of = {"sensor": sensor, **_people(settings), "sequences": [name for name, _ in found]}
        yield {"sequence": "combined", "average": "micro", **of, "Detections": together}


def _people(settings: Settings) -> dict[str, str]:
    return {"people": "speaking"} if settings.speaking else {}


@dataclass(frozen=True)
class Gate:
    """The least value of a fraction of the summary.

    Attributes:
        tracker: its name; None for every tracker.
        name: of the summary's field.
        percent: least value.
    """

    tracker: str | None
    name: str
    percent: float


def parse_gate(text: str) -> Gate:
    """Read a gate from "[TRACKER:]NAME=PERCENT".

    Raises:
        ValueError: the text has another form, or NAME is not a fraction of the summary.
    """
    names = [field.name for field in summary_fields() if field.unit == "%"]
    found = re.fullmatch(r"(?:(.+):)?(\w+)=(-?\d+(?:\.\d+)?)%?", text)
    if not found or found[2] not in names:
        raise ValueError(f"{text} must be [TRACKER:]NAME=PERCENT, where NAME is one of {', '.join(names)}")
    return Gate(found[1], found[2], float(found[3]))


def missed_gates(gates: Sequence[Gate], records: Sequence[dict]) -> list[str]:
    """Return a phrase for each gate and tracker whose combined score is too low, or that has no tracks."""
    combined = [record for record in records if record["sequence"] == "combined" and "tracker" in record]
    missed = []
    for gate in gates:
        concerned = [record for record in combined if gate.tracker in (None, record["tracker"])]
        if not concerned:
            missed.append(f"there are no tracks of {gate.tracker}")
        for record in concerned:
            percent = 100 * record["summary"][gate.name]
            if percent < gate.percent:
                missed.append(f"{record['tracker']}: {gate.name} is {percent:.2f}, below {gate.percent:g}")
    return missed
