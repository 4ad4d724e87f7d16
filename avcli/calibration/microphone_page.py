"""The report on measured microphones as one HTML page: verdict first, then where each is and what its channel does."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from avcli.calibration.microphones import Measured
from avcli.calibration.sheet import document, listed, section, table

_ENLARGED = 10
"""How many times larger than the room shifts and ellipses are drawn: centimetres do not show in a room of metres."""
_WITHIN = 2.45
"""Half axis of an ellipse that holds 95 % in two dimensions, in standard deviations."""


def page(found: Measured, channels: Sequence[Mapping[str, Any]], faults: Sequence[str], room: np.ndarray) -> str:
    """Write the report.

    Args:
        found: the measurement.
        channels: the state of each microphone's channel, as avcalib writes it.
        faults: what is wrong with channels, sentences without a full stop.
        room: (3,) m.
    """
    if found.refusal:
        kind, verdict = "no", found.refusal
    elif found.untold.any():
        lost = ", ".join(str(k + 1) for k in np.flatnonzero(found.untold))
        kind, verdict = (
            "partly",
            f"the sound does not tell where these microphones are: {lost}; the others are measured",
        )
    elif found.placed:
        kind, verdict = "yes", "the positions are measured, in the room too"
    elif found.echoing.all():
        kind, verdict = "yes", "the positions are measured, in the room too, between its surfaces"
    else:
        kind, verdict = "partly", "the shape of the array is measured; its place in the room is as it was given"
    return document(
        "Measured microphones",
        kind,
        verdict,
        [
            section("Channels", listed(faults) if faults else "<p>No channel has a fault.</p>"),
            section("In the room", f'<div class="maps">{_plan(found, room)}{_heights(found)}</div>'),
            section("Microphones", _microphones(found, channels)),
            section("In words", listed(found.words())),
        ],
    )


def _plan(found: Measured, room: np.ndarray) -> str:
    """Draw the room from above: given and found positions, the way of the voice."""
    width, depth = room[:2]
    way = "L".join(f"{x:.2f} {depth - y:.2f}" for x, y in found.fit.path[:, :2])
    marks = []
    for number, (given, shift, covariance) in enumerate(
        zip(found.prior.positions, found.shifts, found.covariances, strict=True), 1
    ):
        x, y = given[0], depth - given[1]
        dx, dy = _ENLARGED * shift[0], -_ENLARGED * shift[1]
        power, turn = np.linalg.eigh(covariance[:2, :2])
        long, short = _ENLARGED * _WITHIN * np.sqrt(np.maximum(power[::-1], 0.0))
        angle = -np.degrees(np.arctan2(turn[1, -1], turn[0, -1]))
        marks.append(
            f'<path class="residuals" d="M{x:.3f} {y:.3f}l{dx:.3f} {dy:.3f}"/>'
            f'<ellipse class="light" rx="{long:.3f}" ry="{short:.3f}" '
            f'transform="translate({x + dx:.3f} {y + dy:.3f}) rotate({angle:.1f})"/>'
            f'<path class="dots" d="M{x:.3f} {y:.3f}h0"/>'
            f'<text x="{x + 0.08:.3f}" y="{y - 0.08:.3f}">{number}</text>'
        )
    edge = 0.2 * max(width, depth)
    return f"""<figure>
<svg viewBox="{-edge:.2f} {-edge:.2f} {width + 2 * edge:.2f} {depth + 2 * edge:.2f}" role="img"
 aria-label="The room from above" font-size="{0.05 * max(width, depth):.2f}">
<rect class="ground" width="{width:.2f}" height="{depth:.2f}"/>
<path class="ring" d="M{way}"/>
{"".join(marks)}
</svg>
<figcaption><b>From above.</b> x to the right, y upwards. A dot is where config.json had the microphone. The line is its
shift, and the ellipse is where it hangs with 95 %; both are {_ENLARGED} times enlarged. Dashes: the way of the
voice.</figcaption>
</figure>
"""


def _heights(found: Measured) -> str:
    """Draw by how much each microphone is higher than it was given, with 95 %."""
    up, sd = 1000 * found.shifts[:, 2], 1000 * np.sqrt(found.covariances[:, 2, 2])
    most = max(float((np.abs(up) + 1.96 * sd).max()), 10.0)
    step = float(next(step for step in (10, 20, 50, 100, 200, 500, 1000) if most <= 4 * step or step == 1000))
    high, across = 60.0, 100.0 / (len(up) + 1)
    lines = "".join(
        f'<path class="ring" d="M0 {-high / 2 * level / most:.1f}H100"/>'
        f'<text x="-1" y="{-high / 2 * level / most + 1:.1f}" text-anchor="end">{level:+.0f} mm</text>'
        for level in np.arange(-np.floor(most / step), np.floor(most / step) + 1) * step
    )
    bars = "".join(
        f'<path class="seen" style="stroke-dasharray:none" d="M{(k + 1) * across:.1f} '
        f'{-high / 2 * (value - 1.96 * s) / most:.1f}V{-high / 2 * (value + 1.96 * s) / most:.1f}"/>'
        f'<circle cx="{(k + 1) * across:.1f}" cy="{-high / 2 * value / most:.1f}" r="1"/>'
        f'<text x="{(k + 1) * across:.1f}" y="{high / 2 + 7:.0f}" text-anchor="middle">{k + 1}</text>'
        for k, (value, s) in enumerate(zip(up, sd, strict=True))
    )
    return f"""<figure>
<svg viewBox="-17 {-high / 2 - 3:.0f} 120 {high + 13:.0f}" role="img" aria-label="Shifts upwards" font-size="3.5">
{lines}{bars}
</svg>
<figcaption><b>Height.</b> By how much each microphone is higher than config.json had it, with 95 %.</figcaption>
</figure>
"""


def _microphones(found: Measured, channels: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for number, (position, shift, covariance, channel) in enumerate(
        zip(found.fit.positions, found.shifts, found.covariances, channels, strict=True), 1
    ):
        sd = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        turned = "" if channel["polarity"] > 0 else ", turned over"
        rows.append(
            (
                str(number),
                ", ".join(f"{value:.3f}" for value in position),
                f"{1000 * np.linalg.norm(shift):.0f} ± {1000 * sd:.0f}",
                f"{channel['channel']}{turned}" + ("" if channel["usable"] else ", not used"),
                f"{1000 * channel['delay_s']:.2f}",
                f"{channel['drift_ppm']:.1f}",
                f"{channel['level_db']:+.0f}",
            )
        )
    head = ("Microphone", "x, y, z m", "Shift mm", "Channel", "Late ms", "Drift ppm", "Level dB")
    return f'<div class="wide">{table(rows, head)}</div>'
