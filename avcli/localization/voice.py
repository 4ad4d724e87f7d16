"""What a voice is like: the pitch and the spectral envelope of what comes from where a talker is.

Each decision measures it in its own window alone. What one window says is little (which vowel it holds matters more
than who speaks), but it says how little, so that whoever follows people can add up what many windows say.
"""

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avcli.formats.features import Feature
from avcli.localization.array import Array, Talker
from avcli.localization.windows import Band, Correlated

KIND = "pitch-envelope"
LOWEST, HIGHEST, BANDS = 120.0, 5500.0, 20
"""Hz, and in how many bands, alike in mel, the envelope is taken."""
PITCHES = 65.0 * 2.0 ** (np.arange(101) / 36.0)
"""Hz, the pitches that are tried: two for each semitone and a half, from a low man to a high child."""
VOICED_BELOW = 2500.0
"""Hz; harmonics above are too weak in a room, and too wide where a pitch glides."""
HARMONICS, FADING = 30, 0.85
"""how many harmonics count, and how much of its weight each passes on to the next."""
WINDOWS_S = (0.15, 0.25)
"""s; in shorter windows low voices have no harmonics, and in longer ones a pitch glides."""
NEAREST_M = 0.3
"""m; sound from nearer is no louder."""
WHOLE = 0.9
"""the least part of a window that the stream must hold."""
USUAL = 1.5
"""mean square of an envelope's components, up to which a look is like people's; that of people is about 1.3."""
ALIKE = 0.04
"""difference of ln(pitch) of two talkers, up to which one may be heard in place of the other."""
ALONE = 0.01
"""power of others over a talker's, up to which he counts as alone."""


@dataclass(frozen=True)
class Law:
    """How a voice's vector follows from its pitch and its bands; voice.json holds the fitted one.

    Attributes:
        voiced: least prominence of a pitch that counts, of a lone talker.
        voiced_beside: the same where others sound too.
        mean: (1 + BANDS,) of ln(pitch in Hz) and the logarithms of the bands, over people.
        projection: (1 + BANDS, d) turns deviations from the mean into components that vary independently, over people
            and within one. The first is ln(pitch) itself.
        spread: (2, 3) of the logarithm of a variance: a constant, the weight of the prominence, and the weight of
            ln(1 + power of others over the talker's); of the pitch, and of all other components.
    """

    voiced: float
    voiced_beside: float
    mean: np.ndarray
    projection: np.ndarray
    spread: np.ndarray


@functools.cache
def fitted_law() -> Law:
    """Return the law that voice.json holds."""
    law = json.loads(Path(__file__).with_name("voice.json").read_bytes())["law"]
    mean, projection, spread = (np.array(law[name]) for name in ("mean", "projection", "spread"))
    return Law(law["voiced"], law["voiced_beside"], mean, projection, spread)


@dataclass(frozen=True)
class Heard:
    """What one window holds of each of n talkers.

    Attributes:
        bands: (n, BANDS) power.
        pitch: (n,) Hz, the likeliest.
        prominence: (n,) how far its harmonics stand out of what lies between them, in the root mean square of the
            compressed spectrum.
        others: (n,) power of the other talkers over the talker's.
    """

    bands: np.ndarray
    pitch: np.ndarray
    prominence: np.ndarray
    others: np.ndarray


class VoiceMeter:
    """Measures voices in the windows of one array.

    Args:
        array: the microphones and the room.
        band: of the windows' spectra.
        law: the fitted one by default.

    Attributes:
        able: whether the band and the windows are those that a voice can be told by.
    """

    def __init__(self, array: Array, band: Band, law: Law | None = None):
        self.array, self.law = array, law or fitted_law()
        window = band.size / array.sample_rate
        frequencies = np.arange(band.bins.start, band.bins.stop) / window
        self.able = bool(
            WINDOWS_S[0] <= window <= WINDOWS_S[1] and frequencies[0] <= LOWEST and frequencies[-1] >= HIGHEST
        )
        self.used = slice(0, int(np.searchsorted(frequencies, HIGHEST)))
        self.frequencies = frequencies[self.used]
        self.voiced = slice(0, int(np.searchsorted(frequencies, VOICED_BELOW)))
        self.bands = _mel_bands(self.frequencies)
        self.combs = _combs(frequencies[self.voiced])

    def features(self, window: Correlated, outvoted: np.ndarray, talkers: Sequence[Talker]) -> dict[str, Feature]:
        """Return the voices of the talkers in a decision's window as the feature "voice"; none where none is clear.

        Args:
            window: of the decision.
            outvoted: (m,) bool, the channels that are left out.
            talkers: that the decision reports, n.

        Returns:
            Rows of NaN stand for talkers whose voice has no clear pitch.
        """
        good = window.good & ~outvoted
        if not talkers or not self.able or window.part < WHOLE or good.sum() < len(talkers) + 3:
            return {}
        places = np.array([talker.position for talker in talkers])
        heard = self.hear(window.spectra[good], self.array.microphones[good], places)
        law = self.law
        clear = heard.prominence >= np.where(heard.others > ALONE, law.voiced_beside, law.voiced)
        clear &= ~_leaked(heard)
        if not clear.any():
            return {}
        told = measured(raw(heard), terms(heard), law)
        vectors, sds = (np.where(clear[:, None], numbers, np.nan).round(4) for numbers in told)
        return {"voice": Feature(KIND, vectors, sds)}

    def hear(self, spectra: np.ndarray, microphones: np.ndarray, places: np.ndarray) -> Heard:
        """Take a window apart into what comes from each place.

        The direct sound from each place is estimated by least squares over the channels (a beam at each talker, with
        zeros towards the others). It tells which pitch and what share of each frequency is whose; the power itself is
        that of all channels, which the room's echoes colour less than they do one beam.

        Args:
            spectra: (m, bins) complex.
            microphones: (m, 3) m.
            places: (n, 3) m, n < m.
        """
        spectra = spectra[:, self.used]
        ranges = np.maximum(np.linalg.norm(microphones[:, None] - places, axis=2), NEAREST_M)
        level = (spectra.real**2 + spectra.imag**2).sum(axis=0) / (ranges**-2).sum(axis=0).mean()
        beams = self.beams(spectra, ranges)
        whole = np.maximum(beams.sum(axis=0), 1e-30)
        share = beams / whole
        bands = (share * level) @ self.bands.T
        total = bands.sum(axis=1)
        pitch, prominence = self.pitched((share * beams)[:, self.voiced])
        return Heard(bands, pitch, prominence, (total.sum() - total) / np.maximum(total, 1e-30))

    def beams(self, spectra: np.ndarray, ranges: np.ndarray) -> np.ndarray:
        """Return the power of the direct sound from each place, (n, bins), by its ranges (m, n) m."""
        turn = 2j * np.pi * self.frequencies / self.array.speed_of_sound
        steering = (np.exp(-turn * ranges[:, :, None]) / ranges[:, :, None]).astype(np.complex64)
        sums = np.einsum("mnb,mb->bn", steering.conj(), spectra)
        norm = float((ranges**-2).sum() / ranges.shape[1])
        if ranges.shape[1] == 1:
            direct = sums / norm
        else:
            gram = np.einsum("mib,mjb->bij", steering.conj(), steering) + 1e-3 * norm * np.eye(ranges.shape[1])
            direct = np.linalg.solve(gram, sums[:, :, None])[:, :, 0]
        return (direct.real**2 + direct.imag**2).T.astype(np.float64)

    def pitched(self, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pitch (n,) Hz of power spectra (n, bins), and how far it stands out (n,).

        The harmonics of a pitch are summed as by Hermes (1988), less what lies halfway between them, which an octave
        too low would take for harmonics too.
        """
        compressed = power**0.25
        compressed /= np.maximum(np.sqrt((compressed**2).mean(axis=1, keepdims=True)), 1e-30)
        scores = compressed @ self.combs.T
        best = np.clip(scores.argmax(axis=1), 1, len(PITCHES) - 2)
        rows = np.arange(len(power))
        before, at, after = scores[rows, best - 1], scores[rows, best], scores[rows, best + 1]
        curvature = before - 2.0 * at + after
        shift = np.where(curvature < 0.0, 0.5 * (before - after) / np.where(curvature < 0.0, curvature, 1.0), 0.0)
        return PITCHES[best] * 2.0 ** (np.clip(shift, -0.5, 0.5) / 36.0), scores.max(axis=1)


def raw(heard: Heard) -> np.ndarray:
    """Return ln(pitch in Hz) and the logarithms of the bands over their geometric mean, (n, 1 + BANDS)."""
    bands = np.log(np.maximum(heard.bands, 1e-9 * heard.bands.max(axis=1, keepdims=True) + 1e-300))
    return np.column_stack([np.log(heard.pitch), bands - bands.mean(axis=1, keepdims=True)])


def terms(heard: Heard) -> np.ndarray:
    """Return what the weights of a law's `spread` are multiplied by, (n, 3)."""
    return np.column_stack([np.ones(len(heard.pitch)), heard.prominence, np.log1p(heard.others)])


def measured(raw: np.ndarray, terms: np.ndarray, law: Law) -> tuple[np.ndarray, np.ndarray]:
    """Return the vectors and the standard deviations (n, d) of looks.

    A look whose envelope is farther from the mean than people's usually are is the less certain: of voices unlike those
    that were fitted to, and of sounds that are no voices, little is known.

    Args:
        raw, terms: (n, 1 + BANDS), (n, 3), see the functions of these names.
        law: the fitted one.
    """
    vectors = (raw - law.mean) @ law.projection
    variances = np.exp(terms @ law.spread.T)[:, [0] + [1] * (vectors.shape[1] - 1)]
    variances[:, 1:] *= np.maximum((vectors[:, 1:] ** 2).mean(axis=1, keepdims=True) / USUAL, 1.0)
    vectors[:, 0] += law.mean[0]
    return vectors, np.sqrt(variances)


def _leaked(heard: Heard) -> np.ndarray:
    """Tell which talkers (n,) have the pitch of a louder one: what is heard of them may be the louder one's echo."""
    pitch, power = np.log(heard.pitch), heard.bands.sum(axis=1)
    alike = np.abs(pitch[:, None] - pitch) < ALIKE
    return (alike & (power[:, None] < power)).any(axis=1)


def _mel_bands(frequencies: np.ndarray) -> np.ndarray:
    """Return the weights (BANDS, bins) of triangular bands that are alike in mel (O'Shaughnessy 1987)."""
    lowest, highest = 2595.0 * np.log10(1.0 + np.array([LOWEST, HIGHEST]) / 700.0)
    mel = np.linspace(lowest, highest, BANDS + 2)
    edges = 700.0 * (10.0 ** (mel / 2595.0) - 1.0)
    low, middle, high = edges[:-2, None], edges[1:-1, None], edges[2:, None]
    return np.maximum(np.minimum((frequencies - low) / (middle - low), (high - frequencies) / (high - middle)), 0.0)


def _combs(frequencies: np.ndarray) -> np.ndarray:
    """Return the weights (pitches, bins) of each pitch's harmonics, and of the middles between them."""
    step = frequencies[1] - frequencies[0]
    combs = np.zeros((len(PITCHES), len(frequencies)))
    for comb, pitch in zip(combs, PITCHES, strict=True):
        numbers = np.arange(1, min(HARMONICS, int(VOICED_BELOW / pitch)) + 1)
        weights = FADING ** (numbers - 1.0)
        for offset, sign in ((0.0, 1.0), (-0.5, -0.5), (0.5, -0.5)):
            places = ((numbers + offset) * pitch - frequencies[0]) / step
            below = np.floor(places).astype(int)
            inside = (below >= 0) & (below < len(frequencies) - 1)
            part, left = places[inside] - below[inside], below[inside]
            np.add.at(comb, left, sign * weights[inside] * (1.0 - part))
            np.add.at(comb, left + 1, sign * weights[inside] * part)
        comb /= np.sqrt(weights.sum())  # the more harmonics, the more their mean counts: a third of a pitch is none
    return combs
