"""The default localizer: steered response power on a stream, one decision for every time step.

Each step takes one Hann window around the moment at which what was said then passes the microphones. The windows of
the steps before and after are added to it, so that one transform a step serves a window of 0.19 s for talkers who walk
and one of 0.39 s for rooms that echo; the search over place and velocity lets the three agree on a walker.
"""

import itertools
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from avcli.localization import directions, uncertainty
from avcli.localization.array import Array, Decision, time_steps
from avcli.localization.directions import DirectionFinder, RaySearch
from avcli.localization.events import Gate
from avcli.localization.health import Health
from avcli.localization.hum import Hum
from avcli.localization.line import HalfPlane
from avcli.localization.masks import Masks
from avcli.localization.memory import Memory
from avcli.localization.mirror import HalfSpace
from avcli.localization.noise import NoiseLaw, draw_noise_law
from avcli.localization.places import PlaceFinder
from avcli.localization.settings import SteeredSettings
from avcli.localization.srp import SteeredResponse
from avcli.localization.steady import SPACING_S, SteadySources
from avcli.localization.stream import Block, LatestSamples, stretches
from avcli.localization.voice import VoiceMeter
from avcli.localization.windows import Band, Correlated, Correlator, Window, together

WHOLE = 0.99
"""The part of a window that the stream must hold for the window to count as whole."""

UNSETTLED = (
    "channel {} or others are left out most of the time: they are noisy, or their microphones are not where config.json"
    " says; avcalib microphones can tell"
)

CONTRADICTED = (
    "the channels contradict each other: they fit together much better in another order, with other delays or other"
    " polarities, but not clearly enough to name these; until they do, talkers have lower scores"
)


@dataclass(frozen=True)
class Moment:
    """A time step that waits for what is heard after it.

    Attributes:
        step: its number.
        found: what its windows hold; None: nothing.
        now: its own window; None: nothing sounds.
        out: (m,) bool, which channels were left out.
        decision: what is known of it but the talkers.
    """

    step: int
    found: Any
    now: Correlated | None
    out: np.ndarray
    decision: Decision


class SteeredLocalizer:
    """Steered response power for one array.

    Args:
        array: the microphones and the room.
        settings: see SteeredSettings.
        rng: draws the noise from which the detection threshold is set.
        law: scores and covariances; the fitted one by default.

    Raises:
        ValueError: no position can be computed from the array, or the band is too narrow.
    """

    def __init__(
        self,
        array: Array,
        settings: SteeredSettings,
        rng: np.random.Generator,
        law: uncertainty.Law | None = None,
    ):
        low = np.array([0.0, 0.0, min(settings.heights[0], array.room[2])])
        high = np.array([*array.room[:2], min(settings.heights[1], array.room[2])])
        compact = not directions.observes_ranges(array, low, high)
        array.require(count=4)
        self.settings, self.rng = settings, rng
        self.law = law or uncertainty.fitted_law()
        self.delay = array.mean_delay(low, high)
        # Of microphones on one line only a half-plane is searched: about the line nothing can be told.
        self.half: HalfPlane | HalfSpace | None = None
        if not compact:
            self.half = HalfPlane.beside(array, low, high) or HalfSpace.beside(array, low, high)
        if self.half:
            array, low, high = self.half.searched(array)
        self.array = array
        if compact:
            settings = replace(settings, band=directions.band_of(settings, array), tilt=0.0)
        self.band = Band.of(settings, array.sample_rate)
        scale = array.sample_rate * self.band.oversampling / array.speed_of_sound
        response: SteeredResponse | RaySearch
        if compact:
            response = RaySearch(array, low, high, scale)
        else:
            response = SteeredResponse(
                array.microphones,
                low,
                high,
                scale,
                cell=settings.cell,
                resolution=settings.resolution,
                keep=settings.keep,
            )
        self.correlator = Correlator(array, self.band, response.half_lags, settings.beta)
        self.voices = VoiceMeter(array, self.band)
        self.health = Health(array, self.correlator, response)
        masks = Masks(array, self.correlator)
        self.finder: PlaceFinder | DirectionFinder
        if isinstance(response, RaySearch):
            self.finder = DirectionFinder(
                settings, response, masks, directions.fitted_law(), self.law.voice, lambda: self.health.trust
            )
        else:
            self.finder = PlaceFinder(array, settings, response, masks, self.health, self.law, self.half)
        # Windows lie `hop` apart: a whole number of them to a decision, close enough for the context to be covered.
        self.windows_a_step = max(1, int(np.ceil(1.0 / (settings.rate * max(settings.context, 1e-9)) - 1e-9)))
        if settings.context <= 0.0:
            self.windows_a_step = 1
        self.hop = 1.0 / (settings.rate * self.windows_a_step)
        self.reach = int(np.floor(settings.context / self.hop + 1e-9))
        self.offsets = np.arange(-self.reach, self.reach + 1) * self.hop
        self.ahead = int(np.floor(settings.lookahead * settings.rate + 1e-9))  # decisions
        self.gate = Gate(1.0 / self.hop)
        self.spacing = max(1, round(SPACING_S / self.hop))  # windows between those by which channels are tested
        self.examined = -math.inf  # the last of these
        self.hum = Hum(self.band, array.sample_rate, self.hop)
        in_room = self.half.in_room if self.half else None
        self.steady = SteadySources(self.correlator, response, self.hop, in_room)
        kept = float(np.exp(-1.0 / (settings.rate * self.law.memory)))
        self.memory = Memory(settings.rate, settings.max_speed, kept)
        self.told_unsettled = self.told_contradicted = False
        self.windows = self.silent = 0  # so far, and those of them without a voice
        self.named = {(fault.channel, fault.kind) for fault in self.health.faults}

    @property
    def compact(self) -> bool:
        """Whether the array is too small for ranges, so that directions are told."""
        return isinstance(self.finder, DirectionFinder)

    @property
    def latency(self) -> float:
        """How long after the sound left the mouth its decision can be made, s."""
        windows = self.delay + 0.5 * self.band.size / self.array.sample_rate + self.reach * self.hop
        return windows + self.ahead / self.settings.rate

    def localize(self, blocks: Iterable[Block], begin: int = 0) -> Iterator[Decision]:
        """Yield a decision for every time step of a stream, as soon as all is heard that it rests on.

        Args:
            blocks: the stream, piece by piece. Time steps are skipped where a block says that others wait behind it.
            begin: the first sample's place on the clock, in samples.
        """
        for first, stretch in stretches(blocks, begin):
            yield from self._stretch(stretch, first)
            self.steady.forget()
            self.hum.forget()
            self.memory.forget()  # a talker of one stretch is not expected in the next

    def _stretch(self, blocks: Iterable[Block], begin: int) -> Iterator[Decision]:
        """Yield a decision for every time step of a stream without long gaps."""
        fs, rate = self.array.sample_rate, self.settings.rate
        stream, self.examined = LatestSamples(begin, len(self.array.microphones)), -math.inf
        windows: dict[int, Window] = {}
        waiting = deque[Moment]()
        step, tail, skipped = time_steps(begin, 1, fs, rate, 0.0).start, 0.0, 0
        for block in itertools.chain(blocks, [None]):
            if block is not None:
                stream.append(block.samples)
                tail = block.tail
            last = time_steps(begin, stream.end - begin, fs, rate, tail).stop
            behind = block is not None and block.waiting >= 1.0 / rate
            while step < last and behind and self._skip(stream, step):
                step, skipped = step + 1, skipped + 1
            while step < last and not behind and self._cut(stream, windows, step, ended=block is None):
                moment = self.step(step, windows)
                waiting.append(replace(moment, decision=replace(moment.decision, skipped=skipped)))
                step, skipped = step + 1, 0
                while waiting and waiting[0].step + self.ahead < step:
                    yield self.decided(waiting.popleft(), waiting)
        while waiting:
            yield self.decided(waiting.popleft(), waiting)

    def decided(self, moment: Moment, later: Sequence[Moment]) -> Decision:
        """Return the decision about a moment, given those after it."""
        if moment.found is None or moment.now is None:
            return moment.decision
        known = [one.found for one in later if one.step <= moment.step + self.ahead]
        talkers = self.finder.talkers_of(moment.found, known)
        features = self.voices.features(moment.now, moment.out, talkers)
        if self.half:
            talkers, features = self.half.told(talkers, features)
        return moment.decision.with_talkers(talkers, features)

    def _skip(self, stream: LatestSamples, step: int) -> bool:
        """Pass over a time step if its last window is complete; tell whether it is."""
        if self._place(step * self.windows_a_step + self.reach) + self.band.size > stream.end:
            return False
        stream.forget(self._place((step + 1) * self.windows_a_step - self.reach))
        self.memory.keep([])
        return True

    def _cut(self, stream: LatestSamples, windows: dict[int, Window], step: int, *, ended: bool) -> bool:
        """Cut the windows that a step still lacks out of the stream; tell whether it has them all."""
        middle, size = step * self.windows_a_step, self.band.size
        for index in [index for index in windows if index < middle - self.reach]:
            del windows[index]
        for index in range(next(reversed(windows), middle - self.reach - 1) + 1, middle + self.reach + 1):
            if self._place(index) + size > stream.end and not ended:
                return False
            window = self.heard(*stream.window(self._place(index), size))
            if window.correlated:
                if window.correlated.part > WHOLE:
                    self.hum.take(window.correlated.whole, window.correlated.alike)
                self.steady.take(window.correlated, self.noise_apart)
            windows[index] = self.sounding(window)
            stream.forget(self._place(index + 1))
        return True

    def _place(self, index: int) -> int:
        """Return the first sample of a window on the clock."""
        return round((index * self.hop + self.delay) * self.array.sample_rate) - self.band.size // 2

    def heard(self, samples: np.ndarray, taper: np.ndarray) -> Window:
        """Return what a window of samples (m, size) under a taper (size,) holds, its channels put right."""
        return self.correlator.correlate(samples, taper, self.health.order, self.health.turn, self.hum.bins)

    def sounding(self, window: Window) -> Window:
        """Return the window, empty where it holds no more than the room's noise or a mere tone."""
        self.windows += 1
        now = window.correlated
        heard = self.gate(now.energy if now else 0.0)
        # The taper of a part of a window spreads steady tones over all bins.
        told = now is not None and (self.hum.bins is None or now.part > WHOLE)
        if heard and told and now and now.occupancy >= self.settings.occupancy:
            return window
        self.silent += 1
        return Window(None, window.notices)

    def step(self, step: int, windows: dict[int, Window]) -> Moment:
        """Find what one time step holds, from the windows around it, by their numbers."""
        middle = step * self.windows_a_step
        around = [windows[middle + i].correlated for i in range(-self.reach, self.reach + 1)]
        time, notices = step / self.settings.rate, list(windows[middle].notices)
        found = None
        now, out = around[self.reach], self.health.out
        if now is None:
            self.memory.keep([])
        else:
            sounding = [
                (window, offset + window.centre)
                for window, offset in zip(around, self.offsets.tolist(), strict=True)
                if window is not None
            ]
            heard = together(sounding, out)
            if heard is None:
                self.memory.keep([])
                if self.health.usable < 4:
                    notices.append("fewer than four channels are left: nobody can be located")
            else:
                if len(self.steady.places):
                    heard = self.steady.beside(heard)
                found = self.finder.decide(time, heard, self.noise(heard.count), self.memory)
                if self.finder.outside:
                    notices.append("a source is on the edge of the room or outside it")
            if middle - self.examined >= self.spacing:
                self.examined = middle
                apart = around[self.reach % self.spacing :: self.spacing]
                self.health.examine(now, [window for window in apart if window], self.noise_apart(1).deviation)
            notices += (
                self.hum.news() + self._news() + self.steady.news([trace.position for trace in self.memory.known()])
            )
            if self.health.unsettled and not self.told_unsettled:
                notices.append(UNSETTLED.format(self.health.unsettled))
                self.told_unsettled = True
            if self.health.contradicted and not self.told_contradicted:
                notices.append(CONTRADICTED)
                self.told_contradicted = True
        decision = Decision.of(time, notices=notices, faults=self.health.faults, steady=self.steady.told)
        return Moment(step, found, now, out, decision)

    def _news(self) -> list[str]:
        """Return a sentence about each fault of a channel that has not been named yet."""
        new = [fault for fault in self.health.faults if (fault.channel, fault.kind) not in self.named]
        self.named |= {(fault.channel, fault.kind) for fault in new}
        return [str(fault) for fault in new]

    def noise(self, windows: float) -> NoiseLaw:
        """Return what white noise, independent in each channel, does to the response of so many windows."""
        return self._noise.of(windows)

    def noise_apart(self, windows: float) -> NoiseLaw:
        """Return the same of windows that lie `SPACING_S` apart and so share little of their noise."""
        return self._noise_apart.of(windows)

    @cached_property
    def _noise(self) -> NoiseLaw:
        return self._drawn(self.hop, self.reach)

    @cached_property
    def _noise_apart(self) -> NoiseLaw:
        return self._noise if self.spacing == 1 else self._drawn(self.spacing * self.hop, self.reach // self.spacing)

    def _drawn(self, hop: float, reach: int) -> NoiseLaw:
        samples = round(hop * self.array.sample_rate)
        return draw_noise_law(self.correlator, self.finder.response, samples, 2 * reach + 1, self.rng)
