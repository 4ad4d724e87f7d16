"""Random worlds, lenses, sounds, pictures, detections, faults and damaged files, until the time is up: nothing is lost.

    make stress                                         # ten minutes
    make stress STRESS_FLAGS="--seconds 3600"
    make stress STRESS_FLAGS="--only sounds --seed 417 --most 1"      # one trial again, as the table names it

Each trial ends well in one of two ways: with a right answer (valid records, finite numbers, covariances that are
positive), or refused with one clear line and the exit code of a refusal. Lost is what ends otherwise: a traceback, NaN,
a hang, a half-written output, a temporary file left behind. Writes stress.md and stress.jsonl (what was lost, with the
seed) into --out, and exits 1 where anything was lost.
"""

import argparse
import json
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import forked
from stress_kinds import KINDS, Trial


def tried(name: str, seed: int, longest_s: int) -> Trial:
    """Run one trial in a directory of its own; a fault of the trial's own code is raised."""
    forked.HANG_S = longest_s
    with tempfile.TemporaryDirectory(prefix="stress-") as folder:
        return KINDS[name](seed_of(name, seed), Path(folder))


def seed_of(name: str, seed: int) -> int:
    """The seed of one kind's trial: kinds do not share their chance."""
    return zlib.crc32(name.encode()) + (seed << 32)


def stressed(
    kinds: Sequence[str], first: int, most: int, seconds: float, verbose: bool = False
) -> dict[str, list[tuple[int, Trial]]]:
    """Run one trial of each kind after another until the time is up or each had `most`; print what is lost."""
    found: dict[str, list[tuple[int, Trial]]] = {name: [] for name in kinds}
    end = time.monotonic() + seconds
    for seed in range(first, first + most):
        for name in kinds:
            if time.monotonic() > end and all(found.values()):
                return found
            trial = tried(name, seed, longest_s=300)
            found[name].append((seed, trial))
            if trial.lost:
                print(f"lost: {name} --seed {seed}: {trial.what}: {trial.lost}", flush=True)
            elif trial.refused and verbose:
                print(f"refused: {name} --seed {seed}: {trial.what}: {trial.refused}", flush=True)
    return found


def table(found: dict[str, list[tuple[int, Trial]]]) -> str:
    """How often each was tried and how it ended, as Markdown."""
    lines = ["| what | tried | right answer | refused in one line | lost |", "|---|---:|---:|---:|---:|"]
    for name, trials in found.items():
        ends = Counter("lost" if t.lost else "refused" if t.refused else "right" for _, t in trials)
        doc = (KINDS[name].__doc__ or "").splitlines()[0].rstrip(".")
        lines.append(f"| {name}: {doc} | {len(trials)} | {ends['right']} | {ends['refused']} | {ends['lost']} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/stress"))
    parser.add_argument("--seconds", type=float, default=600.0, help="time for all")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--most", type=int, default=10**9, help="trials of each kind")
    parser.add_argument("--verbose", "-v", action="store_true", help="print what is refused, too")
    parser.add_argument("--only", nargs="+", choices=list(KINDS), default=list(KINDS), metavar="KIND",
                        help=", ".join(KINDS))  # fmt: skip
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    found = stressed(options.only, options.seed, options.most, options.seconds, options.verbose)
    text = table(found)
    print(text)
    (options.out / "stress.md").write_text(text)
    lost = [{"kind": name, "seed": seed, "what": trial.what, "lost": trial.lost}
            for name, trials in found.items() for seed, trial in trials if trial.lost]  # fmt: skip
    (options.out / "stress.jsonl").write_text("".join(json.dumps(one) + "\n" for one in lost))
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
