"""How far a calibration can be trusted: held-out error, uncertainty over the picture, coverage, and a verdict."""

from dataclasses import dataclass, replace

import numpy as np

from avcli.calibration import field, fit, robust, uncertainty
from avcli.calibration.blocks import Blocks
from avcli.calibration.circle import Circle
from avcli.calibration.field import Field, Halves, seen_angles

TRUST_LIMIT = np.deg2rad(0.25)
"""Expected error of a ray, rad, up to which a lens is trusted at an angle: 13 mm at a distance of 3 m."""
FOCAL_SD_LIMIT = 0.01
"""Standard deviation of the focal length, as a fraction of it, beyond which a lens counts as not observed."""
LEAST_VIEWS = 4
LEAST_TRUSTED = 1 / 3
"""Fraction of the lit picture that a lens must be trusted in, or it is refused. Its angle would not do: a lens that was
seen only in the middle does not know how far its picture reaches."""
HALVES_LIMIT = 1.4
"""How many times the stated difference two halves of the views may differ by before the statement is called wrong."""

MISSED_LIMIT = 0.15
"""What a lens that may bend anywhere would gain (robust.missed), from which the lens model is said not to describe the
lens. It gains at most 0.08 on 14 real sets that decided this, 0.14 on simulated ones of 10 views whose model is right,
and 0.23 on one that was taken through a window under water."""
RECEDES_LIMIT = 2.5
"""Standard deviations by which the centre of a lens moves back as the angle grows, from which a flat window is named as
the cause: that of a lens alone moves ahead (Gennery 2006). Of 43 real sets the one from behind a window reaches 3.0,
the others at most 1.6 (examples/benchmarks/lenses.md)."""


def coverage(pixels: np.ndarray, width: int, height: int, columns: int = 8) -> np.ndarray:
    """How many corners (n, 2) px fall into each cell of a grid over the picture: (rows, columns) counts."""
    rows = max(2, round(columns * height / width))
    x = np.clip((pixels[:, 0] + 0.5) / width * columns, 0, columns - 1e-9).astype(int)
    y = np.clip((pixels[:, 1] + 0.5) / height * rows, 0, rows - 1e-9).astype(int)
    counts = np.zeros((rows, columns), int)
    np.add.at(counts, (y, x), 1)
    return counts


@dataclass(frozen=True)
class Quality:
    """What is known of a calibration beyond its RMS.

    Attributes:
        rms_px: over the corners of the kept views, as OpenCV counts: root of the mean of dx² + dy².
        inlier_rms_px: the same without corners beyond the robust fit's limit.
        held_out_rms_px: see robust.held_out; NaN where there are too few views.
        sd: (P,) standard deviations of fit.Solution.parameters, by views: fx fy cx cy px, coefficients, b0 b1 m, b2.
        field: expected errors over the picture.
        inflation: how many times larger `sd` is, all in all, than if the errors of the corners were all their own.
        halves: the stated uncertainty put to the test; see `field.split_halves`.
        missed: what the lens model misses; see `robust.missed`.
        recedes: by how many standard deviations the lens's centre moves back as the angle grows, as the views alone
            tell it, without what is known of lenses; below 0 where it moves ahead.
        circle: where light reaches the picture; None: everywhere.
        counts, lit_cells: see `coverage`; and (rows, columns) bool, which of the cells light reaches.
        theta_max_observed, theta_max_trusted, theta_max_picture: rad; the largest angle at which a corner was seen, up
            to which the expected error of a ray stays below TRUST_LIMIT, and which the lit picture shows.
        tilt: rad, spread (RMS) of the boards' normals about their mean.
        refusals: sentences that say why the lens is not observable; empty where it is.
        advice: sentences that say what to film next.
    """

    rms_px: float
    inlier_rms_px: float
    held_out_rms_px: float
    sd: np.ndarray
    field: Field
    inflation: float
    halves: Halves
    missed: float
    recedes: float
    circle: Circle | None
    counts: np.ndarray
    lit_cells: np.ndarray
    theta_max_observed: float
    theta_max_trusted: float
    theta_max_picture: float
    tilt: float
    refusals: tuple[str, ...]
    advice: tuple[str, ...]

    @property
    def trusted(self) -> np.ndarray:
        """(rows, columns) bool, which points of the field are lit and up to the trusted angle."""
        with np.errstate(invalid="ignore"):
            return self.field.lit & (self.field.angle <= self.theta_max_trusted)

    @property
    def field_sd_px(self) -> np.ndarray:
        """(rows, columns) px, the expected error where the lens is trusted; NaN elsewhere."""
        return np.where(self.trusted, self.field.sd_px, np.nan)

    @property
    def mean_sd_px(self) -> float:
        """Mean expected error where the lens is trusted, px; infinite where it is nowhere."""
        known = self.field.sd_px[self.trusted]
        return float(known.mean()) if known.size else np.inf

    @property
    def trusted_part(self) -> float:
        """Fraction of the lit picture in which the lens is trusted."""
        return float(self.trusted.sum() / max(self.field.lit.sum(), 1))

    @property
    def empty(self) -> float:
        """Fraction of the lit picture in which no corner was seen."""
        return float((self.counts[self.lit_cells] == 0).mean()) if self.lit_cells.any() else 1.0

    @property
    def verdict(self) -> str:
        """How far the calibration can be trusted, in words."""
        if self.refusals:
            return f"do not use this calibration: {'; '.join(self.refusals)}"
        said = self._tested
        if self.theta_max_trusted < 0.98 * self.theta_max_picture:
            angle = np.rad2deg(self.theta_max_trusted)
            return f"trust this calibration up to {angle:.1f}° from the axis; beyond that it is extrapolated{said}"
        return f"trust this calibration over the whole picture{said}"

    @property
    def _tested(self) -> str:
        if self.missed > MISSED_LIMIT:
            return (
                f"; but its model does not describe this lens: one that may bend anywhere would fit held-out pictures "
                f"{100 * self.missed:.0f} % better"
            )
        if self.recedes > RECEDES_LIMIT:
            return (
                "; but its centre moves back as the angle grows, as behind a flat window: near the rim, things farther "
                "away than the boards were lie elsewhere than stated"
            )
        ratio = self.halves.ratio
        if not np.isfinite(ratio):
            return "; too few pictures to test the stated errors"
        if ratio > HALVES_LIMIT:
            return f"; but its errors are {ratio:.1f} times as large as stated: halves of the pictures disagree"
        return ""


def assess(
    observations: fit.Observations,
    solution: fit.Solution,
    width: int,
    height: int,
    held_out: float,
    circle: Circle | None = None,
    splits: int = 50,
) -> Quality:
    """Judge a fit by its covariance and by where its boards were, not by its RMS, which is small for bad sets too.

    Args:
        observations, solution: of the kept views.
        width, height: px, of the pictures.
        held_out: px, the held-out RMS.
        circle: where light reaches the pictures; None: everywhere.
        splits: into how many random halves the views are split to test the stated errors; 0: they are not tested.
    """
    lens = solution.lens
    error = np.linalg.norm(fit.residuals(observations, solution), axis=1)
    inlier = error <= solution.delta_px * observations.sigma
    angles = seen_angles(lens, observations.pixels)
    observed = float(np.nanmax(angles)) if np.isfinite(angles).any() else 0.0
    rim = seen_angles(lens, _rim(width, height, circle))
    shown = lens.theta_max if np.isnan(rim).any() else float(rim.max())
    counts = coverage(observations.pixels, width, height)
    sd = np.sqrt(np.maximum(np.diag(solution.covariance), 0))
    quality = Quality(
        rms_px=_rms(error),
        inlier_rms_px=_rms(error[inlier]),
        held_out_rms_px=held_out,
        sd=sd,
        field=field.measured(observations, solution, width, height, circle),
        inflation=1.0,
        halves=Halves(),
        missed=robust.missed(observations, solution),
        recedes=0.0,
        circle=circle,
        counts=counts,
        lit_cells=lit_cells(counts.shape, width, height, circle),
        theta_max_observed=observed,
        theta_max_trusted=field.trusted_angle(solution, observations.pixels, TRUST_LIMIT),
        theta_max_picture=shown,
        tilt=tilt(solution.rotations),
        refusals=(),
        advice=(),
    )
    known = fit.by_view(observations, solution)
    quality = replace(
        quality,
        recedes=_recedes(known, solution),
        inflation=uncertainty.inflation(uncertainty.covariance(known.views), uncertainty.noise(known.views)),
        halves=field.split_halves(
            observations, solution, quality.field.pixels[quality.trusted], splits=splits, known=known
        ),
    )
    refusals = _refusals(quality, observations, solution)
    return replace(quality, refusals=refusals, advice=_advice(quality, refusals))


def tilt(rotations: np.ndarray) -> float:
    """The spread (RMS) of the boards' normals about their mean, rad, of rotations (views, 3, 3) board to camera."""
    normals = rotations[:, :, 2]
    centre = normals.sum(0) / max(np.linalg.norm(normals.sum(0)), 1e-12)
    return float(np.sqrt(np.mean(np.arccos(np.clip(normals @ centre, -1, 1)) ** 2)))


def _recedes(known: Blocks, solution: fit.Solution) -> float:
    """`Quality.recedes`, from the normal equations of a fit that stands."""
    if not solution.free[-1]:
        return 0.0
    alone = known.unheld()
    sd = np.sqrt(uncertainty.covariance(alone.views)[-1, -1])
    return float(-(solution.pupil + alone.step().common[-1]) / sd) if sd > 0 else 0.0


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.nan_to_num(error, nan=100.0) ** 2))) if len(error) else float("nan")


def _rim(width: int, height: int, circle: Circle | None) -> np.ndarray:
    """Pixels (n, 2) among which are the lit ones farthest from the middle: the picture's border and the circle."""
    x, y = np.linspace(0, width - 1, 101), np.linspace(0, height - 1, 101)
    sides = [(0 * y, y), (0 * y + width - 1, y), (x, 0 * x), (x, 0 * x + height - 1)]
    border = np.concatenate([np.stack(side, -1) for side in sides])
    if circle is None:
        return border
    edge = circle.edge()
    within = ((edge >= 0) & (edge <= [width - 1, height - 1])).all(1)
    return np.concatenate([border[circle.holds(border)], edge[within]])


def lit_cells(shape: tuple[int, ...], width: int, height: int, circle: Circle | None) -> np.ndarray:
    """Which cells of a grid (rows, columns) over the picture light reaches, most of each: (rows, columns) bool."""
    rows, columns = shape
    u = (np.arange(4 * columns) + 0.5) / (4 * columns) * width - 0.5
    v = (np.arange(4 * rows) + 0.5) / (4 * rows) * height - 0.5
    light = field.lit(np.stack(np.meshgrid(u, v), -1), circle)
    return light.reshape(rows, 4, columns, 4).mean((1, 3)) >= 0.5


def _focal_sd(solution: fit.Solution) -> float:
    """Relative standard deviation of the focal length on the axis, the larger of across and down.

    That is fx and fy of most models. Of the double sphere model it is fx / (1 + xi), far better known than fx and xi.
    """
    count = len(solution.parameters) - fit.BESIDE

    def on_axis(parameters: np.ndarray) -> np.ndarray:
        lens = replace(solution, parameters=parameters).lens
        return np.log(lens.project_jacobian(np.array([0.0, 0.0, 1.0]))[1][[0, 1], [0, 1]])

    p = solution.parameters
    steps = np.diag(1e-6 * np.maximum(1.0, np.abs(p)))[:count]
    slopes = np.stack([(on_axis(p + h) - on_axis(p - h)) / (2 * h.sum()) for h in steps], -1)
    variances = np.einsum("ia,ab,ib->i", slopes, solution.covariance[:count, :count], slopes)
    return float(np.sqrt(np.maximum(variances, 0)).max())


def _refusals(q: Quality, observations: fit.Observations, solution: fit.Solution) -> tuple[str, ...]:
    reasons = []
    if observations.views < LEAST_VIEWS:
        reasons.append(
            f"{observations.views} different view{'s' if observations.views != 1 else ''} of the board cannot "
            f"determine a lens: film at least {LEAST_VIEWS}, better 20, from different sides"
        )
    relative = _focal_sd(solution)
    if not relative <= FOCAL_SD_LIMIT:
        shown = f"± {100 * relative:.1f} %" if relative < 10 else "not known at all"
        reasons.append(
            f"the focal length is too uncertain ({shown}; the tilt of the boards varies by {np.rad2deg(q.tilt):.0f}°): "
            "tilt the board by 30 to 50° in all directions"
        )
    if not q.trusted_part >= LEAST_TRUSTED:
        seen, trusted = np.rad2deg(q.theta_max_observed), np.rad2deg(q.theta_max_trusted)
        reasons.append(
            f"no corner was seen beyond {seen:.0f}° from the axis, and rays are known to {np.rad2deg(TRUST_LIMIT):g}° "
            f"only up to {trusted:.0f}°, in {100 * q.trusted_part:.0f} % of the picture; film the board {_places(q)}"
        )
    if not q.rms_px <= 0.005 * np.hypot(*solution.parameters[2:4]) + 2.0:
        reasons.append(f"the fit failed: the corners are {q.rms_px:.1f} px (RMS) from where this lens projects them")
    return tuple(reasons)


def _advice(q: Quality, refusals: tuple[str, ...]) -> tuple[str, ...]:
    advice = []
    if q.theta_max_observed < 0.9 * q.theta_max_picture:
        advice.append(
            f"no corner was seen beyond {np.rad2deg(q.theta_max_observed):.0f}° from the axis, but the picture reaches "
            f"{np.rad2deg(q.theta_max_picture):.0f}°: film the board near the corners of the picture"
        )
    if q.empty > 0.2:
        advice.append(f"no corner was seen in {100 * q.empty:.0f} % of the picture: film the board {_places(q)}")
    if q.tilt < np.deg2rad(15):
        advice.append(f"the tilt of the boards varies by only {np.rad2deg(q.tilt):.0f}°: tilt the board more")
    if np.isfinite(q.held_out_rms_px) and q.held_out_rms_px > 1.2 * q.rms_px + 0.02:
        advice.append(
            f"the residual of pictures held out of the fit is {q.held_out_rms_px / q.rms_px:.1f} times as large: take "
            "more pictures"
        )
    if q.missed > MISSED_LIMIT:
        advice.append(
            "the lens model leaves errors that all pictures share: try --lens-model auto; no model here describes a "
            "camera that sees near things through a thick window"
        )
    if q.recedes > RECEDES_LIMIT:
        advice.append(
            "if the camera looks through a flat window, as under water, film the board about as far away as what it "
            "will watch, or use a dome"
        )
    if q.halves.ratio > HALVES_LIMIT:
        advice.append(
            f"lenses of halves of the pictures differ by {q.halves.actual_px:.2f} px, {q.halves.ratio:.1f} times what "
            "their stated uncertainty says: take more pictures of other kinds"
        )
    return () if refusals and not advice else tuple(advice)


def _places(q: Quality) -> str:
    """Name the parts of the picture where corners are missing, in words."""
    rows, columns = q.counts.shape
    names = []
    for label, ys in (("top", slice(0, rows // 3 or 1)), ("bottom", slice(rows - (rows // 3 or 1), rows))):
        for side, xs in (("left", slice(0, columns // 3)), ("right", slice(columns - columns // 3, columns))):
            light = q.lit_cells[ys, xs]
            if light.any() and (q.counts[ys, xs][light] == 0).mean() > 0.34:
                names.append(f"{label} {side}")
    if len(names) == 4 or not names:
        return "near the corners of the picture" if names else "closer, larger and more tilted"
    return f"at the {', the '.join(names[:-1])} and the {names[-1]}" if len(names) > 1 else f"at the {names[0]}"
