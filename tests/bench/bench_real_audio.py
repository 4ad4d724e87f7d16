"""avdetect-audio on measured rooms, beside pyroomacoustics on the same sound.

    make setup-bench bench-real-audio BENCH_FLAGS="--data DIR"     # real-audio.md in bench-out/

DIR holds the published sets as folders of the names that real_audio_sets.py lists with their addresses; nothing of them
is part of the project. Real speech (CMU ARCTIC axb to judge, aew where settings were decided) from ../shared/data or
AVCLI_SHARED_DATA is convolved with the measured responses, with white noise 25 dB below it in each channel.
"""

import argparse
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
if importlib.util.find_spec("pyroomacoustics") is None:
    bench = ROOT / ".venv-bench" / "bin" / "python"
    if not bench.exists():
        sys.exit("bench-real-audio: needs pyroomacoustics; make setup-bench installs it")
    os.execv(bench, [str(bench), *sys.argv])

import numpy as np  # noqa: E402
import pyroomacoustics  # noqa: E402
import soundfile  # noqa: E402
from real_audio_sets import LINE, SETS, Measured  # noqa: E402
from scipy.signal import fftconvolve, resample_poly  # noqa: E402

from avcli.localization.array import Array, Decision  # noqa: E402
from avcli.localization.settings import SteeredSettings  # noqa: E402
from avcli.localization.steered import SteeredLocalizer  # noqa: E402
from avcli.localization.stream import Block  # noqa: E402

SPEED, SECONDS, NOISE_DB, FRAME_S, EVERY_S = 343.0, 4.0, 25.0, 0.386, 0.3
SPEAKERS = {"decide": "aew", "judge": "axb"}
RIGHT_DEG, RIGHT_M = 10.0, 0.5
PEERS: dict[str, Callable[..., pyroomacoustics.doa.DOA]] = {
    "SRP-PHAT": pyroomacoustics.doa.SRP,
    "MUSIC": pyroomacoustics.doa.MUSIC,
    "NormMUSIC": pyroomacoustics.doa.NormMUSIC,
}
NFFT, PEER_BAND_HZ = 1024, (300.0, 6000.0)


@dataclass
class Tally:
    """What one array found in the frames in which somebody speaks.

    Attributes:
        frames: how many there were.
        azimuths: method -> errors in degrees, one of the likeliest talker in each frame.
        inside: whether the true direction is within 1.96 standard deviations.
        places: errors in m, in x and y.
        ellipses: whether the true place is in the 95 % ellipse.
        widths: of these of lines, the standard deviation along the longer axis, m.
        scores, right: of every detection.
        further: how many detections there were beside the first.
    """

    frames: int = 0
    azimuths: dict[str, list[float]] = field(default_factory=dict)
    inside: list[bool] = field(default_factory=list)
    places: list[float] = field(default_factory=list)
    ellipses: list[bool] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    further: int = 0


def heard(
    case: Measured, number: int, rng: np.random.Generator, below_db: float = NOISE_DB
) -> tuple[np.ndarray, np.ndarray]:
    """Return what the microphones hear of a sentence, (n, m), and the times in s at which it sounds."""
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    paths = sorted(folder.glob(f"*_{SPEAKERS[case.split]}_*.wav"))
    if not paths:
        sys.exit("bench-real-audio: needs CMU ARCTIC's sentences of aew and axb (AVCLI_SHARED_DATA/speech)")
    speech, rate = soundfile.read(paths[number % len(paths)])
    shared = np.gcd(rate, case.sample_rate)
    dry = resample_poly(speech, case.sample_rate // shared, rate // shared)[: int(SECONDS * case.sample_rate)]
    dry = np.concatenate([np.zeros(case.sample_rate // 4), dry])
    samples = np.stack([fftconvolve(dry, one)[: len(dry)] for one in case.responses], axis=1)
    samples += np.sqrt(np.mean(samples**2)) * 10.0 ** (-below_db / 20.0) * rng.standard_normal(samples.shape)
    size = case.sample_rate // 50
    energy = np.mean(dry[: len(dry) // size * size].reshape(-1, size) ** 2, axis=1)
    return samples, (np.flatnonzero(energy > energy.max() * 10.0**-2.5) + 0.5) / 50.0


def delay(case: Measured) -> float:
    """Return by how many s the responses are later than sound: recorders start before the loudspeaker."""
    ranges = np.linalg.norm(case.source - case.microphones, axis=1)
    loud = np.abs(case.responses) > 0.25 * np.abs(case.responses).max(axis=1, keepdims=True)
    return float(np.median(loud.argmax(axis=1) / case.sample_rate - ranges / SPEED))


def azimuth_error(direction: np.ndarray, true: np.ndarray) -> float:
    """Return the angle in degrees between two directions on the floor."""
    turn = np.arctan2(direction[1], direction[0]) - np.arctan2(true[1], true[0])
    return float(np.degrees(abs(np.angle(np.exp(1j * turn)))))


@dataclass
class Both:
    """What was found in the frames in which two loudspeakers speak.

    Attributes:
        frames: how many there were.
        found, told: method -> how many of the loudspeakers were found, and how many were told.
        scores, right: of every detection.
    """

    frames: int = 0
    found: dict[str, int] = field(default_factory=dict)
    told: dict[str, int] = field(default_factory=dict)
    scores: list[float] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)

    def note(self, method: str, errors: np.ndarray) -> np.ndarray:
        """Note the errors (k, 2) in degrees, or in shares of what is right, of k directions; return which are right.

        Each loudspeaker is found once.
        """
        right = np.zeros(len(errors), bool)
        for number in np.argsort(errors.min(axis=1)) if len(errors) else []:
            nearest = int(errors[number].argmin())
            right[number] = errors[number, nearest] < RIGHT_DEG and nearest not in errors[right].argmin(axis=1)
        self.found[method] = self.found.get(method, 0) + int(right.sum())
        self.told[method] = self.told.get(method, 0) + len(errors)
        return right


def two_at_once(pair: tuple[Measured, Measured], number: int, both: Both) -> None:
    """Note what is found where two loudspeakers of one room say different sentences."""
    rng = np.random.default_rng([8, number])
    sounds, speaks = [], []
    for k, case in enumerate(pair):
        samples, sounding = heard(case, number + k, rng)
        sounds.append(samples[int(delay(case) * case.sample_rate) :])
        speaks.append(sounding)
    samples = np.sum([sound[: min(map(len, sounds))] for sound in sounds], axis=0)
    array = Array(pair[0].microphones, pair[0].sample_rate, pair[0].room, SPEED)
    centre, true = array.microphones.mean(axis=0), np.array([case.source for case in pair])
    localizer = SteeredLocalizer(array, SteeredSettings(), np.random.default_rng(0))
    steps = np.arange(0.5, len(samples) / array.sample_rate - 0.35, EVERY_S).round(1)
    times = [time for time in steps if all(np.abs(one - time).min() < 0.03 for one in speaks)]
    both.frames += len(times)
    for decision in localizer.localize([Block(samples)]):
        if any(abs(decision.time - time) < 1e-6 for time in times):
            away = [
                [np.hypot(*(place - one)[:2]) * RIGHT_DEG / RIGHT_M for one in true] for place in decision.positions
            ]
            if decision.rays:
                away = [[azimuth_error(ray.direction, one - centre) for one in true] for ray in decision.rays if ray]
            right = both.note("avdetect-audio", np.array(away).reshape(-1, 2))
            both.scores += decision.scores.tolist()
            both.right += right.tolist()
    if localizer.compact:
        travel = float(np.linalg.norm(true - centre, axis=1).mean()) / SPEED
        for name in PEERS:
            for time in times:
                values = answered(name, array, samples, float(time) + travel, count=2)
                around = np.maximum(np.roll(values, 1), np.roll(values, -1))
                peaks = np.flatnonzero(values >= around)
                turns = np.radians(peaks[np.argsort(-values[peaks])[:2]])
                rays = np.column_stack([np.cos(turns), np.sin(turns)])
                both.note(name, np.array([[azimuth_error(ray, one - centre) for one in true] for ray in rays]))


def answered(name: str, array: Array, samples: np.ndarray, middle: float, *, count: int) -> np.ndarray:
    """Return how a method of pyroomacoustics answers each degree, (360,), in a frame about a time in s.

    Args:
        name: of the method.
        array: the microphones.
        samples: (n, m).
        middle: s.
        count: how many sources it looks for.
    """
    finder = PEERS[name](
        (array.microphones - array.microphones.mean(axis=0)).T, array.sample_rate, NFFT, c=SPEED, num_src=count,
        mode="far", azimuth=np.radians(np.arange(360.0)),
    )  # fmt: skip
    window = np.hanning(NFFT)[:, None]
    begin = int((middle - 0.5 * FRAME_S) * array.sample_rate)
    frame = samples[begin : begin + int(FRAME_S * array.sample_rate)]
    spectra = [np.fft.rfft(window * frame[k : k + NFFT], axis=0).T for k in range(0, len(frame) - NFFT + 1, NFFT // 2)]
    finder.locate_sources(np.stack(spectra, axis=2), freq_range=list(PEER_BAND_HZ))
    values: np.ndarray = finder.grid.values
    return values


def by_peers(case: Measured, samples: np.ndarray, times: list[float], tally: Tally) -> None:
    """Note what pyroomacoustics finds, its grid of a degree refined by a parabola, in frames of FRAME_S."""
    array = Array(case.microphones, case.sample_rate, case.room, SPEED)
    true = case.source - case.microphones.mean(axis=0)
    travel = float(np.linalg.norm(true)) / SPEED + delay(case)
    for name in PEERS:
        for time in times:
            values = answered(name, array, samples, time + travel, count=1)
            at = int(np.argmax(values))
            before, peak, after = values[at - 1], values[at], values[(at + 1) % len(values)]
            shift = 0.5 * (before - after) / min(before - 2.0 * peak + after, -1e-12)
            turn = np.radians(at + float(np.clip(shift, -0.5, 0.5)))
            error = azimuth_error(np.array([np.cos(turn), np.sin(turn)]), true)
            tally.azimuths.setdefault(name, []).append(error)


def by_avcli(case: Measured, samples: np.ndarray, times: list[float], tally: Tally) -> None:
    """Note what avdetect-audio finds at the same times."""
    array = Array(case.microphones, case.sample_rate, case.room, SPEED)
    localizer = SteeredLocalizer(array, SteeredSettings(), np.random.default_rng(0))
    late = int(delay(case) * case.sample_rate)
    for decision in localizer.localize([Block(samples[late:])]):
        if any(abs(decision.time - time) < 1e-6 for time in times):
            note(case, decision, tally)


def note(case: Measured, decision: Decision, tally: Tally) -> None:
    """Note a decision."""
    if case.set.startswith(LINE):
        note_sides(case, decision, tally)
        return
    centre, true = case.microphones.mean(axis=0), case.source - case.microphones.mean(axis=0)
    for number, (position, score) in enumerate(zip(decision.positions, decision.scores, strict=True)):
        ray = decision.rays[number] if decision.rays else None
        error = azimuth_error(ray.direction if ray else position - centre, true)
        away = (position - case.source)[:2]
        near = error < RIGHT_DEG if ray else bool(np.hypot(*away) < RIGHT_M)
        tally.scores.append(float(score))
        tally.right.append(near and number == 0)
        if number:
            tally.further += 1
            continue
        tally.azimuths.setdefault("avdetect-audio", []).append(error)
        tally.places.append(float(np.hypot(*away)))
        tally.ellipses.append(bool(away @ np.linalg.solve(decision.covariances[number][:2, :2], away) < 5.99))
        if ray:
            tally.inside.append(error < 1.96 * np.degrees(ray.sd))


def note_sides(case: Measured, decision: Decision, tally: Tally) -> None:
    """Note the nearest place that a line tells; the other side of the line counts as told beside it."""
    if not len(decision.positions):
        return
    away = (decision.positions - case.source)[:, :2]
    held = [
        float(one @ np.linalg.solve(shape[:2, :2], one)) for one, shape in zip(away, decision.covariances, strict=True)
    ]
    nearest = int(np.argmin(held))
    tally.places.append(float(np.hypot(*away[nearest])))
    tally.ellipses.append(held[nearest] < 5.99)
    tally.widths.append(float(np.sqrt(np.linalg.eigvalsh(decision.covariances[nearest][:2, :2])[1])))
    tally.scores.append(float(decision.scores.sum()))
    tally.further += len(away) - 1


def spread(errors: list[float], digits: int = 1) -> str:
    """Return median / 90th percentile."""
    return f"{np.median(errors):.{digits}f} / {np.quantile(errors, 0.9):.{digits}f}" if errors else "-"


def table(tallies: dict[tuple[str, str], Tally]) -> list[str]:
    """Return the lines of the table."""
    names = ["avdetect-audio", *PEERS]
    lines = [
        "| array | used to | frames | found | " + " | ".join(f"{name}, degrees" for name in names)
        + " | within 1.96 sd | metres | 95 % ellipse | score said / true | false beside it |",
        "|" + "---|" * (9 + len(names)),
    ]  # fmt: skip
    for (array, split), tally in tallies.items():
        found = len(tally.azimuths.get("avdetect-audio", []))
        errors = " | ".join(spread(tally.azimuths.get(name, [])) for name in names)
        inside = f"{np.mean(tally.inside):.2f}" if tally.inside else "-"
        said = f"{np.mean(tally.scores):.2f} / {np.mean(tally.right):.2f}" if tally.scores else "-"
        held = f"{np.mean(tally.ellipses):.2f}" if tally.ellipses else "-"
        lines.append(
            f"| {array} | {split} | {tally.frames} | {found / max(tally.frames, 1):.2f} | {errors} | {inside} |"
            f" {'-' if tally.inside else spread(tally.places, 3)} | {held} | {said} | {tally.further} |"
        )
    return lines


def table_of_lines(tallies: dict[tuple[str, str], Tally]) -> list[str]:
    """Return the lines of the table of microphones on one line."""
    lines = [
        "| line | frames | found | metres, the nearer side | standard deviation, m | 95 % ellipse | scores together |"
        " told beside it |",
        "|" + "---|" * 8,
    ]
    for (array, _), tally in tallies.items():
        found = len(tally.places)
        lines.append(
            f"| {array} | {tally.frames} | {found / max(tally.frames, 1):.2f} | {spread(tally.places, 2)} |"
            f" {spread(tally.widths, 2)} | {np.mean(np.array(tally.ellipses)) if tally.ellipses else np.nan:.2f} |"
            f" {np.mean(tally.scores) if tally.scores else np.nan:.2f} | {tally.further} |"
        )
    return lines


def table_of_both(tallies: dict[tuple[str, str], Both]) -> list[str]:
    """Return the lines of the table of two at once."""
    names = ["avdetect-audio", *PEERS]
    lines = [
        "| array | used to | frames | "
        + " | ".join(f"{name}, recall / precision" for name in names)
        + " | said / true |",
        "|" + "---|" * (4 + len(names)),
    ]
    for (array, split), both in tallies.items():
        each = [
            f"{both.found[name] / (2 * both.frames):.2f} / {both.found[name] / max(both.told[name], 1):.2f}"
            if name in both.found
            else "-"
            for name in names
        ]
        said = f"{np.mean(both.scores):.2f} / {np.mean(both.right):.2f}" if both.scores else "-"
        lines.append(f"| {array} | {split} | {both.frames} | {' | '.join(each)} | {said} |")
    return lines


def pairs(cases: Sequence[Measured]) -> list[tuple[Measured, Measured]]:
    """Return pairs of loudspeakers, each with the next but some in the same room that stands elsewhere."""
    found = []
    for number, one in enumerate(cases):
        others = [*cases[number + 1 :], *cases[:number]]
        middle = one.microphones.mean(axis=0)
        for other in others[len(others) // 3 :] + others[: len(others) // 3]:
            alike = one.name.split(",")[-1] == other.name.split(",")[-1]
            if alike and azimuth_error(one.source - middle, other.source - middle) > 30.0:
                found.append((one, other))
                break
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="directory with the sets as folders")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out", help="directory of real-audio.md")
    parser.add_argument("--split", choices=("decide", "judge"), help="one half alone")
    parser.add_argument("--folder", help="one set alone")
    parser.add_argument("--every", type=int, default=1, help="take every so many loudspeakers of large sets")
    chosen = parser.parse_args()
    tallies: dict[tuple[str, str], Tally] = {}
    both: dict[tuple[str, str], Both] = {}
    sources: list[str] = []
    for one in (one for one in SETS if chosen.folder in (None, one.folder)):
        if not (chosen.data / one.folder).is_dir():
            print(f"bench-real-audio: {chosen.data / one.folder} is not there; see {one.source}", file=sys.stderr)
            continue
        cases = [case for case in one.read(chosen.data / one.folder) if chosen.split in (None, case.split)]
        for number, case in enumerate(cases[:: chosen.every if len(cases) > 20 else 1]):
            samples, sounding = heard(case, number, np.random.default_rng([7, number]))
            steps = np.arange(0.5, len(samples) / case.sample_rate - 0.35, EVERY_S).round(1)
            times = [float(time) for time in steps if np.abs(sounding - time).min() < 0.03]
            tally = tallies.setdefault((case.set, case.split), Tally())
            tally.frames += len(times)
            by_avcli(case, samples, times, tally)
            if tally.inside:  # pyroomacoustics takes sound for plane waves, which it is not inside a large array
                by_peers(case, samples, times, tally)
        paired = [case for case in cases if not case.set.startswith(LINE)]
        for split in dict.fromkeys(case.split for case in paired):
            some = [case for case in paired if case.split == split]
            for number, pair in enumerate(pairs(some)[:: chosen.every if len(some) > 20 else 1]):
                two_at_once(pair, number, both.setdefault((pair[0].set, split), Both()))
        sources.append(f"- {cases[0].set}: {one.source}; licence: {one.licence}")
    if not tallies:
        sys.exit(f"bench-real-audio: none of the sets is in {chosen.data}")
    chosen.out.mkdir(parents=True, exist_ok=True)
    straight = {key: tally for key, tally in tallies.items() if key[0].startswith(LINE)}
    others = {key: tally for key, tally in tallies.items() if key not in straight}
    tables = [table(others), table_of_lines(straight), table_of_both(both)]
    text = "\n".join([line for one in tables for line in [*one, ""]] + [*sources, ""])
    (chosen.out / "real-audio.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
