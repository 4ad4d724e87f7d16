"""Image sources of a shoebox room, and the impulse responses that they sum to.

Source and microphone are interchangeable (reciprocity), so the images here are images of the microphone: they stand
still while the source walks. Image (n, q) of an axis of length L lies at (1 − 2q) m + 2 n L and has met the wall at 0
|n − q| times and the wall at L |n| times (J. B. Allen and D. A. Berkley, 1979, eq. 10).
"""

import functools
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from avcli.acoustics.absorption import audible_time, volume
from avcli.numeric import SPEED_OF_SOUND_M_S, fft_length

NEAREST_M = 0.001
"""m; a source nearer to a microphone than this is as loud as at this distance."""
WHOLE_DB = -55.0
"""dB; for a smaller error all images are taken, which costs less than a choice among them."""
SINGLE_DB = -60.0
"""dB; for a larger error single precision is enough: in S1 it leaves -88 dB, from 8 to 11 kHz -77 dB."""
MOST_IMAGES = 10_000_000
"""images of one microphone; beyond them a response would take gigabytes and seconds."""


CELLS_AT_ONCE = 1 << 18
"""cells that are transformed at once: numpy prepares each call, which takes as long as a transform of 20,000 cells."""


def at_once(cells: int) -> int:
    """Return how many sums of so many cells are transformed at once."""
    return max(1, min(CELLS_AT_ONCE // cells, 16))


class _Scratch(threading.local):
    """Memory that is used again."""

    def __init__(self) -> None:
        self.held: dict[str, np.ndarray] = {}


_SCRATCH = _Scratch()


def scratch(use: str, shape: tuple[int, ...], dtype: DTypeLike = float) -> np.ndarray:
    """Return memory for a use, with anything in it, until this thread calls for the same use: an array of a shape.

    To ask the system for it each time takes as long as to compute with it.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if use not in _SCRATCH.held or _SCRATCH.held[use].size < size:
        _SCRATCH.held[use] = np.empty(size, np.uint8)
    return _SCRATCH.held[use][:size].view(dtype).reshape(shape)


@dataclass(frozen=True)
class Images:
    """The images of one microphone.

    Attributes:
        positions: (3, n) m.
        gains: (n,) product of the reflection coefficients on the way.
        mirrored: (3, n) −1 where an axis is seen mirrored, otherwise +1.
    """

    positions: np.ndarray
    gains: np.ndarray
    mirrored: np.ndarray

    def __len__(self) -> int:
        return len(self.gains)

    def __getitem__(self, chosen: np.ndarray) -> "Images":
        # Not positions[:, chosen], of which the rows are not contiguous, and slow ever after.
        chosen = np.arange(len(self))[chosen]
        return Images(*(whole.take(chosen, axis=-1) for whole in (self.positions, self.gains, self.mirrored)))

    def distances(self, source_m: np.ndarray) -> np.ndarray:
        """Return the distances from a source, (n,) m, in the precision of the positions."""
        source = source_m.astype(self.positions.dtype)
        squares = self.positions[0] - source[0]
        squares *= squares
        difference = np.empty_like(squares)
        for axis in (1, 2):
            np.subtract(self.positions[axis], source[axis], out=difference)
            difference *= difference
            squares += difference
        return np.sqrt(squares, out=squares)

    def in_precision_for(self, error_db: float) -> "Images":
        """Return the images in single precision where that leaves a smaller error than this, dB."""
        if error_db <= SINGLE_DB:
            return self
        return Images(self.positions.astype(np.float32), self.gains.astype(np.float32), self.mirrored)

    def orders(self, room_dimensions_m: np.ndarray, microphone_m: np.ndarray) -> np.ndarray:
        """Return how often the sound of each has met each wall x0 x1 y0 y1 z0 z1, (6, n).

        Args:
            room_dimensions_m: (3,) m.
            microphone_m: (3,) m, whose images they are.
        """
        around = np.rint((self.positions - self.mirrored * microphone_m[:, None]) / (2 * room_dimensions_m[:, None]))
        return np.abs(np.stack([around - (self.mirrored < 0), around], axis=1)).reshape(6, -1)

    def moved(self, by_m: np.ndarray) -> "Images":
        """Return the images when the microphone has moved: each moves as it is mirrored.

        Args:
            by_m: (3,) m.
        """
        return Images(self.positions + self.mirrored * by_m[:, None], self.gains, self.mirrored)

    def at_arrival(
        self, source_m: np.ndarray, path_m: np.ndarray, step_m: float
    ) -> tuple["Images", np.ndarray, np.ndarray]:
        """Return the images of a moving microphone where they are when a sound that is emitted now reaches them.

        The path length r of the sound solves |image(r) − source| = r, by Newton's method to 1e-7 m: a step of 1 mm
        leaves an error of (v/c)² (1 mm)² / 2d.

        Args:
            source_m: (3,) m, at the emission.
            path_m: (k, 3) m, how far the microphone has moved from where these images belong to it, each time that
                the sound has travelled step_m further; linear in between.
            step_m: m.

        Returns:
            The images, the path lengths, (n,) m, and the speed at which each recedes, (n,) in speeds of sound.
        """
        steps = np.diff(path_m, axis=0).T
        lengths = self.distances(source_m)
        for _ in range(20):
            cells = np.minimum((lengths / step_m).astype(np.intp), steps.shape[1] - 1)
            velocities = self.mirrored * (steps[:, cells] / step_m)
            positions = self.positions + self.mirrored * path_m.T[:, cells] + velocities * (lengths - cells * step_m)
            away = positions - source_m[:, None]
            distances = np.sqrt((away**2).sum(axis=0))
            receding = (away * velocities).sum(axis=0) / np.maximum(distances, 1e-9)
            change = (distances - lengths) / (1 - receding)
            lengths += change
            if np.abs(change).max(initial=0.0) < 1e-3:
                break
        return Images(positions, self.gains, self.mirrored), lengths, receding

    def amplitudes(self, distances: np.ndarray) -> np.ndarray:
        """Return the amplitudes at these distances, (n,): gain / (4π d), with d at least NEAREST_M."""
        if len(distances) and distances.min() < NEAREST_M:
            distances = np.maximum(distances, NEAREST_M)
        amplitudes = self.gains / distances
        amplitudes *= 1 / (4 * np.pi)
        return amplitudes


def image_count(room_dimensions_m: ArrayLike, reach_m: float) -> float:
    """Return about how many images lie within a distance: 4/3 π r³ / V.

    Args:
        room_dimensions_m: (3,) m.
        reach_m: m.
    """
    return 4 / 3 * np.pi * reach_m**3 / volume(room_dimensions_m)


def image_microphones(
    room_dimensions_m: ArrayLike, microphone_m: ArrayLike, reflection: ArrayLike, source_m: ArrayLike, reach_m: float
) -> Images:
    """Return all images of a microphone that a source hears within a distance.

    Args:
        room_dimensions_m: (3,) m.
        microphone_m: (3,) m.
        reflection: (6,) signed pressure coefficients of the walls x0 x1 y0 y1 z0 z1.
        source_m: (3,) m.
        reach_m: m, the longest way.

    Raises:
        ValueError: there are more than MOST_IMAGES of them.
    """
    (x, gx, mx), (y, gy, my), (z, gz, mz), order, counts = _within(
        room_dimensions_m, microphone_m, reflection, source_m, reach_m
    )
    iy, iz = np.divmod(order, len(z))

    def of_images(of_x: np.ndarray, of_y: np.ndarray, of_z: np.ndarray) -> np.ndarray:
        """Values of the axes for each image, (3, n): slices are copied, which is faster than a look-up."""
        values = np.empty((3, counts.sum()), of_x.dtype)
        values[0] = np.repeat(of_x, counts)
        for row, by_order in ((1, of_y[iy]), (2, of_z[iz])):
            np.concatenate([by_order[:count] for count in counts], out=values[row])
        return values

    gains = of_images(gx, gy, gz)
    return Images(of_images(x, y, z), gains[0] * gains[1] * gains[2], of_images(mx, my, mz))


def arrivals(
    room_dimensions_m: ArrayLike, microphone_m: ArrayLike, reflection: ArrayLike, source_m: ArrayLike, reach_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances, (n,) m, and gains, (n,), of the images of `image_microphones` and nothing else of them.

    This takes a third of the time.

    Args and Raises: as `image_microphones`.
    """
    (x, gx, _), (y, gy, _), (z, gz, _), order, counts = _within(
        room_dimensions_m, microphone_m, reflection, source_m, reach_m
    )
    source = np.asarray(source_m, dtype=float)
    square = np.add.outer((y - source[1]) ** 2, (z - source[2]) ** 2).ravel()[order]
    gain = np.multiply.outer(gy, gz).ravel()[order]
    squares = np.concatenate([square[:count] for count in counts])
    gains = np.concatenate([gain[:count] for count in counts])
    squares += np.repeat((x - source[0]) ** 2, counts)
    gains *= np.repeat(gx, counts)
    return np.sqrt(squares, out=squares), gains


_OfAxis = tuple[np.ndarray, np.ndarray, np.ndarray]


def _within(
    room_dimensions_m: ArrayLike, microphone_m: ArrayLike, reflection: ArrayLike, source_m: ArrayLike, reach_m: float
) -> tuple[_OfAxis, _OfAxis, _OfAxis, np.ndarray, np.ndarray]:
    """Return the images along each axis and which combinations lie within reach: the first of an order, for each x."""
    room, microphone, source = (np.asarray(v, dtype=float) for v in (room_dimensions_m, microphone_m, source_m))
    coefficients = np.asarray(reflection, dtype=float).reshape(3, 2)
    _refuse_too_many(room, coefficients, reach_m)
    x, y, z = (_axis(*of_axis, reach_m) for of_axis in zip(room, microphone, coefficients, source, strict=True))
    square_yz = np.add.outer((y[0] - source[1]) ** 2, (z[0] - source[2]) ** 2).ravel()
    order = np.argsort(square_yz, kind="stable")
    counts = np.searchsorted(square_yz[order], reach_m**2 - (x[0] - source[0]) ** 2, side="right")
    return x, y, z, order, counts


def _refuse_too_many(room: np.ndarray, reflection: np.ndarray, reach_m: float) -> None:
    if np.all(reflection != 0) and image_count(room, reach_m) > MOST_IMAGES:
        raise ValueError(
            f"sound reaches {image_count(room, reach_m):.2g} images of each microphone within {reach_m:.0f} m, "
            f"too many: at most {MOST_IMAGES:.2g} are possible"
        )


def _axis(
    length: float, microphone: float, coefficients: np.ndarray, source: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions, gains and mirror signs of a microphone's images along one axis."""
    most = int(reach / (2 * length)) + 2
    n = np.repeat(np.arange(-most, most + 1), 2)
    q = np.tile([0, 1], 2 * most + 1)
    positions = (1 - 2 * q) * microphone + 2 * n * length
    gains = coefficients[0] ** np.abs(n - q) * coefficients[1] ** np.abs(n)
    kept = (gains != 0) & (np.abs(positions - source) <= reach)
    return positions[kept], gains[kept], (1 - 2 * q).astype(np.int8)[kept]


def audible(
    delays: np.ndarray, amplitudes: np.ndarray, error_db: float, coarse_db: float = -np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return which images a response needs, so that what is left out stays below an error, and which need be exact.

    The faintest are left out, and the faintest of those that are kept need not be exact: together they stay below
    another energy. Both are measured on the response rounded to samples, since images that fall on one sample add up
    there.

    Args:
        delays: (n,) samples.
        amplitudes: (n,).
        error_db: energy of the images that are left out relative to the response's, dB.
        coarse_db: energy of those that are left out or need not be exact, dB.

    Returns:
        Indices of the images that are kept and exact, (k,), and of those that are kept and not, (m,), in their order.
    """
    if len(delays) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    loudness = np.abs(amplitudes)
    samples = np.rint(delays).astype(np.intp)
    whole = np.sum(np.bincount(samples, amplitudes) ** 2)
    levels = np.floor(2 * 20 * np.log10(np.maximum(loudness, 1e-300))).astype(np.intp)  # steps of half a decibel
    levels -= levels.min()
    lost = np.cumsum(np.bincount(levels, loudness**2))

    def first_level(share_db: float) -> int:
        """The level from which on images count, where those below it may have a share of the energy."""
        allowed = 10 ** (share_db / 10) * whole
        level = int(np.searchsorted(lost, allowed, side="right"))  # it is this one if nothing adds up
        while level > 0:
            faint = levels < level
            if np.sum(np.bincount(samples[faint], amplitudes[faint]) ** 2) <= allowed:
                break
            level -= 1
        return level

    first, exact = first_level(error_db), first_level(coarse_db) if coarse_db > error_db else 0
    return np.flatnonzero(levels >= max(first, exact)), np.flatnonzero((levels >= first) & (levels < exact))


class DelaySpectrum:
    """Sums of delayed impulses as spectra: H[b] = Σᵢ aᵢ exp(−2πi b τᵢ / length) by a type 1 non-uniform FFT.

    Impulses are spread over a fine grid by the kernel exp(β (√(1 − z²) − 1)), transformed, and divided by the kernel's
    transform (A. H. Barnett, J. Magland and L. af Klinteberg, 2019).

    Args:
        length: samples of the transform; delays lie in [0, length).
        band: highest frequency that must be right, in cycles a sample, at most 0.5; bins above it are left out.
        error_db: error relative to the impulses' energy, dB.

    Attributes:
        length: as given.
        bins: number of bins that a spectrum has.
        coarse_db: error of impulses that are spread over two cells alone, relative to their energy, dB.
    """

    ROWS = 4096  # of the kernel's table, a power of two
    TOGETHER = 1 << 14  # impulses; memory that is used again and stays in the cache makes it twice as fast

    def __init__(self, length: int, band: float = 0.5, error_db: float = -80.0):
        self.length, self.bins = length, min(length // 2, int(np.ceil(band * length))) + 1
        self._oversampling = 1 if band <= 0.3 else 2
        ratio = self._oversampling / (2 * min(band, 0.5))
        digits = -error_db / 20 * np.log(10)
        width = max(2, int(np.ceil((digits + 1) / (np.pi * np.sqrt(1 - 1 / ratio)))))
        beta = 0.97 * np.pi * width * (1 - 1 / (2 * ratio))
        self._width, self._cells = width, length * self._oversampling

        def kernel(cells: np.ndarray) -> np.ndarray:
            return np.exp(beta * (np.sqrt(np.maximum(0.0, 1 - (2 * cells / width) ** 2)) - 1))

        fractions = (np.arange(self.ROWS) + 0.5) / self.ROWS
        taps = [kernel(1 + k - width / 2 - fractions) for k in range(width)] + [np.zeros(self.ROWS)] * (width % 2)
        # Two taps that are neighbours are spread at once, as the parts of a complex number.
        pair = np.complex64 if error_db > SINGLE_DB else np.complex128
        self._taps = [(one + 1j * other).astype(pair) for one, other in zip(taps[::2], taps[1::2], strict=True)]
        nodes, weights = np.polynomial.legendre.leggauss(32 + 4 * width)
        cells = nodes * width / 2
        weights = weights * width / 2 * kernel(cells)
        highest = max(self.bins - 1, 1) / self._cells
        smooth = np.polynomial.Chebyshev.interpolate(
            lambda f: (np.cos(2 * np.pi * np.outer(f, cells)) * weights).sum(axis=1), 16 + 4 * width, [0.0, highest]
        )
        self._inverse = 1 / smooth(np.arange(self.bins) / self._cells)
        self._two_cells(highest, smooth, pair)
        self._at_once = at_once(self._cells)

    def _two_cells(self, highest: float, smooth: np.polynomial.Chebyshev, pair: type) -> None:
        """Find the two cells, and for each row the weights there, that come nearest to the kernel within the band."""
        frequencies = np.linspace(0.0, 2 * np.pi * highest, 33)
        places = np.linspace(0.0, 1.0, 129)  # of an impulse between two rows of cells
        wanted = np.exp(-1j * np.outer(frequencies, self._width / 2 - 1 + places))
        self.coarse_db, fractions = np.inf, (np.arange(self.ROWS) + 0.5) / self.ROWS
        for first in range(self._width - 1):
            cells = np.exp(-1j * np.outer(frequencies, [first, first + 1])) / smooth(frequencies / 2 / np.pi)[:, None]
            weights = np.linalg.solve((cells.conj().T @ cells).real, (cells.conj().T @ wanted).real)
            error_db = 10 * np.log10(np.mean(np.abs(cells @ weights - wanted) ** 2))
            if error_db < self.coarse_db:
                self.coarse_db, self._first_of_two = float(error_db), first
                one, other = (np.interp(fractions, places, row) for row in weights)
                self._both = (one + 1j * other).astype(pair)

    def __call__(
        self, impulses: Sequence[tuple[np.ndarray, np.ndarray]], exact: Sequence[int] | None = None
    ) -> np.ndarray:
        """Return the spectra of several sums, (m, bins) complex128.

        Args:
            impulses: m times delays, (n,) samples in [0, length), and amplitudes, (n,).
            exact: (m,) how many of each come first that are not among those of an error of coarse_db; None: all.
        """
        spectra = np.empty((len(impulses), self.bins), complex)
        counts = [len(delays) for delays, _ in impulses] if exact is None else exact
        for first in range(0, len(impulses), self._at_once):
            some = slice(first, first + self._at_once)
            halves = self._halves(impulses[some], counts[some])
            np.multiply(halves[:, : self.bins], self._inverse, out=spectra[some])
        return spectra

    def _halves(self, impulses: Sequence[tuple[np.ndarray, np.ndarray]], exact: Sequence[int]) -> np.ndarray:
        """Return the spectra of the grids over which impulses are spread, (m, cells / 2 + 1), until called again."""
        grids = scratch("grids", (len(impulses), self._cells + 2 * self._width + 2))
        all_cells = list(zip(range(0, self._width, 2), self._taps, strict=True))
        two_cells = [(self._first_of_two, self._both)]
        for grid, (delays, amplitudes), count in zip(grids, impulses, exact, strict=True):
            sums = scratch("sums", (len(grid) - 2,), self._taps[0].dtype)
            sums.fill(0)
            self._spread(sums, delays[:count], amplitudes[:count], all_cells)
            self._spread(sums, delays[count:], amplitudes[count:], two_cells)
            grid[0] = grid[-1] = 0
            grid[1:-1] = sums.real
            grid[2:] += sums.imag
        margin = (self._width + 1) // 2  # what was spread over an end goes round to the other
        circles, rest = grids[:, margin : margin + self._cells], grids[:, margin + self._cells :]
        circles[:, self._cells - margin :] += grids[:, :margin]
        circles[:, : rest.shape[1]] += rest
        return np.fft.rfft(circles, out=scratch("halves", (len(impulses), self._cells // 2 + 1), complex))

    def _spread(
        self, sums: np.ndarray, delays: np.ndarray, amplitudes: np.ndarray, pairs: Sequence[tuple[int, np.ndarray]]
    ) -> None:
        """Add impulses to sums, whose imaginary part belongs a cell later. Pairs are of a cell and taps."""
        whole = scratch("whole", (2, self.TOGETHER), np.intp)
        weights, spreads = scratch("spreads", (2, self.TOGETHER), sums.dtype)
        for begin in range(0, len(delays), self.TOGETHER):
            some = slice(begin, begin + self.TOGETHER)
            count = len(delays[some])
            (first, rows), weight, spread = whole[:, :count], weights[:count], spreads[:count]
            weight[:] = amplitudes[some]
            # In steps of 1 / ROWS of a cell, as whole numbers: the upper digits are the cell, the lower ones the row.
            # The product is exact in any precision, by a power of two.
            first[:] = delays[some] * np.float32(self._oversampling * self.ROWS)
            if self._width % 2:
                first += self.ROWS // 2
            np.bitwise_and(first, self.ROWS - 1, out=rows)
            first >>= self.ROWS.bit_length() - 1
            for cell, taps in pairs:
                taps.take(rows, mode="clip", out=spread)
                np.multiply(spread, weight, out=spread)
                np.add.at(sums[cell:], first, spread)


def _audible_end(delays: np.ndarray, amplitudes: np.ndarray, error_db: float) -> int:
    """Return the sample after which all energy of a response together is below an error (dB) relative to all of it."""
    energy = np.bincount(np.rint(delays).astype(np.intp), amplitudes) ** 2
    later = np.cumsum(energy[::-1])[::-1]
    return int(np.searchsorted(-later, -(10 ** (error_db / 10)) * later[0])) if len(later) else 0


@functools.lru_cache(maxsize=12)
def _plan(length: int, error_db: float) -> DelaySpectrum:
    return DelaySpectrum(length, error_db=error_db)


def _plan_for(num_samples: int, heard: int, error_db: float | None) -> DelaySpectrum:
    """Return the transform for responses of which the first samples are heard.

    Its kernel is periodic: over four lengths it differs from the sinc by less than -70 dB. A shorter one is enough for
    a larger error. There are few lengths, so that plans are met again.
    """
    length = max(4 * num_samples, 1 << 15)
    if error_db is None:
        return _plan(fft_length(length), -80.0)
    length = min(length, heard + int(128 * max(1.0, 4 ** ((-20 - error_db) / 10))))
    power = 1 << (length - 1).bit_length()
    return _plan(3 * power // 4 if length <= 3 * power // 4 else power, error_db - 12)


def _checked(
    room_dimensions_m: ArrayLike, source_m: ArrayLike, microphones_m: ArrayLike, reflection: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return as arrays: a room, (3,), a source, (3,), microphones, (m, 3), and reflection coefficients, (6,)."""
    room = np.asarray(room_dimensions_m, dtype=float)
    if room.shape != (3,) or not np.all(np.isfinite(room) & (room > 0)):
        raise ValueError(f"a room must have three dimensions above 0 m, not {room.tolist()}")
    source, microphones = np.asarray(source_m, dtype=float), np.atleast_2d(np.asarray(microphones_m, dtype=float))
    for name, points in (("source", source[None]), ("microphone", microphones)):
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"a {name} must have three coordinates")
        for point in points[~np.all((points >= 0) & (points <= room), axis=1)]:
            raise ValueError(f"the {name} {point.tolist()} is not in the room of {room.tolist()} m")
    coefficients = np.broadcast_to(np.asarray(reflection, dtype=float), 6)
    if not np.all((coefficients >= 0) & (coefficients <= 1)):
        raise ValueError(f"reflection coefficients must be from 0 to 1, not {coefficients.tolist()}")
    return room, source, microphones, coefficients


def shoebox_rir(
    room_dimensions_m: ArrayLike,
    source_m: ArrayLike,
    microphones_m: ArrayLike,
    reflection: ArrayLike,
    sample_rate_hz: float,
    num_samples: int,
    *,
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
    sign: int = -1,
    error_db: float | None = None,
) -> np.ndarray:
    """Return the impulse responses from a source to microphones in a shoebox room.

    The response is the band-limited sum Σ aᵢ sinc(n − τᵢ) over all images whose delay τᵢ falls within it, with
    aᵢ = (product of reflections) / (4π dᵢ) (J. B. Allen and D. A. Berkley, 1979), to better than −60 dB.

    Args:
        room_dimensions_m: (3,) m.
        source_m: (3,) m.
        microphones_m: (m, 3) or (3,) m.
        reflection: (6,) or a number, pressure reflection coefficients from 0 to 1 of the walls x0 x1 y0 y1 z0 z1.
        sample_rate_hz, num_samples: Hz; length of the responses.
        speed_of_sound_m_s: m/s.
        sign: −1: a reflection turns the pressure over, and the response has no build-up at low frequencies; +1: not.
        error_db: the latest images that can be left out for this relative error (dB, below 0) are left out; None: none.

    Returns:
        (m, num_samples) float64.

    Raises:
        ValueError: an argument has another shape or range, or a point lies outside the room.
    """
    room, source, microphones, coefficients = _checked(room_dimensions_m, source_m, microphones_m, reflection)
    if sign not in (-1, 1):
        raise ValueError(f"the sign of a reflection must be -1 or 1, not {sign}")
    if not (sample_rate_hz > 0 and speed_of_sound_m_s > 0 and num_samples > 0):
        raise ValueError("sample rate, speed of sound and number of samples must be above 0")
    if error_db is not None and not error_db < 0:
        raise ValueError(f"the error must be below 0 dB, not {error_db} dB")
    if error_db is not None and error_db < WHOLE_DB:
        error_db = None
    samples_per_m = sample_rate_hz / speed_of_sound_m_s
    reach_m = (num_samples - 1) / samples_per_m
    if error_db is not None:  # the energy after reach_m is small beside that of the faint images that are left out
        margin_db = 12 if sign < 0 else 25  # reflections of one sign add up at low frequencies
        later_s = audible_time(room, coefficients, error_db - margin_db, speed_of_sound_m_s)
        reach_m = min(reach_m, later_s * speed_of_sound_m_s + float(np.linalg.norm(room)))
    _refuse_too_many(room, coefficients, reach_m)
    impulses, heard = [], num_samples
    for microphone in microphones:
        distances, gains = arrivals(room, microphone, sign * coefficients, source, reach_m)
        delays, amplitudes = distances * samples_per_m, gains / (4 * np.pi * np.maximum(distances, NEAREST_M))
        impulses.append((delays, amplitudes))
    if error_db is not None:
        ends = [_audible_end(*of_microphone, error_db - 2) for of_microphone in impulses]
        early = [delays < end for (delays, _), end in zip(impulses, ends, strict=True)]
        impulses = [(d[kept], a[kept]) for (d, a), kept in zip(impulses, early, strict=True)]
        heard = min(max([*ends, 1]), num_samples)
    spectrum = _plan_for(num_samples, heard, error_db)
    heard = min(spectrum.length, num_samples)
    responses = np.zeros((len(microphones), num_samples))
    responses[:, :heard] = np.fft.irfft(spectrum(impulses), spectrum.length)[:, :heard]
    return responses
