"""Fit what tells voices apart, judge it on other talkers, and write it to avcli/localization/voice.json.

    make fit-voice FIT_FLAGS="--speech DIR --other DIR"                # fit and judge: some minutes
    make fit-voice FIT_FLAGS="--speech DIR --other DIR --judge"        # judge alone what the file holds

A folder holds recordings, one talker a folder in it, or all in one with the talker's name up to the first "-". Each
talker speaks in several rooms of T60 0.2 to 0.65 s with noise 12 to 35 dB below, every third time together with another
talker, from a place that is known to 1.5 cm, one time in six to 7 cm. Each time the voice passes a smooth filter of its
own, which stands for the turn of the head and for microphones that are not flat. Rooms are simulated with avcli's image
sources. The file of the kind beside avcli/formats/features states how components vary over people and within one.

The shipped numbers were fitted to LibriSpeech train-clean-100 (CC BY 4.0), as in the repository
resemble-ai/Resemblyzer, audio_data, and judged on its test-other there, on VCTK (CC BY 4.0) as in
auspicious3000/autovc, wavs, on CMU ARCTIC and on avsim-audio's own voices.
"""

import argparse
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
import numpy as np  # noqa: E402
from localization_scenes import ring  # noqa: E402
from scipy.linalg import eigh, null_space  # noqa: E402
from scipy.optimize import minimize  # noqa: E402

import avcli  # noqa: E402
from avcli.acoustics.absorption import sabine_absorption  # noqa: E402
from avcli.acoustics.images import shoebox_rir  # noqa: E402
from avcli.acoustics.recorder import built_in_voices  # noqa: E402
from avcli.acoustics.signals import resample  # noqa: E402
from avcli.formats.media import read_audio  # noqa: E402
from avcli.localization import correlation, voice  # noqa: E402
from avcli.localization.array import Array  # noqa: E402
from avcli.localization.settings import SteeredSettings  # noqa: E402
from avcli.localization.windows import Band  # noqa: E402
from avcli.numeric import SPEED_OF_SOUND_M_S  # noqa: E402

FITTED = ROOT / "avcli" / "localization" / "voice.json"
KNOWN = ROOT / "avcli" / "formats" / "features" / f"{voice.KIND}.json"
FS, PORTION_S, STEP_S, MOST_PORTIONS = 16000, 4.0, 0.1, 6
SEEDS = {"fit": 100, "judge": 101}
NUMBERS = (1, 3, 10, 20)
"""looks at each of two portions, from which it is judged whether they are of one talker."""
COMPONENTS = 8
"""in a vector, with the pitch: more tell no more on talkers that were not fitted to."""
LASTING_S = 5.0
"""s for which somebody who walks and turns sounds alike in a room; assumed."""
LOOKS = 10.0
"""looks after which the components shall tell people apart best."""
STRAY = 0.02
"""share of looks that say nothing, as a pitch an octave off; whoever uses looks must expect them."""
OUTLIER = 3.0
"""standard deviations, beyond which an error counts as one of so many: a pitch an octave off is no pitch at all."""


# --- voices in rooms --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Looks:
    """What was measured, n looks.

    Attributes:
        talker, portion: (n,) int, whose voice, and in which of his portions.
        time: (n,) s in the portion.
        beside: (n,) bool, whether another talked in the same room.
        raw, terms: (n, 1 + BANDS), (n, 3): see voice.raw and voice.terms.
        pitch_error: (n,) of ln(pitch), against the voice before it was in the room.
    """

    talker: np.ndarray
    portion: np.ndarray
    time: np.ndarray
    beside: np.ndarray
    raw: np.ndarray
    terms: np.ndarray
    pitch_error: np.ndarray

    def take(self, chosen: np.ndarray) -> "Looks":
        return Looks(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def talkers(folder: Path) -> dict[str, list[np.ndarray]]:
    """Return the portions of each talker's recordings, (n,) at FS and of one level each."""
    spoken: dict[str, list[np.ndarray]] = {}
    for path in sorted(path for path in folder.rglob("*") if path.suffix in (".flac", ".wav")):
        name = path.stem.split("-")[0] if path.parent == folder else path.parent.name
        samples, rate = read_audio(path)
        spoken.setdefault(name, []).append(resample(samples.mean(axis=1), rate, FS))
    return {name: cut for name, recordings in spoken.items() if len(cut := portions(recordings)) > 1}


def portions(recordings: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Cut recordings, one after another, into portions that do not overlap."""
    whole, size = np.concatenate(recordings), round(PORTION_S * FS)
    cut = [whole[i * size : (i + 1) * size] for i in range(min(len(whole) // size, MOST_PORTIONS))]
    return [0.05 * one / np.sqrt(np.mean(one**2)) for one in cut if one.any()]


def measured(spoken: Mapping[str, list[np.ndarray]], seed: int) -> Looks:
    """Return the looks at every portion of every talker."""
    rows: list[tuple[Any, ...]] = []
    voices = list(spoken.values())
    for number, cut in enumerate(voices):
        for index in range(len(cut)):
            rng = np.random.default_rng([seed, number, index])
            together = [cut[index]]
            if index % 3 == 2:
                another = voices[(number + 1 + int(rng.integers(len(voices) - 1))) % len(voices)]
                together.append(another[int(rng.integers(len(another)))])
            for time, heard, error in in_a_room(together, rng):
                rows.append((number, index, time, len(together) > 1, voice.raw(heard)[0], voice.terms(heard)[0], error))
    return Looks(*(np.array(column) for column in zip(*rows, strict=True)))


def in_a_room(together: list[np.ndarray], rng: np.random.Generator) -> Iterator[tuple[float, voice.Heard, float]]:
    """Yield each time in s at which the first of some voices sounds, what is heard of it, and its pitch's error."""
    room = np.array([rng.uniform(4.0, 8.0), rng.uniform(4.0, 6.5), rng.uniform(2.5, 3.2)])
    microphones = ring(room[:2].tolist(), 8, room[2] - rng.uniform(0.2, 0.5))
    microphones[7, :2] = room[:2] / 2.0
    rt60, noise_db = rng.uniform(0.2, 0.65), rng.uniform(12.0, 35.0)
    reflection = np.sqrt(1.0 - sabine_absorption(room, rt60))
    places: list[np.ndarray] = []
    dry: list[np.ndarray] = []
    wet = np.zeros((8, len(together[0])))
    for spoken in together:
        place = np.array([*rng.uniform(0.5, room[:2] - 0.5), rng.uniform(1.1, 1.75)])
        while any(np.hypot(*(place - other)[:2]) < 0.8 for other in places):
            place[:2] = rng.uniform(0.5, room[:2] - 0.5)
        places.append(place)
        dry.append(10.0 ** (rng.normal(0.0, 0.1)) * filtered(spoken, rng))
        response = shoebox_rir(room, place, microphones, reflection, FS, round(0.75 * rt60 * FS), error_db=-25.0)
        wet += _convolved(dry[-1], response)
    wet += np.sqrt(np.mean(wet**2)) * 10.0 ** (-noise_db / 20.0) * rng.standard_normal(wet.shape)
    array = Array(microphones, FS, room)
    yield from looked(wet, dry, np.array(places), voice.VoiceMeter(array, Band.of(SteeredSettings(), FS)), rng)


def looked(
    wet: np.ndarray, dry: list[np.ndarray], places: np.ndarray, meter: voice.VoiceMeter, rng: np.random.Generator
) -> Iterator[tuple[float, voice.Heard, float]]:
    """Yield as `in_a_room` does, of what microphones heard (m, n) of voices (n,) at places (k, 3) m."""
    band = Band.of(SteeredSettings(), FS)
    taper, loud = correlation.hann(band.size), [0.1 * np.sqrt(np.mean(one**2)) for one in dry]
    middle = meter.array.room * [0.5, 0.5, 0.0] + [0.0, 0.0, 1.4]
    delay = round(FS * np.linalg.norm(meter.array.microphones - middle, axis=1).mean() / SPEED_OF_SOUND_M_S)
    for begin in range(0, wet.shape[1] - band.size - delay, round(STEP_S * FS)):
        tapered = [one[begin : begin + band.size] * taper for one in dry]
        sounding = [np.std(one) > least for one, least in zip(tapered, loud, strict=True)]
        if not sounding[0]:
            continue
        spectra = np.fft.rfft(wet[:, begin + delay :][:, : band.size] * taper, axis=1)[:, band.bins]
        off = 0.07 if rng.random() < 1.0 / 6.0 else 0.015
        there = places[sounding] + rng.normal(0.0, off, (sum(sounding), 3))
        heard = meter.hear(spectra, meter.array.microphones, there)
        alone = np.abs(np.fft.rfft(tapered[0])[band.bins][meter.voiced]) ** 2
        true = float(meter.pitched(alone[None])[0][0])
        yield begin / FS, heard, float(np.log(heard.pitch[0] / true))


def filtered(spoken: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a voice (n,) through a smooth random filter, which stands for a turned head and another microphone."""
    spectrum = np.fft.rfft(spoken)
    place = np.log1p(np.arange(len(spectrum)) * FS / len(spoken) / 500.0) / np.log1p(0.5 * FS / 500.0)
    gain_db = sum(rng.normal(0.0, 3.0 / k) * np.cos(np.pi * k * place) for k in (1, 2, 3))
    return np.fft.irfft(spectrum * 10.0 ** (gain_db / 20.0), len(spoken))


def _convolved(dry: np.ndarray, response: np.ndarray) -> np.ndarray:
    size = 1 << int(np.ceil(np.log2(len(dry) + response.shape[1])))
    return np.fft.irfft(np.fft.rfft(dry, size) * np.fft.rfft(response, size), size)[:, : len(dry)]


# --- fits -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Moments:
    """How looks vary: mean (d,), between people, between one person's portions, within a portion, (d, d) each."""

    mean: np.ndarray
    between: np.ndarray
    portions: np.ndarray
    within: np.ndarray


def moments(looks: Looks, values: np.ndarray, least: int = 5) -> Moments:
    """Return the moments of values (n, d) of looks, from the portions with so many looks at least.

    People vary by what the portions of one have in common: another room and another filter are not part of it.
    """
    means, scatters, weights = [], [], []
    for talker in np.unique(looks.talker):
        own = looks.talker == talker
        cut = [values[own & (looks.portion == index)] for index in np.unique(looks.portion[own])]
        cut = [one for one in cut if len(one) >= least]
        if len(cut) > 1:
            means.append([one.mean(axis=0) for one in cut])
            scatters += [np.cov(one.T) for one in cut]
            weights += [1.0 / len(one) for one in cut]
    mean = np.mean([np.mean(one, axis=0) for one in means], axis=0)
    within = np.mean(scatters, axis=0)
    apart = [np.cov(np.array(one).T) for one in means]
    whole = np.cov(np.array([np.mean(one, axis=0) for one in means]).T)
    between = whole - np.mean([one / len(own) for one, own in zip(apart, means, strict=True)], axis=0)
    lasting = np.mean(apart, axis=0) - within * np.mean(weights)
    return Moments(mean, between, _not_negative(lasting), within)


def _not_negative(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def projection(found: Moments) -> np.ndarray:
    """Return the projection (1 + BANDS, COMPONENTS): the pitch itself, and what tells people apart best beside it.

    The other components are uncorrelated with the pitch, over people and within one, and with each other. After so
    many LOOKS they tell most; one look at each has a variance of one.
    """
    errors = found.within / LOOKS + found.portions
    size = len(found.mean)
    slopes = np.array([one[0] / one[0, 0] for one in (found.between, errors)])
    slopes[:, 0] = 1.0
    free = null_space(slopes)  # combinations of all values, whose covariances with the pitch are 0 in both
    parts = [free.T @ one @ free for one in (found.between, errors, found.within + found.portions)]
    ratios, directions = eigh(parts[0], parts[1] + 1e-3 * np.trace(parts[1]) / size * np.eye(len(parts[1])))
    best = directions[:, np.argsort(-ratios)[: COMPONENTS - 1]]
    best = free @ (best / np.sqrt(np.einsum("ij,ik,kj->j", best, parts[2], best)))
    best *= np.sign(best[np.abs(best).argmax(axis=0), np.arange(best.shape[1])])
    return np.column_stack([np.eye(size)[0], best])


def clear(looks: Looks, law: voice.Law) -> np.ndarray:
    """Tell which looks (n,) have a pitch that is clear enough to be reported."""
    prominence, others = looks.terms[:, 1], np.expm1(looks.terms[:, 2])
    return prominence >= np.where(others > voice.ALONE, law.voiced_beside, law.voiced)


def own_means(looks: Looks, values: np.ndarray) -> np.ndarray:
    """Return for each look the mean (n, d) of its talker's portions."""
    means = np.empty_like(values)
    for talker in np.unique(looks.talker):
        own = looks.talker == talker
        cut = [values[own & (looks.portion == index)].mean(axis=0) for index in np.unique(looks.portion[own])]
        means[own] = np.mean(cut, axis=0)
    return means


def fit_spread(looks: Looks, values: np.ndarray) -> np.ndarray:
    """Return the spread (2, 3) of a law: of the pitch (column 0 of values) and of the others."""
    errors = values - own_means(looks, values)
    spread = []
    for part in (errors[:, :1], errors[:, 1:]):
        bound = OUTLIER * 1.4826 * np.median(np.abs(part), axis=0)
        squared = (np.clip(part, -bound, bound) ** 2).mean(axis=1)

        def cost(weights: np.ndarray, squared: np.ndarray = squared) -> float:
            logarithm = looks.terms @ weights
            return float(np.mean(logarithm + squared * np.exp(-logarithm)))

        start = [float(np.log(squared.mean())), 0.0, 0.0]
        bounds = [(-np.inf, np.inf), (-np.inf, 0.0), (0.0, np.inf)]  # a clearer pitch, or fewer others, widens nothing
        spread.append(least(cost, start, bounds))
    return np.array(spread).round(4)


def least(cost: Callable[[np.ndarray], float], start: list[float], bounds: list[tuple[float, float]]) -> np.ndarray:
    """Return the values within bounds at which a cost is least."""
    return np.array(minimize(cost, np.array(start), bounds=bounds, method="L-BFGS-B").x)


def fit_correlation(looks: Looks, errors: np.ndarray) -> dict[str, float]:
    """Return how errors (n, d) of unit variance correlate: what is fitted, and one time and share that stand for it.

    Errors last in two ways. What is said lasts for a part of a second: its correlation follows from the differences
    between looks at a lag. The room at a place, and the turn of the head, last for LASTING_S: their share follows from
    how the means of one talker's portions differ. The kind has one time and one share; they are those that give the
    mean of all looks in 0.1 to 30 s about the variance that both together give it.
    """
    lags = np.arange(1, round(0.5 * PORTION_S / STEP_S)) * STEP_S
    sums, counts = np.zeros(len(lags)), np.zeros(len(lags))
    for _, _, chosen in portions_of(looks):
        apart = np.abs(looks.time[chosen][:, None] - looks.time[chosen])
        half = 0.5 * ((errors[chosen][:, None] - errors[chosen]) ** 2).mean(axis=2)
        for k, lag in enumerate(lags):
            near = np.abs(apart - lag) < 0.5 * STEP_S
            sums[k] += half[near].sum()
            counts[k] += near.sum()
    found = sums / counts
    sill = float(np.average(found[lags > 1.0], weights=counts[lags > 1.0]))
    shared = 1.0 - found / sill
    said, time = least(
        lambda x: float(counts @ (shared - x[0] * np.exp(-lags / x[1])) ** 2), [0.5, 0.2], [(0.0, 1.0), (0.05, 1.0)]
    )
    scattered, expected = [], []
    for talker in np.unique(looks.talker):
        own = [(errors[c].mean(axis=0), looks.time[c]) for t, _, c in portions_of(looks) if t == talker and len(c) >= 5]
        if len(own) > 1:
            scattered.append(np.var([mean for mean, _ in own], axis=0, ddof=1).mean())
            expected.append(np.mean([sill * _variance_of_mean(at, said, time) for _, at in own]))
    lasting = max(float(np.mean(scattered) - np.mean(expected)), 0.0)
    spans = np.array([0.1, 0.3, 1.0, 3.0, 10.0, 30.0])
    steps = [np.arange(0.0, span - 0.05, STEP_S) for span in spans]
    lasts = np.array([lasting * _variance_of_mean(at, 1.0, LASTING_S) for at in steps])
    wanted = (np.array([sill * _variance_of_mean(at, said, time) for at in steps]) + lasts) / (sill + lasting)
    share, whole = least(
        lambda x: float(np.sum(np.log([_variance_of_mean(at, x[0], x[1]) for at in steps] / wanted) ** 2)),
        [0.4, 1.5],
        [(0.01, 0.99), (0.1, LASTING_S)],
    )
    figures = {"correlation_s": whole, "correlated": share, "said_share": said, "said_s": time, "sill": sill}
    return {name: round(float(value), 3) for name, value in {**figures, "lasting": lasting}.items()}


def _variance_of_mean(times: np.ndarray, share: float, time: float) -> float:
    """Return the variance of the mean of looks (n,) s whose errors of variance 1 have this share that lasts so long."""
    apart = np.abs(times[:, None] - times)
    return float((share * np.exp(-apart / time) + (1.0 - share) * (apart == 0.0)).mean())


def portions_of(looks: Looks) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield each talker and portion, and which looks (k,) are of it."""
    order = np.lexsort((looks.portion, looks.talker))
    key = looks.talker[order] * 1000 + looks.portion[order]
    for chosen in np.split(order, np.flatnonzero(np.diff(key)) + 1):
        yield int(looks.talker[chosen[0]]), int(looks.portion[chosen[0]]), np.sort(chosen)


def normalized_errors(looks: Looks, law: voice.Law) -> np.ndarray:
    """Return the errors (n, COMPONENTS) of looks over their standard deviations, those of outliers cut off."""
    values, sds = voice.measured(looks.raw, looks.terms, law)
    return np.clip((values - own_means(looks, values)) / sds, -OUTLIER, OUTLIER)


def fitted(looks: Looks, law: voice.Law) -> tuple[voice.Law, dict[str, Any], dict[str, float]]:
    """Return the law that fits looks, with the thresholds of `law`; what is known of its kind; how errors last."""
    looks = looks.take(clear(looks, law))
    alone = looks.take(~looks.beside)
    found = moments(alone, alone.raw)
    law = replace(law, mean=found.mean.round(4), projection=projection(found).round(4))
    values, _ = voice.measured(looks.raw, looks.terms, law)
    law = replace(law, spread=fit_spread(looks, values))
    _, sds = voice.measured(looks.raw, looks.terms, law)
    over = moments(looks.take(~looks.beside), values[~looks.beside])
    correlation = fit_correlation(looks, normalized_errors(looks, law))
    mean = np.zeros(COMPONENTS)
    mean[0] = law.mean[0]
    known = {
        "kind": voice.KIND,
        "name": "voice",
        "components": ["ln(pitch in Hz)", *(f"envelope {number}" for number in range(1, COMPONENTS))],
        "mean": mean.tolist(),
        "between": np.maximum(np.diag(over.between), 1e-4).round(4).tolist(),
        "within": (sds**2).mean(axis=0).round(4).tolist(),
        "correlation_s": correlation.pop("correlation_s"),
        "correlated": correlation.pop("correlated"),
    }
    return law, known, correlation


# --- what it is worth -------------------------------------------------------------------------------------------------


def summed(values: np.ndarray, sds: np.ndarray, time: np.ndarray, known: Mapping[str, Any]) -> tuple[np.ndarray, ...]:
    """Return what a few looks say of a person together: values and variances, (d,) each."""
    lag = np.abs(time[:, None] - time)
    share = known["correlated"]
    correlation = share * np.exp(-lag / known["correlation_s"]) + (1.0 - share) * np.eye(len(time))
    weights = np.stack([np.linalg.solve(correlation * np.outer(sd, sd), np.ones(len(time))) for sd in sds.T])
    precision = weights.sum(axis=1)
    return np.einsum("dn,nd->d", weights, values) / precision, 1.0 / precision


def log_ratios(one: np.ndarray, other: np.ndarray, known: Mapping[str, Any]) -> np.ndarray:
    """Return the log of how much likelier two sums (2, ..., d) are of one person than of two, (...).

    Two covariances (Brümmer and de Villiers 2010), of independent components.
    """
    mean, between = np.array(known["mean"]), np.array(known["between"])
    (a, b), (v, w) = (np.array([one[0], other[0]]) - mean), (between + one[1], between + other[1])
    determinant = v * w - between**2
    same = (a**2 * w + b**2 * v - 2.0 * a * b * between) / determinant + np.log(determinant)
    return 0.5 * (a**2 / v + b**2 / w + np.log(v * w) - same).sum(axis=-1)


def judged(looks: Looks, law: voice.Law, known: Mapping[str, Any], number: int, *, beside: bool) -> dict[str, Any]:
    """Return how well so many looks at each of two portions tell whether they are of one talker.

    Args:
        looks: at talkers that were not fitted to.
        law, known: fitted.
        number: looks at each portion.
        beside: whether another talked too in the one portion; in the other the talker is alone.
    """
    looks = looks.take(clear(looks, law))
    values, sds = voice.measured(looks.raw, looks.terms, law)
    told, names, crowded = [], [], []
    for talker, _, chosen in portions_of(looks):
        if len(chosen) >= number:
            chosen = chosen[(len(chosen) - number) // 2 :][:number]
            told.append(summed(values[chosen], sds[chosen], looks.time[chosen], known))
            names.append(talker)
            crowded.append(bool(looks.beside[chosen[0]]))
    pairs = [
        (i, k)
        for i in range(len(names))
        for k in range(len(names))
        if (crowded[i] and not crowded[k] if beside else i < k and not crowded[i] and not crowded[k])
    ]
    one, other = np.array(pairs, int).reshape(-1, 2).T
    same = np.array(names, int)[one] == np.array(names, int)[other]
    figures: dict[str, Any] = {"looks": number, "beside": beside, "pairs": len(pairs), "of_one": int(same.sum())}
    if same.all() or not same.any():
        return figures
    sums = np.array(told).swapaxes(0, 1)
    stray = 1.0 - (1.0 - STRAY) ** (2 * number)
    ratio = np.logaddexp(np.log1p(-stray) + log_ratios(sums[:, one], sums[:, other], known), np.log(stray))
    own, others, rank = np.sort(ratio[same]), np.sort(ratio[~same]), np.sort(ratio)
    misses, alarms = np.searchsorted(own, rank) / len(own), 1.0 - np.searchsorted(others, rank) / len(others)
    cross = int(np.abs(misses - alarms).argmin())
    cost = np.logaddexp(0.0, -own).mean() + np.logaddexp(0.0, others).mean()
    return figures | {
        "auc": round(float((np.searchsorted(others, own) / len(others)).mean()), 3),
        "eer": round(float(misses[cross] + alarms[cross]) / 2.0, 3),
        "cllr_bits": round(float(cost / np.log(4.0)), 3),
        "wrong_by_100": [round(float(part.mean()), 4) for part in (own < -np.log(100.0), others > np.log(100.0))],
    }


def judge(folder: Path | None, law: voice.Law, known: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what the law is worth on the talkers of a folder and avsim-audio's own."""
    spoken = talkers(folder) if folder else {}
    for number, sound in enumerate(built_in_voices()):
        said = resample(sound.samples.mean(axis=1), sound.sample_rate_hz, FS)  # one sentence, again and again
        spoken[f"built in {number}"] = portions([np.pad(said, (0, FS // 7))] * round(12.5 * FS / len(said)))
    looks = measured(spoken, SEEDS["judge"])
    reported = clear(looks, law)
    alone, sure = ~looks.beside, np.abs(looks.pitch_error) < np.log(1.08)
    share: dict[str, dict[str, Any]] = {
        name: {
            "reported": float(reported[part].mean().round(3)),
            "pitch_right": float(sure[part & reported].mean().round(3)),
        }
        for name, part in (("alone", alone), ("beside", ~alone))
    }
    chosen = looks.take(reported)
    squared = normalized_errors(chosen, law) ** 2
    for name, part in (("alone", ~chosen.beside), ("beside", chosen.beside)):
        share[name]["normalized_square_error"] = squared[part].mean(axis=0).round(2).tolist()
    worth = [judged(looks, law, known, number, beside=beside) for beside in (False, True) for number in NUMBERS]
    return [{"talkers": len(spoken), **share}, *worth]


def main() -> None:
    """Fit, judge and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speech", type=Path, help="recordings of the talkers to fit to")
    parser.add_argument("--other", type=Path, help="recordings of the talkers that judge")
    parser.add_argument("--judge", action="store_true", help="judge what the files hold, and write nothing")
    options = parser.parse_args()
    law, known = voice.fitted_law(), json.loads(KNOWN.read_bytes())
    if not options.judge:
        if options.speech is None:
            parser.error("--speech is needed to fit")
        spoken = talkers(options.speech)
        looks = measured(spoken, SEEDS["fit"])
        law, known, lasting = fitted(looks, law)
        heard_in = f"{len(spoken)} talkers of {options.speech.name} in simulated rooms"
        known["fitted_on"] = f"{heard_in}; tests/bench/fit_voice.py"
    worth = judge(options.other, law, known)
    for line in worth:
        print(json.dumps(line))
    if options.judge:
        return
    stated = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in asdict(law).items()}
    fitted_on = {
        "command": "tests/bench/fit_voice.py",
        "version": avcli.__version__,
        "speech": options.speech.name,
        "talkers": len(spoken),
        "looks": int(clear(looks, law).sum()),
        "errors": lasting,
        "judged": worth,
    }
    FITTED.write_text(json.dumps({"law": stated, "fitted_on": fitted_on}) + "\n")
    KNOWN.write_text(json.dumps(known, indent=2) + "\n")


if __name__ == "__main__":
    main()
