"""Steered response power over a room, by a max-pooled coarse-to-fine search.

The response at a point is the mean over microphone pairs of the GCC at the lag that the point would cause (DiBiase
2000). Its peaks are only centimetres wide, so a grid of points would miss them: a cell is given, for each pair, the
largest GCC over all lags that points of the cell can cause (after Cobos, Marti & Lopez 2011). That bounds the response
in the cell from above; the best cells are cut into eight, again and again, down to the resolution.
"""

from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from avcli.localization import correlation

_MOST = 100_000_000
"""Pairs times coarse cells; each takes some 80 bytes: eight microphones in 200 m × 200 m take 8 GB."""


class SteeredResponse:
    """The tables of one array, room and lag scale.

    Args:
        microphones: (m, 3) m.
        low, high: (3,) m, the corners of the searched volume.
        steps_per_metre: lag steps per metre of range difference.
        cell: m, the largest edge of a coarse cell.
        resolution: m, the largest edge of a finest cell.
        keep: how many cells go on to the next level.

    Raises:
        ValueError: the tables would need more memory than machines have.
    """

    def __init__(
        self,
        microphones: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        steps_per_metre: float,
        *,
        cell: float = 0.25,
        resolution: float = 0.02,
        keep: int = 24,
    ):
        self.microphones = np.asarray(microphones, dtype=np.float64)
        self.low, self.high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        self.steps_per_metre = steps_per_metre
        self.keep = keep
        first, second = correlation.pairs(len(self.microphones))
        self.first, self.second = first, second
        baseline = np.linalg.norm(self.microphones[first] - self.microphones[second], axis=1)
        self.half_lags = int(np.ceil(baseline.max() * steps_per_metre)) + 2
        extent = self.high - self.low
        counts = np.maximum(np.ceil(extent / cell), 1.0).astype(int)
        if len(first) * counts.astype(float).prod() > _MOST:
            x, y, _ = extent
            raise ValueError(
                f"a room of {x:.4g} × {y:.4g} m is too large to search in cells of {cell:g} m: is room_dimensions_m "
                "in metres?"
            )
        self.flat = bool(extent[2] == 0.0)
        self.half_cell = 0.5 * extent / counts
        axes = [self.low[k] + self.half_cell[k] * (2.0 * np.arange(counts[k]) + 1.0) for k in range(3)]
        self.cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self.levels = max(0, int(np.ceil(np.log2(2.0 * self.half_cell.max() / resolution))))
        self.children = np.array(list(product(*((-0.5, 0.5) if edge > 0.0 else (0.0,) for edge in extent))))
        self.lag_count = 2 * self.half_lags + 1
        self.rows = np.arange(len(first))[:, None] * self.lag_count
        # Which rung of the ladder a run of so many lags stands on: floor(log2(length)), as high as coarse cells need.
        self.rung = np.frexp(np.arange(self.lag_count + 1))[1] - 1
        lowest, highest = self._runs(self.cells, self.half_cell)
        self.highest = int(self.rung[(highest - lowest).max() + 1])
        self.rung = np.minimum(self.rung, self.highest)
        self.coarse = self._spans(self.cells, self.half_cell)

    def lags(self, points: np.ndarray) -> np.ndarray:
        """Return the lag steps (pairs, n) that sound from points (n, 3) m causes; none exceeds `half_lags` - 2."""
        ranges = self._ranges(points)
        return (ranges[self.first] - ranges[self.second]) * self.steps_per_metre

    def _ranges(self, points: np.ndarray) -> np.ndarray:
        squares = (self.microphones**2).sum(axis=1)[:, None] + (points**2).sum(axis=1)
        return np.sqrt(np.maximum(squares - 2.0 * self.microphones @ points.T, 0.0))

    def _runs(self, centres: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and the last lag, from 0, that points of each cell can cause, two (pairs, cells)."""
        offsets = (centres.T[:, None, :] - self.microphones.T[:, :, None]).astype(np.float32)
        ranges = np.sqrt(offsets[0] ** 2 + offsets[1] ** 2 + offsets[2] ** 2)
        units = offsets / np.maximum(ranges, np.float32(1e-9))
        gradient = units[:, self.first]
        gradient -= units[:, self.second]
        np.abs(gradient, out=gradient)
        scale = np.float32(self.steps_per_metre)
        x, y, z = (scale * half).astype(np.float32)
        middle = (ranges[self.first] - ranges[self.second]) * scale + np.float32(self.half_lags)
        reach = gradient[0] * x + gradient[1] * y + gradient[2] * z + np.float32(0.5)
        last = self.lag_count - 1
        lowest = np.maximum(np.rint(middle - reach).astype(np.intp), 0)
        return lowest, np.minimum(np.rint(middle + reach).astype(np.intp), last)

    def _spans(self, centres: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the two places in the flat ladder whose maxima cover each cell's lags, two (pairs, cells)."""
        lowest, highest = self._runs(centres, half)
        rung = self.rung[highest - lowest + 1]
        base = rung * self.lag_count + self.rows * (self.highest + 1)
        return base + lowest, base + highest + 1 - (1 << rung)

    def ladder(self, gcc: np.ndarray) -> np.ndarray:
        """Return running maxima over 1, 2, 4... lags of GCCs, (pairs, rungs, lags): two of them cover any run."""
        rungs = np.empty((len(gcc), self.highest + 1, self.lag_count), gcc.dtype)
        rungs[:, 0] = gcc
        for level in range(self.highest):
            step = 1 << level
            np.maximum(rungs[:, level, :-step], rungs[:, level, step:], out=rungs[:, level + 1, :-step])
            rungs[:, level + 1, -step:] = rungs[:, level, -step:]
        return rungs

    def bound(self, ladder: np.ndarray, spans: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Return for each cell the mean over pairs of the largest GCC in it, (cells,)."""
        flat = ladder.ravel()
        largest = flat.take(spans[0])
        return np.maximum(largest, flat.take(spans[1]), out=largest).mean(axis=0)

    def response(self, gcc: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the response at points (n, 3) m, (n,): GCC interpolated linearly between lag steps."""
        return self._responses(gcc[None], points[None])

    def _responses(self, gccs: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the mean response (n,) of windows (w, pairs, lags), each at its own points (w, n, 3) m."""
        windows, count = points.shape[:2]
        lag = self.lags(points.reshape(-1, 3)) + self.half_lags
        index = lag.astype(np.intp)
        fraction = (lag - index).astype(np.float32)
        flat = gccs.ravel()
        at = index + self.rows + np.repeat(np.arange(windows) * gccs[0].size, count)
        here = flat.take(at)
        value = here + (flat.take(at + 1) - here) * fraction
        return value.mean(axis=0, dtype=np.float64).reshape(windows, count).mean(axis=0)

    def at(self, gcc: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return each pair's GCC at the lag of a place (3,) m, (pairs,)."""
        return interpolated(gcc, self.lags(position[None]) + self.half_lags)[:, 0]

    def most(self, ladder: np.ndarray) -> float:
        """Return a number that no place's response reaches beyond, of a ladder, in a tenth of a search."""
        return float(self.bound(ladder, self.coarse).max())

    def search(
        self, gcc: np.ndarray, keep: int | None = None, *, ladder: np.ndarray | None = None, least: float = -np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the centres (n, 3) m of the finest cells that were reached, best first, and their responses (n,).

        Args:
            gcc: (pairs, lags).
            keep: how many cells go on to the next level; None: as many as usual.
            ladder: of the GCC; None: it is made here.
            least: where it shows that no response reaches so much, none is returned.
        """
        keep = keep or self.keep
        ladder = self.ladder(gcc) if ladder is None else ladder
        centres, half = self.cells, self.half_cell
        bound = self.bound(ladder, self.coarse)
        for _ in range(self.levels):
            if bound.max() < least:
                return centres[:0], bound[:0]
            best = np.argpartition(-bound, keep)[:keep] if len(bound) > keep else np.arange(len(bound))
            half = 0.5 * half
            centres = (centres[best][:, None, :] + self.children * (2.0 * half)).reshape(-1, 3)
            bound = self.bound(ladder, self._spans(centres, half))
        value = self.response(gcc, centres)
        order = np.argsort(-value, kind="stable")
        return centres[order], value[order]

    def follow(
        self, gccs: np.ndarray, offsets: np.ndarray, start: np.ndarray, max_speed: float
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Find the place and the level velocity near `start` that several windows answer best together.

        A talker who walks is elsewhere in each window: without the velocity the loudest window would win.

        Args:
            gccs: (windows, pairs, lags) correlations.
            offsets: (windows,) s of each window from the one that is asked about.
            start: (3,) m.
            max_speed: m/s along each axis.

        Returns:
            position (3,) m, velocity (3,) m/s, mean response of the windows.
        """
        position, velocity = np.asarray(start, dtype=np.float64), np.zeros(3)
        still = changes = np.zeros((1, 3))
        if len(gccs) > 1 and max_speed > 0.0:
            position, velocity = self._rough(gccs, offsets, position, max_speed)
            speeds = max_speed * np.array([0.0, -0.25, 0.25])
            changes = np.array([[x, y, 0.0] for y in speeds for x in speeds])

        def best(places: np.ndarray, velocities: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
            points = self._inside(np.tile(places, (len(velocities), 1)))
            velocities = np.repeat(velocities, len(places), axis=0)
            moved = points + offsets[:, None, None] * velocities
            total = self._responses(gccs, self._inside(moved))
            index = int(np.argmax(total))
            return points[index], velocities[index], float(total[index])

        position, velocity, _ = best(position + 0.03 * _CUBE, velocity + changes)
        position, velocity, _ = best(position + 0.015 * _CUBE, velocity[None])
        # Most talkers stand or sit: rest is tried besides the neighbouring velocities, and by name.
        position, velocity, _ = best(position[None], np.concatenate([still, velocity + 0.5 * changes]))
        return best(position + 0.0075 * _CUBE, velocity[None])

    def _rough(
        self, gccs: np.ndarray, offsets: np.ndarray, start: np.ndarray, max_speed: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find place and velocity on a lattice, so that each window's response is taken once for all velocities.

        A walker's windows add up at a wrong height too, so that those which the middle window answers are tried.
        """
        step, reach, speeds = 0.04, 3, max_speed * np.linspace(-1.0, 1.0, 5)
        # The lattice is wider than a peak: each lag stands for its neighbours within 3 steps too.
        pooled = dilated(gccs, 3)
        heights = np.linspace(self.low[2], self.high[2], max(2, round((self.high[2] - self.low[2]) / 0.1)))
        middle = int(np.argmin(np.abs(offsets)))
        seen = self._nearest(pooled[middle], _lattice(start, step, reach, heights)).reshape(len(heights), -1)
        order = np.argsort(-seen.max(axis=1), kind="stable")
        heights = np.array([start[2], *heights[order[:3]]])
        side = np.arange(2 * reach + 1)
        total: np.ndarray | np.float32 = np.float32(0.0)  # (height, vy, vx, y, x)
        for gcc, offset in zip(pooled, offsets, strict=True):
            shifts = np.rint(speeds * (offset / step)).astype(np.intp)
            furthest = int(np.abs(shifts).max())
            values = self._nearest(gcc, _lattice(start, step, reach + furthest, heights))
            values = values.reshape(len(heights), 2 * (reach + furthest) + 1, -1)
            at = furthest + shifts[:, None] + side
            total = total + values[:, at[:, None, :, None], at[None, :, None, :]]
        # Of nearly equal velocities the slower: noise must not make a still talker walk.
        total = total / len(gccs) - 1e-4 * np.hypot(speeds[:, None], speeds)[:, :, None, None]
        height, vy, vx, y, x = np.unravel_index(int(np.argmax(total)), total.shape)
        moved = np.array([start[0] + step * (x - reach), start[1] + step * (y - reach), heights[height]])
        return self._inside(moved), np.array([speeds[vx], speeds[vy], 0.0])

    def _inside(self, points: np.ndarray) -> np.ndarray:
        """Return the points of the volume that are nearest to points (..., 3) m."""
        return np.minimum(np.maximum(points, self.low), self.high)

    def _nearest(self, gcc: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the response at points (n, 3) m, or at those of the volume nearest to them, without interpolation."""
        lag = np.rint(self.lags(self._inside(points))).astype(np.intp)
        return gcc.ravel().take(lag + (self.rows + self.half_lags)).mean(axis=0)

    def ambiguity(
        self,
        gccs: np.ndarray,
        offsets: np.ndarray,
        position: np.ndarray,
        velocity: np.ndarray,
        sharpness: float,
    ) -> np.ndarray:
        """Return how far around a place those spread that are answered nearly as well, as a covariance (3, 3) m².

        The microphones hang in one layer, so that heights far apart can be nearly equal; the curvature at one of them
        knows nothing of the others, nor of where in x and y they would have the source.

        Args:
            gccs, offsets: as for `follow`.
            position: (3,) m.
            velocity: (3,) m/s.
            sharpness: logarithm of the likelihood over the response.
        """
        step = 0.1
        below, above = int((position[2] - self.low[2]) / step), int((self.high[2] - position[2]) / step)
        away = _lattice(np.zeros(3), 0.03, 4, step * np.arange(-below, above + 1))
        if velocity.any():
            each = [self._nearest(gcc, position + velocity * t + away) for gcc, t in zip(gccs, offsets, strict=True)]
            total = np.mean(each, axis=0)
        else:
            total = self._nearest(gccs.mean(axis=0), position + away)
        likelihood = np.exp(sharpness * (total.astype(np.float64) - total.max()))
        return (away.T * (likelihood / likelihood.sum())) @ away

    def aligned(
        self, gccs: np.ndarray, offsets: np.ndarray, position: np.ndarray, velocity: np.ndarray, reach: int
    ) -> np.ndarray:
        """Return the mean GCC of the windows around the lags of a place that moves, (pairs, 2 reach + 1)."""
        lag = self.lags(position + velocity * offsets[:, None]).T + self.half_lags
        lag = np.clip(lag, reach, 2 * self.half_lags - reach)[:, :, None] + np.arange(-reach, reach + 1)
        rows = gccs.reshape(-1, self.lag_count)
        return interpolated(rows, lag.reshape(len(rows), -1)).reshape(lag.shape).mean(axis=0)

    def differences(self, aligned: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the range differences (pairs,) m of the peaks near a place's lags, and the peaks' heights."""
        reach = aligned.shape[1] // 2
        row = np.arange(len(aligned))
        peak = 1 + np.argmax(aligned[:, 1:-1], axis=1)
        offset = correlation.interpolate_peak(aligned[row, peak - 1], aligned[row, peak], aligned[row, peak + 1])
        steps = self.lags(position[None])[:, 0] + peak - reach + offset
        return steps / self.steps_per_metre, aligned[row, peak]

    def aligned_at(self, aligned: np.ndarray, position: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return each pair's GCC (pairs,) at `moved` (3,) m, given `aligned` for `position`; 0 out of reach."""
        reach = aligned.shape[1] // 2
        before, after = self.lags(np.stack([position, moved])).T
        lag = after - before + reach
        if lag.min() < 0.0 or lag.max() > 2 * reach:
            return np.zeros(len(aligned))
        return interpolated(aligned, lag[:, None])[:, 0]

    def notch(self, gccs: np.ndarray, places: np.ndarray, width: float) -> np.ndarray:
        """Return GCCs without what a place adds: 0 up to `width` m from its lag, whole from twice that.

        Args:
            gccs: (windows, pairs, lags).
            places: (windows, 3) m, or (1, 3) for all windows.
            width: m.
        """
        lag = self.lags(places).T[:, :, None].astype(np.float32)
        distance = np.abs(np.arange(-self.half_lags, self.half_lags + 1, dtype=np.float32) - lag)
        distance *= np.float32(1.0 / (self.steps_per_metre * width))
        distance -= np.float32(1.0)
        return gccs * np.clip(distance, 0.0, 1.0, out=distance)

    def notch_echoes(self, gccs: np.ndarray, places: np.ndarray, room: np.ndarray, width: float) -> np.ndarray:
        """Return GCCs without what the first echoes of a place add, each notched as by `notch`.

        Where an echo stands in one channel and the direct sound, or an echo, in the other, pairs come to agree on
        places at which nobody is. Such a ghost is as still as its talker and lasts as long, so that no time tells the
        two apart; but where the echoes stand follows from the room (Allen & Berkley 1979). All meetings of direct
        sound and echoes with no more than two reflections together are taken away.

        Args:
            gccs, places, width: as for `notch`.
            room: (3,) m, the far corner of a room whose near corner is the origin.
        """
        one, other = _MEETINGS
        reach = int(2.0 * width * self.steps_per_metre)
        gain = np.ones((len(places), len(self.first), self.lag_count + 2 * reach), np.float32)
        rows = np.arange(len(self.first))[:, None] * gain.shape[2] + reach + self.half_lags
        for place, flat in zip(places, gain.reshape(len(places), -1), strict=True):
            images = np.where(_IMAGES % 2 == 0, place, room - place) + _IMAGES * room
            ranges = self._ranges(images) * self.steps_per_metre
            lag = np.rint(ranges[self.first][:, one] - ranges[self.second][:, other]).astype(np.intp)
            at = (lag + rows)[np.abs(lag) <= self.half_lags]
            for distance in range(reach, -1, -1):  # the nearest last, so that the deepest notch holds
                depth = max(distance / (width * self.steps_per_metre) - 1.0, 0.0)
                flat[at - distance] = flat[at + distance] = depth
        return gccs * gain[:, :, reach : reach + self.lag_count]


_IMAGES = np.array([[x, y, z] for x in range(-2, 3) for y in range(-2, 3) for z in range(-2, 3)])
_IMAGES = _IMAGES[np.abs(_IMAGES).sum(axis=1) <= 2]
"""How often each image of a place was mirrored, to which side, along each axis (images, 3)."""

_REFLECTIONS = np.abs(_IMAGES).sum(axis=1)
_MEETINGS = np.nonzero(np.isin(_REFLECTIONS[:, None] + _REFLECTIONS, (1, 2)))
"""Which image stands in a pair's first channel and which in its second: one or two reflections together."""

_CUBE = np.array([[x, y, z] for z in (0, -1, 1) for y in (0, -1, 1) for x in (0, -1, 1)], dtype=np.float64)


def _lattice(centre: np.ndarray, step: float, reach: int, heights: np.ndarray) -> np.ndarray:
    """Return for each height (n,) m the points around (x, y), `step` m apart, (n (2 reach + 1)², 3): x varies first."""
    side = step * np.arange(-reach, reach + 1)
    points = np.empty((len(heights), len(side), len(side), 3))
    points[..., 0], points[..., 1] = centre[0] + side, centre[1] + side[:, None]
    points[..., 2] = heights[:, None, None]
    return points.reshape(-1, 3)


def interpolated(rows: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate each row (n, lags) at fractional indices (n, k) by the cubic of Catmull & Rom (1974)."""
    whole = np.clip(at.astype(np.intp), 1, rows.shape[1] - 3)
    t = at - whole
    flat, index = rows.ravel(), whole + np.arange(len(rows))[:, None] * rows.shape[1]
    before, here, there, after = (flat.take(index + i) for i in (-1, 0, 1, 2))
    slope, next_slope = 0.5 * (there - before), 0.5 * (after - here)
    return here + t * (
        slope + t * (3.0 * (there - here) - 2.0 * slope - next_slope + t * (2.0 * (here - there) + slope + next_slope))
    )


def dilated(gccs: np.ndarray, reach: int) -> np.ndarray:
    """Return each lag's maximum within ± reach lags."""
    wide = np.pad(gccs, ((0, 0), (0, 0), (reach, reach)))
    width = 1  # of the runs whose maxima there are; the next are no more than twice as wide
    while width < 2 * reach + 1:
        step = min(width, 2 * reach + 1 - width)
        wide = np.maximum(wide[..., :-step], wide[..., step:])
        width += step
    return wide
