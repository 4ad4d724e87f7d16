#!/usr/bin/env python3
"""Gather the metrics of a sweep into one table and its plots: table.md, scenes.csv, table.svg.

    python collect.py OUT

Each number of the table is the mean over the seeds, with the half-width of its 95 % interval (Student's t).
"""

import argparse
import csv
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.stats import t as student

PARAMETERS = ("scenario", "tracker", "seconds", "t60", "noise")
FIGURES = ("HOTA", "DetA", "AssA", "LocA", "RMSE")


def scenes(out: Path) -> list[dict[str, object]]:
    """Read the metrics of all scenes: their parameters, which are in their paths, and their figures."""
    rows = []
    for path in out.glob("*/*/seconds~*/t60~*/noise~*/seed~*/metrics.jsonl"):
        scenario, _, *parameters = path.relative_to(out).parent.parts
        values = dict(part.split("~", 1) for part in parameters)
        for line in path.read_text(encoding="utf-8").splitlines():
            record = json.loads(line)
            if record["sequence"] != "combined":
                figures = {name: record["summary"][name] for name in FIGURES}
                rows.append({"scenario": scenario, **values, "tracker": record["tracker"], **figures})
    numbers = (*PARAMETERS[2:], "seed")
    return sorted(rows, key=lambda row: [row["scenario"], row["tracker"], *(float(row[name]) for name in numbers)])


def interval(values: list[float]) -> tuple[float, float]:
    """Return the mean and the half-width of its 95 % interval."""
    known = np.array([value for value in values if value is not None], float)
    if len(known) < 2:
        return (float(known.mean()) if len(known) else np.nan), np.nan
    return float(known.mean()), float(student.ppf(0.975, len(known) - 1) * known.std(ddof=1) / np.sqrt(len(known)))


def plot(path: Path, means: dict[tuple[str, ...], dict[str, tuple[float, float]]]) -> None:
    """Draw HOTA over the reverberation time, a panel for each scenario and a line for each tracker and noise."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "avcli"
    import matplotlib.pyplot as plt

    scenarios = sorted({key[0] for key in means})
    figure, axes = plt.subplots(1, len(scenarios), figsize=(3.2 * len(scenarios), 3.2), sharey=True, squeeze=False)
    for axis, scenario in zip(axes[0], scenarios, strict=True):
        for tracker, seconds, noise in sorted({key[1:3] + key[4:] for key in means if key[0] == scenario}):
            points = sorted(
                (float(t60), *mean["HOTA"])
                for (*one, t60, dB), mean in means.items()
                if (*one, dB) == (scenario, tracker, seconds, noise)
            )
            x, y, half = np.array(points).T
            axis.errorbar(x, 100 * y, 100 * half, marker="o", capsize=2, label=f"{tracker}, {seconds} s, {noise} dB")
        axis.set(title=scenario, xlabel="T60 (s)", ylim=(0, 102))
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("HOTA (%)")
    axes[0, 0].legend(fontsize=7, loc="lower left")
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    rows = scenes(out)
    with open(out / "scenes.csv", "w", newline="", encoding="utf-8") as text:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(str(row[name]) for name in PARAMETERS)].append(row)
    means = {key: {name: interval([row[name] for row in own]) for name in FIGURES} for key, own in groups.items()}
    lines = ["| scenario | tracker | s | T60 s | noise dB | scenes | HOTA | DetA | AssA | LocA | RMSE m |"]
    lines.append("|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for key, mean in means.items():
        cells = [f"{100 * mean[name][0]:.1f} ± {100 * mean[name][1]:.1f}" for name in FIGURES[:4]]
        cells.append(f"{mean['RMSE'][0]:.3f} ± {mean['RMSE'][1]:.3f}")
        lines.append(f"| {' | '.join(key)} | {len(groups[key])} | {' | '.join(cells)} |")
    (out / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    plot(out / "table.svg", means)


if __name__ == "__main__":
    main()
