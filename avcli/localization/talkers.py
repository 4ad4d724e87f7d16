"""The talkers of one decision, one after another: each is searched for in what those before it leave.

What a talker explains is taken away in three ways: by a mask over times and frequencies, by a notch around the lags of
the direct sound, and by notches where the lags of the first echoes must be.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avcli.localization import multilateration
from avcli.localization.array import Array
from avcli.localization.line import HalfPlane
from avcli.localization.masks import Masks
from avcli.localization.memory import Memory, Trace, level_distance
from avcli.localization.mirror import HalfSpace
from avcli.localization.modulation import Levels
from avcli.localization.noise import NoiseLaw
from avcli.localization.settings import SteeredSettings
from avcli.localization.srp import SteeredResponse
from avcli.localization.windows import Heard

NOTCH_M, ECHO_NOTCH_M = 0.1, 0.012
"""m of range difference: half the width of a notch around a talker's lags, and around those of an echo."""


@dataclass(frozen=True)
class Peak:
    """A place that is answered better than noise would.

    Attributes:
        position: (3,) m.
        velocity: (3,) m/s.
        response, agreement, support, own, residual, strongest: see uncertainty.Features.
        normal: (3, 3) normal matrix of its range differences, with weights of mean 1.
        gccs: (windows, pairs, lags) those that the peaks before left for it.
        levels: (windows, bands) dB, of what agrees with it, see `modulation.Levels`.
    """

    position: np.ndarray
    velocity: np.ndarray
    response: float
    agreement: float
    support: float
    own: float
    residual: float
    strongest: float
    normal: np.ndarray
    gccs: np.ndarray
    levels: np.ndarray

    def path(self, offsets: np.ndarray) -> np.ndarray:
        """Return where it is at offsets (n,) s, (n, 3) m; (1, 3) m for all of them where it stands."""
        return self.position + self.velocity * offsets[:, None] if self.velocity.any() else self.position[None]


class TalkerSearch:
    """Finds the talkers of one decision after another.

    Args:
        array: the microphones and the room.
        settings: see SteeredSettings.
        masks, response: of the array.
        half: what is searched of the room where places are heard alike.
    """

    def __init__(
        self,
        array: Array,
        settings: SteeredSettings,
        masks: Masks,
        response: SteeredResponse,
        half: HalfPlane | HalfSpace | None = None,
    ):
        self.array, self.settings, self.masks, self.response, self.half = array, settings, masks, response, half
        self.levels = Levels(masks.correlator.band, array.sample_rate)

    def peaks(self, heard: Heard, noise: NoiseLaw, memory: Memory) -> list[Peak]:
        """Return the places that are answered better than noise would, each without those before it.

        There is one more than there may be talkers, since a ghost may still come before the second talker. After the
        first, and where there is none, talkers of the decisions before are searched for where they were: a known talker
        needs a smaller response than a new one.

        Args:
            heard: the windows around the moment.
            noise: what noise does to as many windows.
            memory: what the decisions before found.
        """
        found: list[Peak] = []
        # Where steady sources and the peaks so far are, (windows, 3) m or (1, 3) m each.
        taken = [place[None] for place in heard.steady]
        gccs, explained = heard.gccs, self.masks.explained(heard)
        known, nobody_new = memory.known(), False
        for _ in range(self.settings.max_speakers + 1):
            if taken or heard.above is not None:
                gccs = self.left(heard, explained, taken)
            known = [trace for trace in known if not any(_same(peak, trace, memory) for peak in found)]
            again = known.pop(0) if known and (found or nobody_new) else None
            threshold = noise.threshold(self.settings.candidate if taken else self.settings.false_alarm)
            start = again.position if again else self.brightest(gccs, noise, threshold)
            fit = None if start is None else self.fitted(gccs, heard, start, noise, explained)
            if fit is None or (again is None and fit[0].response < threshold):
                if found or nobody_new or not known:
                    break
                nobody_new = True
                continue
            peak, coherence = fit
            explained = np.maximum(explained, coherence)
            if again is not None and not _same(peak, again, memory):
                continue
            if all(level_distance(peak.position, one.position) > self.settings.separation for one in found):
                found.append(peak)
            taken.append(peak.path(heard.offsets))
        return found

    def beside(self, heard: Heard, noise: NoiseLaw, peaks: Sequence[Peak], start: np.ndarray) -> Peak:
        """Return the peak near a start (3,) m, without those that were found before it.

        Args:
            heard: the windows around the moment.
            noise: what noise does to as many windows.
            peaks: those before.
            start: (3,) m.
        """
        explained, gccs = self.masks.explained(heard), heard.gccs
        taken = [place[None] for place in heard.steady]
        for peak in peaks:
            explained = np.maximum(explained, self.masks.coherence(heard, peak.position, peak.velocity))
            taken.append(peak.path(heard.offsets))
        if taken or heard.above is not None:
            gccs = self.left(heard, explained, taken)
        return self.fitted(gccs, heard, start, noise, explained)[0]

    def brightest(self, gccs: np.ndarray, noise: NoiseLaw, threshold: float) -> np.ndarray | None:
        """Return the place (3,) m that answers best; None where a fit could not lift it to the threshold.

        The GCCs (windows, pairs, lags) are cut off well above their noise, so that many pairs must agree: two talkers
        make ghosts where a few strong pairs of the one meet a few of the other.
        """
        mean = gccs.mean(axis=0)
        start = self.response.search(np.minimum(mean, 7.0 * noise.deviation))[0][0]
        start = self.half.fold(start) if self.half else start
        return start if 1.5 * float(self.response.response(mean, start[None])[0]) >= threshold else None

    def left(self, heard: Heard, explained: np.ndarray, taken: list[np.ndarray]) -> np.ndarray:
        """Return the GCCs (windows, pairs, lags) that the peaks so far leave.

        Args:
            heard: the windows around the moment.
            explained: (windows, bins) the peaks' coherence, see `Masks.coherence`.
            taken: where the steady sources and then the peaks are, see `Peak.path`.
        """
        gccs = self.masks.masked(heard, explained)
        for places in taken:
            gccs = self.response.notch(gccs, places, NOTCH_M)
        peaks = taken[len(heard.steady) :]
        if not peaks or self.response.flat:  # where echoes stand is not known beside a line
            return gccs
        return self.response.notch_echoes(gccs, peaks[0], self.array.room, ECHO_NOTCH_M)

    def fitted(
        self, gccs: np.ndarray, heard: Heard, start: np.ndarray, noise: NoiseLaw, explained: np.ndarray
    ) -> tuple[Peak, np.ndarray]:
        """Fit place and velocity from a start, then the place to the peaks of each pair's GCC nearby.

        The second fit is kept where it is answered better.

        Args:
            gccs: (windows, pairs, lags) that the peaks before leave.
            heard: the windows around the moment.
            start: (3,) m.
            noise: what noise does to as many windows.
            explained: (windows, bins) the coherence of the peaks before.

        Returns:
            The peak, and its coherence (windows, bins).
        """
        steered, offsets = self.response, heard.offsets
        position, velocity, response = steered.follow(gccs, offsets, start, self.settings.max_speed)
        aligned = steered.aligned(gccs, offsets, position, velocity, reach=6)
        differences, height = steered.differences(aligned, position)
        value = aligned[:, aligned.shape[1] // 2]
        fitted, normal, _ = multilateration.refine(
            position, self.array.microphones, steered.first, steered.second, differences, np.maximum(height, 0.0)
        )
        if ((fitted >= steered.low) & (fitted <= steered.high)).all():
            moved = steered.aligned_at(aligned, position, fitted)
            gain = float(moved.mean() - value.mean())
            if gain > 0.0:
                position, response, value = fitted, response + gain, moved
        ranges = np.linalg.norm(position - self.array.microphones, axis=1)
        misfit = differences - (ranges[steered.first] - ranges[steered.second])
        # What pairs agree on is of those that are there; their GCCs were scaled up for those that are not.
        value, height, misfit = value[heard.pairs], np.maximum(height[heard.pairs], 0.0), misfit[heard.pairs]
        scale = float(np.sqrt(heard.pairs.mean())) / noise.deviation
        places = position + velocity * offsets[:, None]
        each = [steered.response(gcc, place[None])[0] for gcc, place in zip(gccs, places, strict=True)]
        coherence = self.masks.coherence(heard, position, velocity)
        peak = Peak(
            position,
            velocity,
            response,
            agreement=max(float(np.clip(scale * value / 3.0, -1.0, 1.0).mean()), 0.0),
            support=float(np.clip(scale * height / 4.0, 0.0, 1.0).mean()),
            own=float((coherence * (coherence > explained)).sum() / max(coherence.sum(), 1e-12)),
            residual=float(np.sqrt(np.minimum(misfit**2, 0.02**2).mean())),
            strongest=float(max(each) / max(np.mean(each), 0.1 * noise.deviation)),
            normal=normal / max(height.mean(), 1e-9),
            gccs=gccs,
            levels=self.levels(coherence, heard.power),
        )
        return peak, coherence


def _same(peak: Peak, trace: Trace, memory: Memory) -> bool:
    """Tell whether a peak may be the talker of a trace."""
    return level_distance(peak.position, trace.position) <= memory.reach(trace)
