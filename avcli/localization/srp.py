"""Steered response power over a room, by a max-pooled coarse-to-fine search.

The response at a point is the mean over microphone pairs of the GCC at the lag that the point would cause (DiBiase
2000). Its peaks are only centimetres wide, so a grid of points would miss them: a cell is given, for each pair, the
largest GCC over all lags that points of the cell can cause (after Cobos, Marti & Lopez 2011). That bounds the response
in the cell from above; the best cells are cut into eight, again and again, down to the resolution.
"""

import numpy as np

from avcli.localization import correlation


class SteeredResponse:
    """The tables of one array, room and lag scale.

    Args:
        microphones: (m, 3) m.
        low, high: (3,) m, the corners of the searched volume.
        steps_per_metre: lag steps per metre of range difference.
        cell: m, the largest edge of a coarse cell.
        resolution: m, the largest edge of a finest cell.
        keep: how many cells go on to the next level.
    """

    def __init__(self, microphones, low, high, steps_per_metre, *, cell=0.25, resolution=0.02, keep=24):
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
        self.half_cell = 0.5 * extent / counts
        axes = [self.low[k] + self.half_cell[k] * (2.0 * np.arange(counts[k]) + 1.0) for k in range(3)]
        self.cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self.levels = max(0, int(np.ceil(np.log2(2.0 * self.half_cell.max() / resolution))))
        self.children = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        self.coarse = self._spans(self.cells, self.half_cell)
        self.ladder = int(self.coarse[1].max())

    def lags(self, points: np.ndarray) -> np.ndarray:
        """Return the lag steps (n, pairs) that sound from points (n, 3) m causes."""
        ranges = self._ranges(points)
        return (ranges[:, self.first] - ranges[:, self.second]) * self.steps_per_metre

    def _ranges(self, points: np.ndarray) -> np.ndarray:
        squares = (points**2).sum(axis=1)[:, None] + (self.microphones**2).sum(axis=1)
        return np.sqrt(np.maximum(squares - 2.0 * points @ self.microphones.T, 0.0))

    def _spans(self, centres: np.ndarray, half: np.ndarray):
        """Return where each cell's lags lie: flat index into the ladder's rung, rung, and the last run's flat index."""
        offsets = centres[:, None, :] - self.microphones
        ranges = np.sqrt((offsets**2).sum(axis=2))
        units = offsets / np.maximum(ranges, 1e-9)[:, :, None]
        gradient = np.abs(units[:, self.first] - units[:, self.second]) @ half
        middle = (ranges[:, self.first] - ranges[:, self.second]) * self.steps_per_metre
        reach = gradient * self.steps_per_metre + 0.5
        size = 2 * self.half_lags + 1
        lowest = np.clip(np.rint(middle - reach).astype(np.int32) + self.half_lags, 0, size - 1)
        highest = np.clip(np.rint(middle + reach).astype(np.int32) + self.half_lags, 0, size - 1)
        rung = np.frexp(highest - lowest + 1)[1] - 1  # floor(log2(length))
        row = np.arange(len(self.first), dtype=np.int32) * size
        return lowest + row, rung, highest - (1 << rung) + 1 + row

    def _ladder(self, gcc: np.ndarray) -> np.ndarray:
        """Return running maxima over 1, 2, 4... lags, (rungs, pairs * lags): two of them cover any run."""
        rungs = [gcc]
        for level in range(self.ladder):
            step = 1 << level
            wider = rungs[-1].copy()
            np.maximum(rungs[-1][:, :-step], rungs[-1][:, step:], out=wider[:, :-step])
            rungs.append(wider)
        return np.stack(rungs).reshape(len(rungs), -1)

    def bound(self, ladder: np.ndarray, spans) -> np.ndarray:
        """Return for each cell the mean over pairs of the largest GCC in it, (cells,)."""
        lowest, rung, last = spans
        offset = np.minimum(rung, self.ladder) * ladder.shape[1]
        flat = ladder.ravel()
        return np.maximum(flat[lowest + offset], flat[last + offset]).mean(axis=1)

    def response(self, gcc: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the response at points (n, 3) m, (n,): GCC interpolated linearly between lag steps."""
        lag = np.clip(self.lags(points) + self.half_lags, 0.0, 2.0 * self.half_lags - 1e-6)
        index = lag.astype(np.int64)
        fraction = lag - index
        row = np.arange(gcc.shape[0])
        return (gcc[row, index] * (1.0 - fraction) + gcc[row, index + 1] * fraction).mean(axis=1)

    def at(self, gcc: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return each pair's GCC at the lag of a place (3,) m, (pairs,)."""
        lag = np.clip(self.lags(position[None])[0] + self.half_lags, 0.0, 2.0 * self.half_lags)
        return _cubic(gcc, lag[:, None])[:, 0]

    def search(self, gcc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the centres (n, 3) m of the finest cells that were reached, best first, and their responses (n,)."""
        ladder = self._ladder(gcc)
        centres, half = self.cells, self.half_cell
        bound = self.bound(ladder, self.coarse)
        for _ in range(self.levels):
            best = np.argpartition(-bound, self.keep)[: self.keep] if len(bound) > self.keep else np.arange(len(bound))
            half = 0.5 * half
            centres = (centres[best][:, None, :] + self.children * (2.0 * half)).reshape(-1, 3)
            bound = self.bound(ladder, self._spans(centres, half))
        value = self.response(gcc, centres)
        order = np.argsort(-value, kind="stable")
        return centres[order], value[order]

    def follow(self, gccs, offsets, start: np.ndarray, max_speed: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Find the place and the level velocity near `start` that several windows answer best together.

        A talker who walks is elsewhere in each window: without the velocity the loudest window would win.

        Args:
            gccs: (pairs, lags) correlations of the windows.
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

        def best(places, velocities):
            points = np.clip(np.tile(places, (len(velocities), 1)), self.low, self.high)
            velocities = np.repeat(velocities, len(places), axis=0)
            total = np.zeros(len(points))
            for gcc, offset in zip(gccs, offsets, strict=True):
                total += self.response(gcc, np.clip(points + velocities * offset, self.low, self.high))
            index = int(np.argmax(total))
            return points[index], velocities[index], float(total[index]) / len(gccs)

        position, velocity, _ = best(position + 0.03 * _CUBE, velocity + changes)
        position, velocity, _ = best(position + 0.015 * _CUBE, velocity[None])
        # Most talkers stand or sit: rest is tried besides the neighbouring velocities, and by name.
        position, velocity, _ = best(position[None], np.concatenate([still, velocity + 0.5 * changes]))
        return best(position + 0.0075 * _CUBE, velocity[None])

    def _rough(self, gccs, offsets, start: np.ndarray, max_speed: float) -> tuple[np.ndarray, np.ndarray]:
        """Find place and velocity on a lattice, so that each window's response is taken once for all velocities.

        A walker's windows add up at a wrong height too, so that those which the middle window answers are tried.
        """
        step, reach, speeds = 0.04, 3, max_speed * np.linspace(-1.0, 1.0, 5)
        furthest = int(np.ceil(max_speed * np.abs(offsets).max() / step))
        # The lattice is wider than a peak: each lag stands for its neighbours within 3 steps too.
        pooled = [_dilate(gcc, 3) for gcc in gccs]
        around = step * np.array([[x, y] for y in range(-reach, reach + 1) for x in range(-reach, reach + 1)])
        heights = np.linspace(self.low[2], self.high[2], max(2, round((self.high[2] - self.low[2]) / 0.1)))
        columns = np.column_stack([np.tile(start[:2] + around, (len(heights), 1)), np.repeat(heights, len(around))])
        middle = pooled[int(np.argmin(np.abs(offsets)))]
        order = np.argsort(-self._nearest(middle, columns).reshape(len(heights), -1).max(axis=1), kind="stable")
        side = np.arange(2 * reach + 1)
        axis = step * np.arange(-reach - furthest, reach + furthest + 1)
        level = np.array([[x, y] for y in axis for x in axis])
        # Of nearly equal velocities the slower: noise must not make a still talker walk.
        slow = 1e-4 * np.hypot(speeds[:, None], speeds)[:, :, None, None]
        best, found = -np.inf, (start, np.zeros(3))
        for height in (start[2], *heights[order[:3]]):
            points = np.column_stack([start[:2] + level, np.full(len(level), height)])
            total = 0.0  # (vy, vx, y, x)
            for gcc, offset in zip(pooled, offsets, strict=True):
                values = self._nearest(gcc, points).reshape(len(axis), len(axis))
                shifts = furthest + np.rint(speeds * (offset / step)).astype(np.int64)
                row, column = shifts[:, None, None, None] + side[:, None], shifts[None, :, None, None] + side
                total = total + values[row, column]
            total = total / len(gccs) - slow
            place = int(np.argmax(total))
            if total.flat[place] > best:
                best = total.flat[place]
                vy, vx, y, x = np.unravel_index(place, total.shape)
                moved = np.array([start[0] + step * (x - reach), start[1] + step * (y - reach), height])
                found = (np.clip(moved, self.low, self.high), np.array([speeds[vx], speeds[vy], 0.0]))
        return found

    def _nearest(self, gcc: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the response at points (n, 3) m inside the volume, (n,), without interpolation."""
        size = 2 * self.half_lags + 1
        lag = np.rint(self.lags(np.clip(points, self.low, self.high))).astype(np.int64) + self.half_lags
        lag = np.clip(lag, 0, size - 1) + size * np.arange(len(self.first))
        return gcc.ravel()[lag].mean(axis=1)

    def ambiguity(self, gccs, offsets, position, velocity, sharpness: float) -> np.ndarray:
        """Return what other heights that are answered nearly as well add to a place's covariance, (3, 3) m².

        The microphones hang in one layer, so that heights far apart can be nearly equal; the curvature at one of them
        knows nothing of the others, nor of where in x and y they would have the source.

        Args:
            gccs, offsets: as for `follow`.
            position: (3,) m.
            velocity: (3,) m/s.
            sharpness: logarithm of the likelihood over the response.
        """
        step = 0.08
        below, above = int((position[2] - self.low[2]) / step), int((self.high[2] - position[2]) / step)
        away = np.zeros((below + 1 + above, 49, 3))
        away[:, :, :2] = 0.03 * np.array([[x, y] for y in range(-3, 4) for x in range(-3, 4)])
        away[:, :, 2] = step * np.arange(-below, above + 1)[:, None]
        places = (position + away).reshape(-1, 3)
        total = sum(self._nearest(gcc, places + velocity * offset) for gcc, offset in zip(gccs, offsets, strict=True))
        total = total.reshape(away.shape[:2]) / len(gccs)
        best = total.argmax(axis=1)
        away, profile = away[np.arange(len(away)), best], total.max(axis=1)
        likelihood = np.exp(sharpness * (profile - profile.max()))
        return np.einsum("n,ni,nj->ij", likelihood / likelihood.sum(), away, away)

    def aligned(self, gccs, offsets, position, velocity, reach: int) -> np.ndarray:
        """Return the mean GCC of the windows around the lags of a place that moves, (pairs, 2 reach + 1)."""
        total = 0.0
        around = np.arange(-reach, reach + 1)
        for gcc, offset in zip(gccs, offsets, strict=True):
            lag = self.lags((position + velocity * offset)[None])[0] + self.half_lags
            total = total + _cubic(gcc, np.clip(lag, reach, 2 * self.half_lags - reach)[:, None] + around)
        return total / len(gccs)

    def differences(self, aligned: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the range differences (pairs,) m of the peaks near a place's lags, and the peaks' heights."""
        reach = aligned.shape[1] // 2
        row = np.arange(len(aligned))
        peak = 1 + np.argmax(aligned[:, 1:-1], axis=1)
        offset = correlation.interpolate_peak(aligned[row, peak - 1], aligned[row, peak], aligned[row, peak + 1])
        steps = self.lags(position[None])[0] + peak - reach + offset
        return steps / self.steps_per_metre, aligned[row, peak]

    def aligned_at(self, aligned: np.ndarray, position: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return each pair's GCC (pairs,) at `moved` (3,) m, given `aligned` for `position`; 0 out of reach."""
        reach = aligned.shape[1] // 2
        lag = (self.lags(moved[None]) - self.lags(position[None]))[0] + reach
        if lag.min() < 0.0 or lag.max() > 2 * reach:
            return np.zeros(len(aligned))
        return _cubic(aligned, lag[:, None])[:, 0]

    def notch(self, gcc: np.ndarray, position: np.ndarray, width: float) -> np.ndarray:
        """Return the GCC without what a place (3,) m adds: 0 up to `width` m from its lag, whole from twice that."""
        lag = self.lags(position[None])[0]
        distance = np.abs(np.arange(-self.half_lags, self.half_lags + 1) - lag[:, None]) / self.steps_per_metre
        return gcc * np.clip(distance / width - 1.0, 0.0, 1.0).astype(np.float32)

    def notch_echoes(self, gcc: np.ndarray, position: np.ndarray, room: np.ndarray, width: float) -> np.ndarray:
        """Return the GCC without what the first echoes of a place add, each notched as by `notch`.

        Where an echo stands in one channel and the direct sound, or an echo, in the other, pairs come to agree on
        places at which nobody is. Such a ghost is as still as its talker and lasts as long, so that no time tells the
        two apart; but where the echoes stand follows from the room (Allen & Berkley 1979). All meetings of direct
        sound and echoes with no more than two reflections together are taken away.

        Args:
            gcc: (pairs, lags).
            position: (3,) m.
            room: (3,) m, the far corner of a room whose near corner is the origin.
            width: m.
        """
        images = np.where(_IMAGES % 2 == 0, position, room - position) + _IMAGES * room
        ranges = self._ranges(images) * self.steps_per_metre
        one, other = _MEETINGS
        lags = np.rint(ranges[one][:, self.first] - ranges[other][:, self.second]).astype(np.int64) + self.half_lags
        inside = (lags >= 0) & (lags <= 2 * self.half_lags)
        lag, row = lags[inside], np.broadcast_to(np.arange(len(gcc)), lags.shape)[inside]
        gain = np.ones_like(gcc)
        reach = int(2.0 * width * self.steps_per_metre)
        for distance in range(reach, -1, -1):  # the nearest last, so that the deepest notch holds
            depth = max(distance / (width * self.steps_per_metre) - 1.0, 0.0)
            for side in (-distance, distance):
                gain[row, np.clip(lag + side, 0, 2 * self.half_lags)] = depth
        return gcc * gain


_IMAGES = np.array([[x, y, z] for x in range(-2, 3) for y in range(-2, 3) for z in range(-2, 3)])
_IMAGES = _IMAGES[np.abs(_IMAGES).sum(axis=1) <= 2]
"""How often each image of a place was mirrored, to which side, along each axis (images, 3)."""

_REFLECTIONS = np.abs(_IMAGES).sum(axis=1)
_MEETINGS = np.nonzero(np.isin(_REFLECTIONS[:, None] + _REFLECTIONS, (1, 2)))
"""Which image stands in a pair's first channel and which in its second: one or two reflections together."""

_CUBE = np.array([[x, y, z] for z in (0, -1, 1) for y in (0, -1, 1) for x in (0, -1, 1)], dtype=np.float64)


def _cubic(rows: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate each row (n, lags) at fractional indices (n, k) by the cubic of Catmull & Rom (1974)."""
    whole = np.clip(at.astype(np.int64), 1, rows.shape[1] - 3)
    t = at - whole
    row = np.arange(len(rows))[:, None]
    before, here, there, after = (rows[row, whole + i] for i in (-1, 0, 1, 2))
    slope, next_slope = 0.5 * (there - before), 0.5 * (after - here)
    return here + t * (
        slope + t * (3.0 * (there - here) - 2.0 * slope - next_slope + t * (2.0 * (here - there) + slope + next_slope))
    )


def _dilate(gcc: np.ndarray, reach: int) -> np.ndarray:
    """Return each lag's maximum within ± reach lags."""
    wide = gcc.copy()
    for step in range(1, reach + 1):
        np.maximum(wide[:, step:], gcc[:, :-step], out=wide[:, step:])
        np.maximum(wide[:, :-step], gcc[:, step:], out=wide[:, :-step])
    return wide
