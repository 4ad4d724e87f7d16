"""Microphones measured by sound: a voice that moves tells where they are, and when each channel hears."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from avcli.calibration import bundle
from avcli.calibration.echoes import Echoes, surfaces
from avcli.formats import media
from avcli.formats.records import Identified

SMOOTH_S = 0.4
"""Width of the Gaussian over which a track is smoothed, s."""
MOUTH_AHEAD_M = 0.1
"""How far a walker's mouth is ahead of the body's axis."""
TRACK_LASTS_S = 2.0
"""How long an error of a track lasts, s."""
PLACE_SD_M = 0.01
"""Standard deviation of a place that was measured, m."""
STATED_M, GUESSED_M = (0.005, 0.005, 0.005), (0.05, 0.05, 0.1)
"""Standard deviation of what all places of a voice have in common as an error, along x, y, z, m: where the mouth is
stated, and where it is guessed from the body's track."""
WIDEST_CLOCK_S, CLOCK_SD_S = 1.0, 0.05
"""How far the clocks of a track and of the sound may be apart, and how well the first look tells that, s."""
SYNCHRONOUS = 3.0
"""How many standard deviations of its delay or drift a channel must be off before it is not taken for synchronous."""
TIGHT_S, TIGHT_DRIFT = 1e-5, 1e-7
"""How well synchronous channels agree: delay in s, drift in s/s."""
ENOUGH = 0.5
"""The share of the ways to deform an array that a recording must tell."""
FARTHEST, ODD_S = 5.0, 6e-4
"""How many standard deviations a microphone may be from its place, and how late a channel may be of which the survey
said nothing, s; beyond that the recording is not understood."""
SURFACES = ("the wall x = 0", "that of large x", "the wall y = 0", "that of large y", "the floor", "the ceiling")
"""What the surfaces of a room are called, in the order of `echoes.surfaces`."""
ELSEWHERE_M = 0.03
"""How far a surface must be from where it was given to be worth a word, m."""
_SURE = 16.3
"""Chi-square with three degrees of freedom that chance exceeds once in a thousand."""
_ELSEWHERE = 3.0
"""How many times larger the spread of held-out delays is with the found positions where the voice was elsewhere."""
_UNTOLD = 0.95
"""Share of what was known before above which the sound has told nothing."""


class Heard(Protocol):
    """What was heard: times (n,) s, rough places (n, 3) m, candidates for the pairs' delays (n, p, k) s."""

    @property
    def times(self) -> np.ndarray: ...
    @property
    def places(self) -> np.ndarray: ...
    @property
    def delays(self) -> np.ndarray: ...
    @property
    def first(self) -> np.ndarray: ...
    @property
    def second(self) -> np.ndarray: ...
    @property
    def echoes(self) -> Echoes | None: ...


Again = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], Heard]
"""Listens again, given times (k,) s, the path (k, 3) m, the pairs' delays (k, p) s there, and when each channel hears
the direct sound (k, m) s and the echo of each surface (k, m, s) s."""


@dataclass(frozen=True)
class Prior:
    """What is known of an array before.

    Attributes:
        positions: (m, 3) m.
        sd_m: of each coordinate.
        speed_of_sound, speed_sd: m/s.
        late: (m,) bool, the channels that are late by more than the others, as the survey found.
        adrift: (m,) bool, those of them whose delay grows.
        room: (3,) m, its size.
    """

    positions: np.ndarray
    sd_m: float
    speed_of_sound: float
    speed_sd: float
    late: np.ndarray
    adrift: np.ndarray
    room: np.ndarray


@dataclass(frozen=True)
class Measured:
    """Microphones, as the sound shows them.

    Attributes:
        fit: positions, delays and their covariance.
        prior: what was known before.
        told: the share of the ways to deform the array that the recording tells.
        held_out_given_s, held_out_s: robust spread of the delays in seconds that took no part, with the given and with
            the found positions.
        windows: how many stretches of sound were heard.
        placed: whether the places of the voice were known.
    """

    fit: bundle.Fit
    prior: Prior
    told: float
    held_out_given_s: float
    held_out_s: float
    windows: int
    placed: bool

    @property
    def shifts(self) -> np.ndarray:
        """(m, 3) m, found minus given positions."""
        return self.fit.positions - self.prior.positions

    @property
    def covariances(self) -> np.ndarray:
        """(m, 3, 3) m², of the positions."""
        count = len(self.fit.positions)
        whole = self.fit.covariance[: 3 * count, : 3 * count].reshape(count, 3, count, 3)
        return whole[np.arange(count), :, np.arange(count), :]

    @property
    def untold(self) -> np.ndarray:
        """Which microphones (m,) the sound says nothing about: they are known no better than before."""
        return np.sqrt(np.linalg.eigvalsh(self.covariances)[:, 0]) > _UNTOLD * self.prior.sd_m

    @property
    def ways(self) -> int:
        """In how many ways the array can be deformed: 3 m less the rigid motions."""
        return self.fit.positions.size - 6

    @property
    def echoing(self) -> np.ndarray:
        """Which of the room's surfaces (6,) are heard by at least half of the channels."""
        return (self.fit.clear > 0.0).mean(axis=0) >= 0.5

    @property
    def hearing(self) -> np.ndarray:
        """Which channels (m,) hear most of these surfaces."""
        count = int(self.echoing.sum())
        return (self.fit.clear[:, self.echoing] > 0.0).sum(axis=1) > 0.5 * max(count, 1)

    @property
    def refusal(self) -> str | None:
        """Why the recording cannot tell where the microphones are; None where it can."""
        if self.placed and self.held_out_s > _ELSEWHERE * self.held_out_given_s:
            return (
                "the sound does not come from where the voice is said to be; are these places in metres, in the room of"
                " config.json, and of this recording?"
            )
        if self.told < ENOUGH:
            stoop = "" if self.placed else " and stoop now and then"
            return (
                f"this recording cannot tell where the microphones are: of the ways in which the array can be deformed "
                f"it tells {100 * self.told:.0f} %; walk through the whole room{stoop} while you talk, or clap in ten "
                "places"
            )
        far = np.linalg.norm(self.shifts, axis=1) > FARTHEST * self.prior.sd_m
        odd = far | (~self.prior.late & (np.abs(self.fit.delays) > ODD_S))
        if odd.any():
            return (
                f"the sound of microphone {int(np.argmax(odd)) + 1} fits no place near the one in config.json; is its "
                "channel exchanged with another?"
            )
        if self.held_out_s > 1.02 * self.held_out_given_s:
            return "the found positions explain sound that took no part in the fit worse than the given ones do"
        return None

    def record(self) -> dict[str, Any]:
        """What was found, as avcalib writes it."""
        fit = self.fit
        return {
            "speed_of_sound_m_s": fit.speed_of_sound,
            "clock_offset_s": fit.clock,
            "delay_residual_s": fit.residual_s,
            "held_out_given_s": self.held_out_given_s,
            "held_out_found_s": self.held_out_s,
            "told": self.told,
            "array_sd_m": fit.place_sd.tolist(),
            "surfaces": [
                {"surface": name, "position_m": float(at), "echo_heard": bool(heard)}
                for name, at, heard in zip(SURFACES, fit.surfaces, self.echoing, strict=True)
            ],
            "microphones": [
                {
                    "position": position.tolist(),
                    "shift_m": shift.tolist(),
                    "sd_m": np.sqrt(np.diag(covariance)).tolist(),
                    "shape_sd_m": float(shape),
                    "delay_s": float(delay),
                    "delay_sd_s": float(delay_sd),
                    "drift_ppm": 1e6 * float(drift),
                    "drift_sd_ppm": 1e6 * float(drift_sd),
                }
                for position, shift, covariance, shape, delay, delay_sd, drift, drift_sd in zip(
                    fit.positions,
                    self.shifts,
                    self.covariances,
                    fit.shape_sd,
                    fit.delays,
                    fit.delay_sd,
                    fit.drifts,
                    fit.drift_sd,
                    strict=True,
                )
            ],
        }

    def words(self) -> list[str]:
        """Describe it in sentences without a full stop."""
        fit, lines = self.fit, list[str]()
        for number, (shift, covariance) in enumerate(zip(self.shifts, self.covariances, strict=True), 1):
            size, sd = float(np.linalg.norm(shift)), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
            if self.untold[number - 1]:
                lines.append(f"microphone {number}: the sound does not tell where it is; its position stays as it was")
                continue
            elsewhere = float(shift @ np.linalg.solve(covariance, shift)) > _SURE and size > 0.01
            say = "is not where it was measured" if elsewhere else "agrees with its measured position"
            lines.append(f"microphone {number} {say}: shift {1000 * size:.0f} mm ± {1000 * sd:.0f} mm")
        speed_sd = float(np.sqrt(fit.covariance[-1, -1]))
        along = np.sqrt(np.maximum(np.diag(fit.shape_covariance).reshape(-1, 3), 0.0))
        shape = ", ".join(f"{1000 * sd:.0f}" for sd in np.median(along, axis=0))
        place = ", ".join(f"{1000 * sd:.0f}" for sd in fit.place_sd)
        told = round(self.told * self.ways)
        known = "the places of the voice" if self.placed else "the given positions"
        if self.echoing.any():
            known += " and the echoes of the room"
        elif not self.placed:
            known += ", since sound alone does not tell it"
        lines += [
            f"the shape of the array is known to {shape} mm along x, y, z (median); the sound tells "
            f"{told} of {self.ways} ways to deform it" + ", the given positions tell the others" * (told < self.ways),
            f"its place in the room is known to {place} mm along x, y, z, from {known}",
            self._echoes(),
            f"speed of sound {fit.speed_of_sound:.1f} ± {speed_sd:.1f} m/s; {self.windows} stretches of sound, delay "
            f"residual {1e6 * fit.residual_s:.0f} µs, {100 * fit.used:.0f} % of the delays fit",
            f"on sound held out of the fit, the delays' spread is {1e6 * self.held_out_s:.0f} µs with the found "
            f"positions, {1e6 * self.held_out_given_s:.0f} µs with the given ones",
        ]
        if not self.placed:  # one of four rooms of another simulator was such a case (examples/benchmarks)
            lines.append("by sound alone the error can be twice what is stated: give TRACKS or --places to make sure")
        return lines

    def _echoes(self) -> str:
        """Say which surfaces are heard, and which are not where the room's size puts them."""
        names = [name for name, heard in zip(SURFACES, self.echoing, strict=True) if heard]
        if not names:
            return "no echo of the floor, the ceiling or a wall is clear enough to be used"
        apart = np.where(self.echoing, self.fit.surfaces - surfaces(self.prior.room).position, 0.0)
        odd = int(np.argmax(np.abs(apart)))
        elsewhere = f"; {SURFACES[odd]} is {100 * abs(apart[odd]):.0f} cm from where config.json has it"
        return f"echoes of {', '.join(names)} are used" + (elsewhere if abs(apart[odd]) > ELSEWHERE_M else "")


def measure(
    heard: Heard, again: Again, prior: Prior, way: bundle.Way | None, *, is_clock_known: bool = True
) -> Measured:
    """Find an array from a moving voice: first from single windows, then from windows that are heard together.

    Channels whose delay or drift differs from the others' by less than SYNCHRONOUS standard deviations are then taken
    to be synchronous, as those of one device are.

    Args:
        heard: what single windows tell.
        again: listens again along a path.
        prior: what is known before.
        way: where the voice was, if that is known.
        is_clock_known: whether its times are the sound's.

    Raises:
        ValueError: too little was heard, or the way and the sound do not overlap in time.
    """
    clock = 0.0

    def fitted(said: Heard, rows: np.ndarray | slice = np.s_[:], given: bool = False, **priors: Any) -> bundle.Fit:
        return bundle.adjust(
            said.times[rows], said.places[rows], said.delays[rows], said.first, said.second, prior.positions,
            prior.speed_of_sound, bundle.Priors(
                position_m=1e-6 if given else prior.sd_m, speed_m_s=prior.speed_sd,
                clock_s=0.0 if is_clock_known else CLOCK_SD_S, **priors,
            ), way_used, clock, doubt_echoes=way is None and said is not heard, surfaces=surfaces(prior.room),
            echoes=said.echoes and said.echoes.part(rows),
        )  # fmt: skip

    way_used = None
    rough = fitted(heard)
    if way is not None:
        clock = 0.0 if is_clock_known else _clock(rough.path, heard.times, way)
        if not (np.abs(heard.times[:, None] + clock - way.times) < 0.2).any():
            raise ValueError("nothing is heard at the times of the places")
        way_used = way
    said = again(heard.times, rough.path, rough.predicted, rough.arrivals, rough.echoes)
    free = fitted(said)
    off = prior.late | (np.abs(free.delays - np.median(free.delays)) > SYNCHRONOUS * free.delay_sd)
    adrift = prior.adrift | (np.abs(free.drifts - np.median(free.drifts)) > SYNCHRONOUS * free.drift_sd)
    delay, drift = np.where(off | adrift, 1e-3, TIGHT_S), np.where(adrift, 2e-5, TIGHT_DRIFT)
    best = fitted(said, delay_s=delay, drift=drift)
    part = np.floor(said.times / 5.0).astype(int) % 2 == 0
    scores = [
        [fitted_on(said, rows, model, prior) for rows, model in ((~part, one), (part, other))]
        for one, other in (
            [(prior.positions, np.zeros(len(off)), prior.speed_of_sound)] * 2,
            [
                (half.positions, half.delays, half.speed_of_sound)
                for half in (fitted(said, rows, delay_s=delay, drift=drift) for rows in (part, ~part))
            ],
        )
    ]
    return Measured(
        best, prior, best.told(prior.sd_m), float(np.mean(scores[0])), float(np.mean(scores[1])), len(said.times),
        way is not None,
    )  # fmt: skip


def fitted_on(said: Heard, rows: np.ndarray, model: tuple[np.ndarray, np.ndarray, float], prior: Prior) -> float:
    """Return the spread, s, of delays about an array that is held: positions (m, 3) m, delays (m,) s and the speed."""
    positions, late, speed = model
    delays = said.delays[rows] - (late[said.first] - late[said.second])[:, None]
    held = bundle.Priors(position_m=1e-7, delay_s=1e-9, drift=1e-12, speed_m_s=1e-6)
    fit = bundle.adjust(said.times[rows], said.places[rows], delays, said.first, said.second, positions, speed, held)
    away = np.nanmin(np.abs(delays - fit.predicted[..., None]), axis=2, initial=np.inf, where=np.isfinite(delays))
    return 1.4826 * float(np.median(away[np.isfinite(away)]))


def _clock(path: np.ndarray, times: np.ndarray, way: bundle.Way) -> float:
    """Return what to add to times (n,) s of a path (n, 3) m to get those of the way, s.

    Raises:
        ValueError: they do not overlap.
    """
    best, least = 0.0, np.inf
    for offset in np.arange(-WIDEST_CLOCK_S, WIDEST_CLOCK_S + 1e-9, 0.02):
        at = times + offset
        known = (at >= way.times[0]) & (at <= way.times[-1])
        if known.mean() < 0.3:
            continue
        there = np.stack([np.interp(at[known], way.times, way.places[:, axis]) for axis in range(2)], axis=1)
        apart = float(np.median(np.linalg.norm(there - path[known, :2], axis=1)))
        if apart < least:
            best, least = float(offset), apart
    if not np.isfinite(least):
        raise ValueError("the sound and the track do not overlap in time")
    return best


def tracked(times: np.ndarray, places: np.ndarray, is_stated: bool, sd_m: float) -> bundle.Way:
    """Return the way of a track: times (k,) s, mouths (k, 3) m, which are stated or guessed; its errors last a while.

    Raises:
        ValueError: it has fewer than two records with one person.
    """
    if len(times) < 2:
        raise ValueError(f"the track has {len(times)} records with one person; record one person who walks and talks")
    return bundle.Way(
        times, places, np.floor(times / TRACK_LASTS_S).astype(int), sd_m, STATED_M if is_stated else GUESSED_M
    )


def measured_places(text: str, name: str) -> bundle.Way:
    """Read where somebody spoke or clapped: lines "begin,end,x,y,z" in s and m.

    Raises:
        ValueError: a line is not five numbers, or ends before it begins, or overlaps the one before.
    """
    rows = [line.strip() for line in text.splitlines()]
    times, places, errors = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    last = -np.inf
    for number, row in enumerate(rows, 1):
        if not row or row.startswith("#"):
            continue
        try:
            begin, end, *place = (float(cell) for cell in row.split(","))
        except ValueError:
            begin, end, place = np.nan, np.nan, []
        if len(place) != 3 or not np.isfinite([begin, end, *place]).all() or not last <= begin < end:
            raise ValueError(f"{name}:{number}: expected begin,end,x,y,z in s and m, in order of time, found {row!r}")
        last = end
        at = np.linspace(begin, end, max(2, int((end - begin) / 0.1)))
        times.append(at)
        places.append(np.tile(place, (len(at), 1)))
        errors.append(np.full(len(at), number))
    if not times:
        raise ValueError(f"{name}: there are no places in it")
    return bundle.Way(np.concatenate(times), np.concatenate(places), np.concatenate(errors), PLACE_SD_M, STATED_M)


def mouths(track: Iterable[Identified], height: float) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return where a walker's mouth is: as the records state it, otherwise ahead of the body at a height.

    Args:
        track: records in any order; those with one person are used.
        height: m, of the mouth where a record does not state it.

    Returns:
        times (k,) s, ascending, mouths (k, 3) m, and whether the records state all of them.
    """
    alone = sorted((one for one in track if len(one) == 1), key=lambda one: one.timestamp)
    times = np.array([one.timestamp for one in alone])
    path = np.array([one.mouths[0] for one in alone], float).reshape(-1, 3)
    bare = np.isnan(path).any(1)
    path[bare, :2] = np.array([one.positions[0, :2] for one in alone], float).reshape(-1, 2)[bare]
    if bare.any() and len(path) > 2:
        level, step = _smooth(times, path[:, :2])
        path[bare, :2] = level[bare]
        speed = np.linalg.norm(step, axis=1, keepdims=True)
        ahead = np.where(speed > 0.2, MOUTH_AHEAD_M * step / np.maximum(speed, 1e-9), 0.0)
        path[bare, :2] += ahead[bare]
    path[bare, 2] = height
    return times, path, not bare.any()


def _smooth(times: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (k, 2) m and velocities (k, 2) m/s of a tracked walker, by lines fitted over a Gaussian of time.

    A track errs from step to step, and errors taken for movement would make the clock look better known than it is.
    """
    level, step = np.zeros((2, *path.shape))
    for first in range(0, len(times), 500):  # an hour at once would be matrices of gigabytes
        rows = slice(first, first + 500)
        near = (times >= times[rows][0] - 9.0 * SMOOTH_S) & (times <= times[rows][-1] + 9.0 * SMOOTH_S)
        level[rows], step[rows] = _lines(times[rows], times[near], path[near])
    return level, step


def _lines(at: np.ndarray, times: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what `_smooth` does at some times (n,) s, from a path (k, 2) m at times (k,) s."""
    away = times[None] - at[:, None]
    weight = np.exp(-0.5 * (away / SMOOTH_S) ** 2)
    weight /= weight.sum(1, keepdims=True)
    late = (weight * away).sum(1)
    middle = weight @ path
    spread = np.maximum((weight * (away - late[:, None]) ** 2).sum(1), 1e-12)
    step = ((weight * (away - late[:, None])) @ path) / spread[:, None]
    return middle - step * late[:, None], step


def sounds(paths: Sequence[str], folder: Path | None) -> Iterator[tuple[float, np.ndarray, int]]:
    """Read sound in pieces: files that follow one another, or a folder's files, each from the time in its name.

    Args:
        paths: sound files in order of time, from time 0 on.
        folder: where to look instead if there are no paths: DIR/audio/wav of an experiment.

    Returns:
        start in s, samples (n, channels) and sample rate in Hz of each piece.

    Raises:
        ValueError: there is no sound.
    """
    files: list[tuple[str | Path, float | None]] = [(path, None) for path in paths]
    if not paths and folder is not None:
        found = sorted((float(file.stem.rsplit("_", 1)[1]), file) for file in folder.glob("multichannel_audio_*"))
        if not found:
            raise ValueError(f"no sound in {folder}; name the files with --audio")
        files = [(file, start) for start, file in found]
    start = 0.0
    for path, stated in files:
        start = start if stated is None else stated
        for samples, rate in media.audio_blocks(path, 1 << 17):
            yield start, samples, rate
            start += len(samples) / rate
