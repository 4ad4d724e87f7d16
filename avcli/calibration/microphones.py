"""Microphone positions and the clock between sound and picture, from a speaker whose track is known."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avcli.formats import media
from avcli.formats.records import Identified

POSITION_SD_M = 0.05
"""Expected error of a measured microphone position, m (prior)."""
SOURCE_SD_M = 0.1
"""Expected offset of the mouth from the track, m (prior); one offset for the whole recording."""
SMOOTH_S = 0.4
"""Width of the Gaussian over which a track is smoothed, s."""
MOUTH_AHEAD_M = 0.1
"""How far a walker's mouth is ahead of the body's axis."""
_SURE = 16.3
"""Chi-square with three degrees of freedom that chance exceeds once in a thousand."""


@dataclass(frozen=True)
class Heard:
    """When a voice reached which microphone.

    Attributes:
        times: (n,) s on the sound's clock, middles of the windows.
        delays: (n, p) s, arrival at a pair's first microphone minus at its second; NaN where nothing was clear.
        first, second: (p,) the microphones of each pair.
    """

    times: np.ndarray
    delays: np.ndarray
    first: np.ndarray
    second: np.ndarray


@dataclass(frozen=True)
class Aligned:
    """Microphone positions and clock offset, as the sound shows them.

    Attributes:
        clock_offset: s, to add to a time on the sound's clock to get the picture's.
        clock_offset_sd: s.
        positions: (m, 3) m.
        shifts: (m, 3) m, positions minus those that were given.
        covariances: (m, 3, 3) m².
        residual_s: robust standard deviation of the delays about the model, s.
        held_out_given_s, held_out_s: the same for windows that took no part, with the given and the found positions.
        used: share of the delays that fit the model.
        windows: number of windows with a clear delay.
    """

    clock_offset: float
    clock_offset_sd: float
    positions: np.ndarray
    shifts: np.ndarray
    covariances: np.ndarray
    residual_s: float
    held_out_given_s: float
    held_out_s: float
    used: float
    windows: int

    @property
    def improves(self) -> bool:
        """Whether the found positions explain windows that took no part better than the given ones do."""
        return bool(self.held_out_s < 0.95 * self.held_out_given_s)

    @property
    def sd_m(self) -> float:
        """Largest standard deviation of a microphone's position along any direction, m."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariances)[:, -1].max()))

    def record(self) -> dict:
        """What was found, as avcalib writes it."""
        return {
            "clock_offset_s": self.clock_offset,
            "clock_offset_sd_s": self.clock_offset_sd,
            "delay_residual_s": self.residual_s,
            "held_out_given_s": self.held_out_given_s,
            "held_out_found_s": self.held_out_s,
            "microphones": [
                {"position": p.tolist(), "shift_m": s.tolist(), "sd_m": np.sqrt(np.diag(c)).tolist()}
                for p, s, c in zip(self.positions, self.shifts, self.covariances, strict=True)
            ],
        }


def mouths(track: Iterable[Identified], height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where a walker's mouth is: as the records state it, otherwise ahead of the body at a height.

    Args:
        track: records in any order; those with one person are used.
        height: m, of the mouth where a record does not state it.

    Returns:
        times (k,) s, ascending, and mouths (k, 3) m.
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
    return times, path


def _smooth(times: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (k, 2) m and velocities (k, 2) m/s of a tracked walker, by lines fitted over a Gaussian of time.

    A track errs from step to step, and errors taken for movement would make the clock look better known than it is.
    """
    away = times[None] - times[:, None]
    weight = np.exp(-0.5 * (away / SMOOTH_S) ** 2)
    weight /= weight.sum(1, keepdims=True)
    late = (weight * away).sum(1)
    middle = weight @ path
    spread = np.maximum((weight * (away - late[:, None]) ** 2).sum(1), 1e-12)
    step = ((weight * (away - late[:, None])) @ path) / spread[:, None]
    return middle - step * late[:, None], step


def sounds(paths: Sequence[str], folder: Path | None) -> Iterator[tuple[float, np.ndarray, int]]:
    """Read sound that follows on: files one after another, or a folder's files, each from the time in its name.

    Args:
        paths: sound files in order of time, from time 0 on.
        folder: where to look instead if there are no paths: DIR/audio/wav of an experiment.

    Returns:
        start in s, samples (n, channels) and sample rate in Hz of each.

    Raises:
        ValueError: there is no sound.
    """
    start = 0.0
    for path in paths:
        samples, rate = media.read_audio(path)
        yield start, samples, rate
        start += len(samples) / rate
    if paths or folder is None:
        return
    files = sorted(folder.glob("multichannel_audio_*"))
    if not files:
        raise ValueError(f"no sound in {folder}; name the files with --audio")
    for file in files:
        samples, rate = media.read_audio(file)
        yield float(file.stem.rsplit("_", 1)[1]), samples, rate


def joined(parts: list[tuple[np.ndarray, np.ndarray]], microphones: int) -> Heard:
    """Join (times (n,), delays (n, pairs)) of stretches of sound; pairs in the order of the upper triangle."""
    first, second = np.triu_indices(microphones, 1)
    times, delays = [np.zeros(0)], [np.zeros((0, len(first)))]
    for some, found in parts:
        times.append(some)
        delays.append(found)
    return Heard(np.concatenate(times), np.concatenate(delays), first, second)


def words(result: Aligned) -> list[str]:
    """Describe the clock and the microphones, in sentences without a full stop."""
    lines = [
        f"clock: picture time = sound time {result.clock_offset:+.4f} s ± {result.clock_offset_sd:.4f} s; "
        f"{result.windows} windows, delay residual {1e6 * result.residual_s:.0f} µs, {100 * result.used:.0f} % of the "
        "delays fit"
    ]
    for number, (shift, covariance) in enumerate(zip(result.shifts, result.covariances, strict=True), 1):
        size, sd = float(np.linalg.norm(shift)), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        elsewhere = float(shift @ np.linalg.solve(covariance, shift)) > _SURE and size > 0.01
        say = "is not where it was measured" if elsewhere else "agrees with its measured position"
        lines.append(f"microphone {number} {say}: shift {1000 * size:.0f} mm ± {1000 * sd:.0f} mm")
    better = "are better than" if result.improves else "are not better than"
    found, given = 1e6 * result.held_out_s, 1e6 * result.held_out_given_s
    lines.append(
        f"on sound held out of the fit, the found positions {better} the given ones: residual {found:.0f} µs, given "
        f"{given:.0f} µs"
    )
    return lines


def align(
    heard: Heard,
    path_times: np.ndarray,
    path: np.ndarray,
    microphones: np.ndarray,
    speed_of_sound: float,
    *,
    widest_offset: float = 1.0,
) -> Aligned:
    """Find clock offset and microphone positions that explain when a moving voice was heard.

    The offset is scanned with the given positions and then solved for together with the positions and one offset of the
    mouth, by robust Gauss-Newton with Gaussian priors (maximum a posteriori; the priors hold what the walk leaves open,
    such as a turn of everything about a straight path).

    Args:
        heard: delays.
        path_times, path: (k,) s on the picture's clock, ascending, and (k, 3) m, where the mouth was.
        microphones: (m, 3) m as measured.
        speed_of_sound: m/s.
        widest_offset: s, how far the clocks may be apart.

    Raises:
        ValueError: too little was heard while the voice's place was known.
    """
    clear = np.isfinite(heard.delays)
    if clear.any(1).sum() < 8 or len(path_times) < 2:
        raise ValueError(
            f"not enough data: a clear voice in {int(clear.any(1).sum())} windows, a track of {len(path_times)} "
            "records; record one person who talks or claps at ten or more places"
        )
    problem = _Problem(heard, path_times, path, microphones, speed_of_sound)
    offsets = np.arange(-widest_offset, widest_offset + 1e-9, 0.02)
    costs = [problem.coarse_cost(offset) for offset in offsets]
    if not np.isfinite(costs).any():
        raise ValueError("the sound and the track do not overlap in time")
    start = float(offsets[int(np.nanargmin(costs))])
    # Alternate stretches of about a second, so that neighbours in time do not tell each other's noise.
    part = (np.floor(heard.times - heard.times[0]).astype(int) % 2).astype(bool)
    every = np.ones(len(part), bool)
    found, covariance, spread, used = problem.solve(start, every, free=True)
    given = [problem.solve(start, part == half, free=False)[0] for half in (False, True)]
    learned = [problem.solve(start, part == half, free=True)[0] for half in (False, True)]
    count = len(microphones)
    return Aligned(
        clock_offset=float(found[0]),
        clock_offset_sd=float(np.sqrt(covariance[0, 0])),
        positions=microphones + found[4:].reshape(-1, 3),
        shifts=found[4:].reshape(-1, 3),
        covariances=np.stack([covariance[4 + 3 * i : 7 + 3 * i, 4 + 3 * i : 7 + 3 * i] for i in range(count)]),
        residual_s=spread,
        held_out_given_s=float(np.mean([problem.spread(given[h], part != bool(h)) for h in (0, 1)])),
        held_out_s=float(np.mean([problem.spread(learned[h], part != bool(h)) for h in (0, 1)])),
        used=used,
        windows=int(clear.any(1).sum()),
    )


class _Problem:
    """Unknowns: clock offset (s), offset of the mouth (3, m), shift of each microphone (3 m, m)."""

    def __init__(self, heard: Heard, path_times: np.ndarray, path: np.ndarray, microphones: np.ndarray, speed: float):
        self.heard, self.path_times, self.path = heard, path_times, path
        self.microphones, self.speed = microphones, speed
        middle = path.mean(0)
        self.travel = float(np.linalg.norm(microphones - middle, axis=1).mean() / speed)

    def _at(self, offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Place and velocity of the mouth in each window, NaN where the track does not say."""
        t = self.heard.times + offset - self.travel
        inside = (t >= self.path_times[0]) & (t <= self.path_times[-1])
        place = np.stack([np.interp(t, self.path_times, self.path[:, i]) for i in range(3)], -1)
        h = 0.05
        ahead = np.stack([np.interp(t + h, self.path_times, self.path[:, i]) for i in range(3)], -1)
        behind = np.stack([np.interp(t - h, self.path_times, self.path[:, i]) for i in range(3)], -1)
        place[~inside] = np.nan
        return place, (ahead - behind) / (2 * h)

    def _model(self, unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predicted delays (n, p) and their derivatives (n, p, unknowns)."""
        place, velocity = self._at(unknown[0])
        m = self.microphones + unknown[4:].reshape(-1, 3)
        away = (place + unknown[1:4])[:, None] - m[None]
        distance = np.linalg.norm(away, axis=2)
        unit = away / np.maximum(distance, 1e-9)[..., None]
        first, second = self.heard.first, self.heard.second
        predicted = (distance[:, first] - distance[:, second]) / self.speed
        towards = (unit[:, first] - unit[:, second]) / self.speed
        J = np.zeros((*predicted.shape, len(unknown)))
        J[:, :, 0] = np.einsum("npi,ni->np", towards, velocity)
        J[:, :, 1:4] = towards
        p = np.arange(len(first))
        for i in range(3):
            J[:, p, 4 + 3 * first + i] = -unit[:, first, i] / self.speed
            J[:, p, 4 + 3 * second + i] = unit[:, second, i] / self.speed
        return predicted, J

    def _rest(self, unknown: np.ndarray) -> np.ndarray:
        return self.heard.delays - self._model(unknown)[0]

    def coarse_cost(self, offset: float) -> float:
        """Mean of the delays' misfit, none of them counting more than a millisecond."""
        unknown = np.zeros(4 + self.microphones.size)
        unknown[0] = offset
        rest = np.abs(self._rest(unknown))
        known = np.isfinite(rest)
        if known.sum() < 0.3 * np.isfinite(self.heard.delays).sum():
            return np.nan
        return float(np.minimum(rest[known], 1e-3).mean())

    def solve(self, start: float, windows: np.ndarray, *, free: bool) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Solve from a clock offset; `free` lets the microphones move.

        Returns the unknowns, their covariance, the delays' spread (s) and the share of delays within three of it.
        """
        size = 4 + self.microphones.size
        unknown = np.zeros(size)
        unknown[0] = start
        sd = np.concatenate([[1.0], np.full(3, SOURCE_SD_M), np.full(size - 4, POSITION_SD_M if free else 1e-9)])
        scale = 3e-4
        for _ in range(30):
            predicted, J = self._model(unknown)
            rest = self.heard.delays - predicted
            good = np.isfinite(rest) & windows[:, None]
            r, A = rest[good], J[good]
            # Cauchy's weight: echoes and wrong peaks are far off and should not pull at all.
            weight = 1 / (1 + (r / (2 * scale)) ** 2)
            normal = (A * weight[:, None]).T @ A / scale**2 + np.diag(1 / sd**2)
            prior = unknown.copy()
            prior[0] = 0.0 if abs(start) < 1e-12 else unknown[0] - start
            step = np.linalg.solve(normal, (A * weight[:, None]).T @ r / scale**2 - prior / sd**2)
            step[0] = np.clip(step[0], -0.05, 0.05)
            unknown = unknown + step
            scale = max(1.4826 * float(np.median(np.abs(r))), 2e-6)
            if np.abs(step).max() < 1e-8:
                break
        return unknown, np.linalg.inv(normal), scale, float((np.abs(r) < 3 * scale).mean())

    def spread(self, unknown: np.ndarray, windows: np.ndarray) -> float:
        """Robust standard deviation of the delays in some windows, s."""
        rest = self._rest(unknown)[windows]
        return 1.4826 * float(np.median(np.abs(rest[np.isfinite(rest)])))
