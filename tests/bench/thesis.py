"""The whole chain as the thesis built it, beside ours, on the same scenes; and each replaced part by itself.

    make thesis                                     # S1 to S4, one seed: about ten minutes of CPU time
    make thesis THESIS_FLAGS="--seeds 5"

Five parts differ: the camera (the thesis's division lens, and depth of 8 bits), the sound (responses that are switched
every 10 ms, 15 dB of echoes, then noise), 3D-SSL, the depth of one pixel, and the tracker (its Table 5.5); each is the
--preset thesis of its command. A part is worth what ours loses where it alone is the thesis's, and what the thesis's
chain gains where it alone is ours. Writes thesis.md and thesis.jsonl into --out.
"""

import argparse
import json
import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import chain
import numpy as np

from avcli.metrics import thesis as printed_results

PARTS = {
    "camera": "division lens, 8-bit depth",
    "sound": "switched every 10 ms",
    "localization": "3D-SSL",
    "position": "the depth at one pixel of the box",
    "tracker": "as its Table 5.5",
}
ALL = frozenset(PARTS)
Which = frozenset[str]
"""The parts that are the thesis's; the others are ours."""


def variants() -> dict[str, Which]:
    """All ours, all the thesis's, and both with one part exchanged, by name."""
    one_theirs = {f"ours, but {part}": frozenset([part]) for part in PARTS}
    one_ours = {f"the thesis's, but our {part}": ALL - {part} for part in PARTS}
    return {"ours": frozenset(), **one_theirs, "the thesis's": ALL, **one_ours}


def preset(part: str, which: Which) -> tuple[str, ...]:
    """Options of the command that has this part."""
    return ("--preset", "thesis") if part in which else ()


def score_of(
    folder: Path, scenario: str, seed: int, which: Which, sensor: str = "clean"
) -> dict[str, dict[float, float]]:
    """HOTA of one variant in one scenario: by sound, pictures and both, by d0; `sensor` is the camera's noise."""

    def word(*parts: str) -> str:
        return "-".join("thesis" if part in which else "ours" for part in parts)

    base = folder / f"{scenario}-{seed}"
    noise = ("--noise", "sensor=30")
    picture = ("--seed", seed, "--sensor", sensor, *preset("camera", which))
    eye = chain.seen(base / f"eye-{word('camera')}", scenario, *picture)
    ear = chain.heard(base / f"ear-{word('sound')}", scenario, "--seed", seed, *noise, *preset("sound", which))
    found = {
        "audio": chain.made("avdetect-audio", base / f"audio-{word('sound', 'localization')}.jsonl", "-C", ear,
                            ear / "audio.jsonl", *preset("localization", which)),
        "video": chain.made("avdetect-video", base / f"video-{word('camera', 'position')}.jsonl", "-C", eye,
                            eye / "scene.jsonl", *preset("position", which)),
    }  # fmt: skip
    return chain.tracked(eye, found, base / f"tracks-{word(*PARTS)}", *preset("tracker", which))


def table(rows: list[dict], scenarios: list[str], d0: float) -> list[str]:
    """One line a variant: mean HOTA over scenarios and seeds, by sound, pictures and both, and the change."""
    lines = ["| chain | audio | | video | | both | |", "|---|---:|---:|---:|---:|---:|---:|"]
    here = [row for row in rows if row["d0_m"] == d0 and row["scenario"] in scenarios]
    means = {
        name: {s: np.mean([row[s] for row in here if row["variant"] == name]) for s in chain.SENSORS}
        for name in variants()
    }
    for name, values in means.items():
        start = means["ours" if name.startswith("ours") else "the thesis's"]
        cells = [f"{values[s]:.1f} | {values[s] - start[s]:+.1f}" for s in chain.SENSORS]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def by_scenario(rows: list[dict]) -> list[str]:
    """Each scenario: what the thesis printed, its chain as it is built here, and ours, at d0 = 2 m."""
    lines = ["| scenario | sensors | printed in the thesis | its chain, here | ours |", "|---|---|---:|---:|---:|"]
    for scenario in dict.fromkeys(row["scenario"] for row in rows):
        for sensor, key in (("audio", "audio"), ("video", "video"), ("both", "audio_video")):
            here = [row for row in rows if row["scenario"] == scenario and row["d0_m"] == 2.0]
            cells = [chain.shown([r[sensor] for r in here if r["variant"] == v]) for v in ("the thesis's", "ours")]
            printed = printed_results.figures({"sequence": scenario, "tracker": key}) or {}
            lines.append(f"| {scenario} | {sensor} | {100 * printed['HOTA']:.1f} | {cells[0]} | {cells[1]} |")
    return lines


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/thesis"), help="what is there already is used again")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scenarios", nargs="+", default=["s1", "s2", "s3", "s4"], choices=["s1", "s2", "s3", "s4"])
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for scenario in options.scenarios:
        for seed in range(options.seeds):
            for name, which in variants().items():
                score = score_of(options.out, scenario, seed, which)
                rows += [
                    {"scenario": scenario, "seed": seed, "variant": name, "d0_m": d0}
                    | {sensor: score[sensor][d0] for sensor in chain.SENSORS}
                    for d0 in (2.0, 0.5)
                ]
                said = ", ".join(f"{sensor} {score[sensor][2.0]:.1f}" for sensor in chain.SENSORS)
                print(f"{scenario}, seed {seed}, {name}: {said}", flush=True)
    parts = "; ".join(f"{name}: {text}" for name, text in PARTS.items())
    lines = [
        "# The thesis's chain and ours, part by part", "",
        f"By `make thesis THESIS_FLAGS=\"--seeds {options.seeds}\"`: {', '.join(options.scenarios)}, the noise of the "
        "microphones 30 dB below a voice. HOTA in percent. The parts, as the thesis has them: " + parts + ".", "",
        "## Each scenario, d0 = 2 m", "", *by_scenario(rows), "",
        "## What each part is worth, d0 = 2 m", "",
        "Means over scenarios and seeds; beside each what changes against the first line of its half.", "",
        *table(rows, options.scenarios, 2.0), "", "## The same, d0 = 0.5 m", "", *table(rows, options.scenarios, 0.5),
    ]  # fmt: skip
    (options.out / "thesis.md").write_text("\n".join(lines) + "\n")
    (options.out / "thesis.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
