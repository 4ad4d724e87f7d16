"""What each step may cost, in units of the reference workload: budget.json, which --write-budget or a person writes.

A limit guards against getting slower: --check fails where one is exceeded. A goal is what is wished for, and shown.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from figures import Row

FILE = Path(__file__).with_name("budget.json")
WRITTEN = "half as much again as was measured"
ALLOWANCE = 1.5
"""More than the times of one run differ from the next on a busy machine, in units of the reference around them."""

DEFAULTS = (
    "avcli", "avcli default", "avcli, -40 dB", "avcli srp", "avcli depth", "avcli people 640x384",
    "avcli, rounded cones, 4 samples",
)  # fmt: skip
"""The tools of the stage benchmarks that are the defaults of the commands."""


@dataclass(frozen=True)
class Judged:
    """One line of the budget beside what was measured, both in units; `why` says where it comes from."""

    stage: str
    case: str
    tool: str
    allowed: float
    found: float
    why: str
    goal: bool = False

    @property
    def over(self) -> bool:
        """Whether it costs more than it may."""
        return self.found > self.allowed


def judged(rows: Sequence[Row]) -> list[Judged]:
    """Compare rows with the budget; lines of which nothing was measured are left out."""
    found = {_key(row): row for row in rows}
    verdict = []
    for line in json.loads(FILE.read_text())["limits"] if FILE.exists() else []:
        row = found.get(_key(line))
        if row is not None:
            used = row["wall_units"] if line.get("wall") else row["units"]
            verdict.append(Judged(*_key(line), line["units"], used, line["why"], line.get("goal", False)))
    return verdict


def unjudged(rows: Sequence[Row]) -> list[str]:
    """Name the cases that should have a limit and have none."""
    lines = json.loads(FILE.read_text())["limits"] if FILE.exists() else []
    known = {_key(line) for line in lines if not line.get("goal")}
    keys = dict.fromkeys(_key(row) for row in rows if row.get("units") and _is_guarded(row))
    return [", ".join(key) for key in keys if key not in known]


def write(rows: Sequence[Row], machine: dict[str, Any]) -> None:
    """Renew the lines that this function wrote before and add missing ones; lines of people stay as they are."""
    kept = json.loads(FILE.read_text())["limits"] if FILE.exists() else []
    own = {_key(row): row["units"] for row in rows if row.get("units") and _is_guarded(row)}
    by_hand = [line for line in kept if line["why"] != WRITTEN or _key(line) not in own]
    taken = {_key(line) for line in by_hand if not line.get("goal")}
    lines = [
        {"stage": stage, "case": case, "tool": tool, "units": float(f"{ALLOWANCE * units:.2g}"), "why": WRITTEN}
        for (stage, case, tool), units in own.items()
        if (stage, case, tool) not in taken
    ]
    measured_on = {key: machine[key] for key in ("processor", "cpus", "reference")}
    limits = sorted([*by_hand, *lines], key=lambda line: (*_key(line), line["why"]))
    FILE.write_text(json.dumps({"measured_on": measured_on, "limits": limits}, indent=1, ensure_ascii=False) + "\n")


def _is_guarded(row: Row) -> bool:
    """Whether the row is the project's own, as it works where nobody says otherwise."""
    whole = row["stage"] in ("pipe", "start") and row["tool"].startswith("avcli")
    return whole or row["tool"] in DEFAULTS


def _key(row: Row) -> tuple[str, str, str]:
    return row["stage"], row["case"], row["tool"]
