"""The report on a calibration as one HTML page that needs nothing else: verdict first, on phones too, light or dark."""

from base64 import b64encode
from html import escape
from pathlib import Path

import numpy as np

from avcli.calibration import fit, report, sheet, undistort
from avcli.calibration.calibrate import Calibration
from avcli.calibration.circle import Circle
from avcli.calibration.gather import Seen
from avcli.calibration.quality import Quality
from avcli.calibration.settings import ProjectionSettings
from avcli.calibration.sheet import listed, section, table
from avcli.formats.media import encode_picture

_REASONS = {
    "no board": "show no board",
    "duplicate": "show the board where another picture has it",
    "another size": "have another size than most",
    "moving": "show a board that moves",
    "blurred": "are blurred",
    "does not fit": "show a board that does not fit the lens",
}
_NAMED = 400
"""Pictures without a board that are listed by name."""


def page(result: Calibration, seen: Seen) -> str:
    """Write the report as one HTML page that needs nothing else.

    Args:
        result: the calibration.
        seen: what became of each picture.
    """
    q = result.quality
    kind = "no" if q.refusals else "yes" if "whole picture" in q.verdict and not q.advice else "partly"
    of_the_lens = tuple(f"{name} " for name in result.solution.names)  # the table has them
    said = [line for line in report.words(result, seen)[:-1] if not line.startswith(of_the_lens)]
    sections = [
        section("What to film next", listed(q.advice) if q.advice else "<p>Nothing: more pictures are not needed.</p>"),
        section("Figures", _figures(result, seen)),
        section("Over the picture", f'<div class="maps">{"".join(_maps(result))}</div>'),
        section("Pictures", _pictures(result, seen)),
        section("Lens", _parameters(result)),
        section("A straightened picture", _straightened(result, seen.sample)),
        section("In words", listed(said)),
    ]
    return sheet.document("Camera calibration", kind, q.verdict, sections)


def _figures(result: Calibration, seen: Seen) -> str:
    q = result.quality
    held_out = f"{q.held_out_rms_px:.3f} px" if np.isfinite(q.held_out_rms_px) else "unknown: too few pictures"
    rows = [
        ("Camera", f"{result.width} × {result.height} px, {result.camera_config()['lens_model']}"),
        ("Board", result.board.words),
        ("Pictures", f"{int(result.kept.sum())} used of {len(result.kept)} with a board, {len(seen)} in all"),
        ("Corners", f"{len(result.observations.pixels)} used, {int(result.dropped.sum())} left out"),
        ("Residual (RMS)", f"{q.rms_px:.3f} px"),
        ("Residual of pictures held out", held_out),
        ("Expected error, mean", f"{q.mean_sd_px:.3f} px, where the lens is trusted"),
        ("Halves of the pictures", _halves(q)),
        ("Corners were seen up to", f"{np.rad2deg(q.theta_max_observed):.1f}° from the axis"),
        ("The lens is trusted up to", f"{np.rad2deg(q.theta_max_trusted):.1f}°"),
        ("The picture reaches", f"{np.rad2deg(q.theta_max_picture):.1f}°"),
    ]
    return table(rows)


def _halves(q: Quality) -> str:
    if not np.isfinite(q.halves.ratio):
        return "too few to compare"
    return f"differ by {q.halves.actual_px:.3f} px, {q.halves.ratio:.2f} times what is stated"


def _parameters(result: Calibration) -> str:
    """The lens, with standard deviations. What is known of the board is said in words."""
    s, lens = result.solution, slice(None, -fit.BESIDE)
    rows = []
    for name, value, sd, is_free in zip(
        s.names[lens], s.parameters[lens], result.quality.sd[lens], s.free[lens], strict=True
    ):
        if is_free:
            unit, digits = (" px", 2) if name in ("fx", "fy", "cx", "cy") else ("", 5)
            rows.append((name, f"{value:.{digits}f} ± {sd:.{digits}f}{unit}"))
    return table(rows)


# --- over the picture -------------------------------------------------------------------------------------------------


def _maps(result: Calibration) -> list[str]:
    q = result.quality
    return [
        _map(
            result,
            "Expected error",
            "How far the lens may be wrong (standard deviation). It is trusted within the strong dashes. Dotted rings: "
            "every 15° from the axis.",
            _field(q),
            _scale(q.field.sd_px),
        ),
        _map(
            result,
            "Coverage",
            "Corners that the fit used. The stronger the green of a field, the more there are.",
            _cells(result) + _dots(result.observations.pixels),
        ),
        _residuals(result),
    ]


def _map(result: Calibration, title: str, text: str, inside: str, scale: str = "") -> str:
    w, h = result.width, result.height
    return f"""<figure>
<svg viewBox="-0.5 -0.5 {w} {h}" role="img" aria-label="{escape(title)}">
<rect class="ground" x="-0.5" y="-0.5" width="{w}" height="{h}"/>
{inside}
{_rings(result)}
</svg>
{scale}<figcaption><b>{escape(title)}.</b> {escape(text)}</figcaption>
</figure>
"""


def _rings(result: Calibration) -> str:
    """Rings every 15° from the axis, a stronger one up to which the lens is trusted, and the edge of the light."""
    lens, turn = result.solution.lens, np.linspace(0, 2 * np.pi, 121)
    paths = []
    q = result.quality
    for angle in [
        *range(15, int(np.rad2deg(min(lens.theta_max, q.theta_max_picture))), 15),
        np.rad2deg(q.theta_max_trusted),
    ]:
        s, c = np.sin(np.deg2rad(angle)), np.cos(np.deg2rad(angle))
        ring = lens.project(np.stack([s * np.cos(turn), s * np.sin(turn), np.full(121, c)], -1))
        if np.isfinite(ring).all():
            kind = "seen" if isinstance(angle, float) else "ring"
            paths.append(f'<path class="{kind}" d="M{"L".join(f"{u:.0f} {v:.0f}" for u, v in ring)}"/>')
    if q.circle is not None:
        paths.append(f'<circle class="light" {_round(q.circle)}/>')
    return "\n".join(paths)


def _round(circle: Circle) -> str:
    return f'cx="{circle.x:.1f}" cy="{circle.y:.1f}" r="{circle.radius:.1f}"'


def _field(q: Quality) -> str:
    """The expected error as a small picture that the browser smooths, within the light."""
    import cv2

    pixels, sd_px = q.field.pixels, q.field.sd_px
    low, high = _limits(sd_px)
    known = np.isfinite(sd_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        level = np.log(np.where(known, sd_px, low) / low) / np.log(high / low)
    colours = cv2.applyColorMap(np.rint(255 * level.clip(0, 1)).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[:, :, ::-1]
    image = np.dstack([colours, np.where(known, 255, 0).astype(np.uint8)])
    step = np.diff(pixels[0, :2, 0])[0], np.diff(pixels[:2, 0, 1])[0]
    x, y = pixels[0, 0] - np.array(step) / 2
    rows, columns = sd_px.shape
    clip = "" if q.circle is None else f'<clipPath id="light"><circle {_round(q.circle)}/></clipPath>\n'
    within = ' clip-path="url(#light)"' if clip else ""
    return (
        f'{clip}<image{within} x="{x:.1f}" y="{y:.1f}" width="{columns * step[0]:.1f}" height="{rows * step[1]:.1f}" '
        f'preserveAspectRatio="none" href="{_embedded(image, ".png")}"/>'
    )


def _limits(sd_px: np.ndarray) -> tuple[float, float]:
    known = sd_px[np.isfinite(sd_px) & (sd_px > 0)]
    if not known.size:
        return 0.01, 1.0
    low = float(np.quantile(known, 0.02))
    return low, max(float(np.quantile(known, 0.98)), 1.5 * low)


def _scale(sd_px: np.ndarray) -> str:
    low, high = _limits(sd_px)
    return (
        f'<div class="scale"><span>{_shown(low)} px</span><i></i>'
        f"<span>{_shown(float(np.sqrt(low * high)))}</span><i></i><span>{_shown(high)} px</span></div>\n"
    )


def _shown(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else "> 1000"


def _cells(result: Calibration) -> str:
    counts = result.quality.counts
    height, width = result.height / counts.shape[0], result.width / counts.shape[1]
    most = np.log1p(max(int(counts.max()), 1))
    return "".join(
        f'<rect class="cell" x="{x * width - 0.5:.1f}" y="{y * height - 0.5:.1f}" width="{width:.1f}" '
        f'height="{height:.1f}" opacity="{0.15 + 0.6 * np.log1p(counts[y, x]) / most:.2f}"/>'
        for y, x in np.argwhere(counts > 0)
    )


def _dots(pixels: np.ndarray) -> str:
    return f'<path class="dots" d="{"".join(f"M{u:.0f} {v:.0f}h0" for u, v in pixels)}"/>'


def _residuals(result: Calibration) -> str:
    rest = fit.residuals(result.observations, result.solution)
    length = float(np.nanquantile(np.linalg.norm(rest, axis=1), 0.9))
    enlarged = max(1.0, 0.03 * result.width / max(length, 1e-9))
    power = 10 ** np.floor(np.log10(enlarged))
    enlarged = float(np.floor(enlarged / power) * power)
    good = np.isfinite(rest).all(1)
    lines = "".join(
        f"M{u:.0f} {v:.0f}l{du:.0f} {dv:.0f}"
        for (u, v), (du, dv) in zip(result.observations.pixels[good], enlarged * rest[good], strict=True)
    )
    text = f"Seen minus expected, enlarged {enlarged:g} times. Neighbours should not point the same way."
    return _map(result, "Residuals", text, f'<path class="residuals" d="{lines}"/>')


# --- pictures ---------------------------------------------------------------------------------------------------------


def _pictures(result: Calibration, seen: Seen) -> str:
    """Residual of each picture, those that were left out first; then the names of those without a view."""
    worst = float(np.nanmax(result.view_rms_px)) if len(result.view_rms_px) else 1.0
    order = sorted(range(len(result.kept)), key=lambda i: (bool(result.kept[i]), -float(result.view_rms_px[i])))
    rows = "".join(_row(seen.names[i], float(result.view_rms_px[i]), bool(result.kept[i]), worst) for i in order)
    by_reason: dict[str, list[str]] = {}
    for record in seen.records(result.kept, result.view_rms_px):
        if record["why"] and record["why"] != "does not fit":
            by_reason.setdefault(record["why"], []).append(record["picture"])
    rest = "".join(
        f"<details><summary>{len(names)} of {len(seen)} {escape(_REASONS.get(why, why))}</summary>\n"
        f"<p>{escape(', '.join(names[:_NAMED]))}{' …' if len(names) > _NAMED else ''}</p></details>\n"
        for why, names in sorted(by_reason.items())
    )
    left_out = int((~result.kept).sum())
    said = f"{left_out} left out: {_REASONS['does not fit']}." if left_out else "All pictures with a board were used."
    shown = f'<ol class="views">\n{rows}</ol>'
    if len(order) > 30:
        shown = f"<details><summary>Residual of each picture</summary>\n{shown}</details>"
    return f"<p>{said}</p>\n{shown}\n{rest}"


def _row(name: str, rms_px: float, kept: bool, worst: float) -> str:
    return (
        f'<li{"" if kept else " class=out"}><span title="{escape(name)}">{escape(Path(name).name)}</span>'
        f"<b>{rms_px:.3f} px{'' if kept else ', left out'}</b>"
        f'<meter min="0" max="{worst:.4g}" value="{rms_px:.4g}"></meter></li>\n'
    )


def _straightened(result: Calibration, sample: np.ndarray | None) -> str:
    if sample is None:
        return ""
    import cv2

    size = (result.width, result.height)
    straight = undistort.straighten(result.lens, size, size, ProjectionSettings(balance=0.5))
    image = undistort.resample(sample, straight)
    if result.width > 1280:
        image = cv2.resize(image, (1280, round(1280 * result.height / result.width)), interpolation=cv2.INTER_AREA)
    words = f"One of the pictures, {np.rad2deg(straight.fov):.0f}° wide. Straight things must look straight."
    return f'<figure><img alt="" src="{_embedded(image, ".jpg")}"><figcaption>{words}</figcaption></figure>'


def _embedded(image: np.ndarray, suffix: str) -> str:
    kind = {".png": "image/png", ".jpg": "image/jpeg"}[suffix]
    return f"data:{kind};base64,{b64encode(encode_picture(image, suffix)).decode()}"
