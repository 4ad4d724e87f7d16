"""The echoes of a room's floor, ceiling and walls, heard by an array's channels.

The floor's echo of a voice reaches a microphone as its direct sound would reach the microphone's mirror image below the
floor. So echoes are heard by an array of other heights, and tell what the direct sound of a voice at one height does
not. A single echo is weak; a recording's are followed together, by how each correlation slopes where its echo is
expected (a score step of the matched field, from smoothed correlations to sharp ones).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

STANDS_OUT, FOLLOWED = 8.0, 4.0
"""How many standard deviations of its noise the mean of a channel's correlations at a surface's echo must have to be
believed, and to be followed once the other channels are in their places."""
LASTING_S = 1e-5
"""The error of a channel's delays at a surface's echo that does not become smaller in a longer recording, s."""
SMOOTHING_S = (1.6e-4, 8e-5, 4e-5, 0.0)
"""Standard deviations of the Gaussians over which correlations are smoothed, one after the other, s."""
LOOKS = tuple((smoothing, least) for least in (STANDS_OUT, FOLLOWED) for smoothing in SMOOTHING_S)
"""Smoothing and what must stand out, one look after the other."""
SHIFT_S, MOSTLY = 6e-4, 0.5
"""How far about an echo's place all channels together are looked at, s, and how much of the most that is found there a
surface must have in its place to be believed."""
APART_S = 3e-4
"""How much later than the direct sound an echo must come, s."""


@dataclass(frozen=True)
class Surfaces:
    """Planes across an axis of the room that reflect sound.

    Attributes:
        axis: (s,) int.
        position: (s,) m, along that axis.
    """

    axis: np.ndarray
    position: np.ndarray

    def mirrored(self, microphones: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the images (m, s, 3) of microphones (m, 3) m behind the surfaces at positions (s,) m."""
        images = np.repeat(microphones[:, None], len(position), axis=1)
        row = np.arange(len(position))
        images[:, row, self.axis] = 2.0 * position - images[:, row, self.axis]
        return images


def surfaces(dimensions: np.ndarray) -> Surfaces:
    """Return the six surfaces of a room of (3,) m."""
    return Surfaces(np.repeat(np.arange(3), 2), np.stack([np.zeros(3), dimensions], axis=1).ravel())


class Echoes(Protocol):
    """What was heard of them.

    `heard` (n, m, s, l) is each channel's correlation with the voice in each window, the echo of each surface where it
    was expected in the middle of the lags, `step` s apart; `expected` (n, m, s) s is the arrival of that echo minus the
    mean arrival of the direct sound, `windows` (n,) how many windows were heard together. `part` gives some windows.
    """

    @property
    def heard(self) -> np.ndarray: ...
    @property
    def step(self) -> float: ...
    @property
    def expected(self) -> np.ndarray: ...
    @property
    def windows(self) -> np.ndarray: ...
    def part(self, rows: np.ndarray | slice) -> "Echoes": ...


class Smoothed:
    """The correlations of a recording's echoes, smoothed.

    Args:
        echoes: what was heard.
        smoothing_s: standard deviation of a Gaussian, s.
        least: how many standard deviations the mean must stand out.
        lasting_s: the error that does not become smaller in a longer recording.
        inflation: by how much the variance of an echo's time is larger than noise makes it.
    """

    def __init__(
        self, echoes: Echoes, smoothing_s: float, least: float, lasting_s: float = 0.0, inflation: float = 1.0
    ):
        from scipy.ndimage import gaussian_filter1d

        self.least = least
        self.echoes, self.lasting, self.inflation = echoes, lasting_s, inflation
        width = smoothing_s / echoes.step
        self.value = gaussian_filter1d(echoes.heard, width, axis=3) if width else echoes.heard
        self.slope = np.gradient(self.value, echoes.step, axis=3)
        self.bend = np.gradient(self.slope, echoes.step, axis=3)
        spread = np.median(np.abs(self.value), axis=(0, 3)) / 0.6745
        self.noise = np.maximum(spread / np.sqrt(np.median(np.maximum(echoes.windows, 1))), 1e-30)
        self.sign, self.trusted = 1.0, np.zeros(echoes.heard.shape[2], bool)

    def trust(self, delays: np.ndarray, direct: np.ndarray) -> None:
        """Decide whether surfaces invert the pressure, and which of them (s,) are heard where they are expected.

        In the last look, each channel must hear them there (m, s).
        """
        shifts = np.arange(-SHIFT_S, SHIFT_S + 1e-9, 4 * self.echoes.step)
        each = np.array([self._clear(delays + shift, direct)[0] for shift in shifts - shifts.mean()])
        curves, middle = each.sum(axis=1), len(shifts) // 2
        self.sign = float(np.sign(curves[middle][np.abs(curves[middle]).argmax()]))
        self.trusted = self.sign * curves[middle] > MOSTLY * np.abs(curves).max(axis=0)
        if self.lasting:
            self.trusted = self.trusted & (self.sign * each[middle] > MOSTLY * (self.sign * each).max(axis=0))

    def _clear(self, delays: np.ndarray, direct: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return how far the mean correlations stand out of their noise (m, s), where, and the windows (n, m, s)."""
        echoes = self.echoes
        at = (delays - echoes.expected) / echoes.step + (self.value.shape[3] - 1) / 2
        usable = (at > 0.0) & (at < self.value.shape[3] - 1.001) & (delays - direct[..., None] > APART_S)
        count = np.where(usable, echoes.windows[:, None, None], 0.0)
        value = np.where(usable, _at(self.value, at), 0.0).sum(axis=0)
        return value / (self.noise * np.sqrt(np.maximum(count.sum(axis=0), 1.0))), at, count

    def told(self, delays: np.ndarray, direct: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return how far echoes are from where they are expected, and how well that is told.

        Args:
            delays: (n, m, s) s, of echoes after the mean direct sound, as a model has them.
            direct: (n, m) s, of each channel's direct sound after the mean.

        Returns:
            residuals (n, m, s) s, information (n, m, s) 1/s², and by how many standard deviations of its noise each
            channel hears each surface's echo (m, s), 0 where it is not used.
        """
        clear, at, count = self._clear(delays, direct)
        clear = self.sign * clear
        slope, bend = (self.sign * np.where(count > 0.0, _at(curve, at), 0.0) for curve in (self.slope, self.bend))
        total = np.maximum(count.sum(axis=0), 1.0)
        curvature = -bend.sum(axis=0) / total
        heard = self.trusted & (clear > self.least) & (curvature > 0.0)
        curvature = np.where(heard, curvature, 1.0)
        information = clear * curvature / (self.noise * np.sqrt(total) * self.inflation)
        # Other echoes come near in some places and bend a surface's echo by a little, in whatever many windows.
        information = information / (1.0 + information * count.sum(axis=0) * self.lasting**2)
        residual = slope / (np.maximum(count, 1.0) * curvature)
        return residual, np.where(heard, count * information, 0.0), np.where(heard, clear, 0.0)


def _at(curves: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate curves (..., l) linearly at places (...) between 0 and l - 1."""
    low = np.clip(at.astype(int), 0, curves.shape[-1] - 2)[..., None]
    part = at - low[..., 0]
    one, other = (np.take_along_axis(curves, low + offset, axis=-1)[..., 0] for offset in (0, 1))
    return one + part * (other - one)
