"""How fast the sound of image sources really decays in a shoebox room, and the absorption that gives a wanted time."""

import contextlib
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from avcli.acoustics.absorption import SABINE, decay_rates, sabine_rt60, volume, wall_areas
from avcli.acoustics.images import image_count
from avcli.numeric import SPEED_OF_SOUND_M_S

COUNTED_IMAGES, PAIRS = 2_000, 100
"""images of a pair of places whose energy is summed one by one, at most, and pairs of places, at least."""
CELLS, STEPS = 1 << 13, 1500
"""cells of the squares of the distances of later images, and steps of the decay."""
RATIO = 1.1127756842787055
"""root of x⁷ = x + 1; its powers spread pairs of places evenly (R. L. Kronecker's sequence in six dimensions)."""

LONG = 3.0
"""longest over shortest side; beyond it places differ so much that four times as many images are summed one by one."""
LEAST_ABSORPTION, MOST_ABSORPTION = 1e-6, 0.99
"""Walls that absorb less decay over more images than can be counted; walls that absorb more leave no decay."""


def image_absorption(
    room_dimensions_m: ArrayLike, rt60_s: float, speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
) -> np.ndarray:
    """Return the absorption coefficients with which image sources themselves have a reverberation time, (6,) of energy.

    Image sources decay faster across the room than along its walls, so neither Sabine's nor Eyring's equation holds
    for them. This is the absorption with which `image_rt60` is the wanted time, found by the secant method.

    Args:
        room_dimensions_m: (3,) m.
        rt60_s: reverberation time, s.
        speed_of_sound_m_s: m/s.

    Raises:
        ValueError: walls that absorb nearly everything reverberate longer, walls that absorb nearly nothing reverberate
            less (a room that is very flat), or rt60_s is not above 0.
    """
    return _solved(
        room_dimensions_m,
        rt60_s,
        speed_of_sound_m_s,
        lambda scale: np.full(6, scale),
        SABINE * volume(room_dimensions_m) / (max(rt60_s, 1e-9) * float(wall_areas(room_dimensions_m).sum())),
        MOST_ABSORPTION,
    )


def even_absorption(
    room_dimensions_m: ArrayLike, rt60_s: float, speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
) -> np.ndarray:
    """Return the absorption coefficients that give a reverberation time evenly along all three axes, (6,) of energy.

    Sound loses as much on each metre along each axis: walls that are farther apart absorb more. A dead, flat room has
    times in this way that it cannot have by walls that absorb alike, which end the sound across the room at once, and
    leave that along it.

    Args and Raises: as `image_absorption`.
    """
    sides = np.repeat(np.asarray(room_dimensions_m, dtype=float), 2)
    met = 1.5 * max(rt60_s, 1e-9) * speed_of_sound_m_s  # m along the axes: |cos| to the three sum to 1.5 on average
    return _solved(
        room_dimensions_m,
        rt60_s,
        speed_of_sound_m_s,
        lambda scale: -np.expm1(-scale * sides),
        6 * np.log(10) / met,
        -np.log1p(-MOST_ABSORPTION) / sides.max(),
    )


def wanted_absorption(
    room_dimensions_m: ArrayLike, rt60_s: float, speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
) -> tuple[np.ndarray, str | None]:
    """Return absorption coefficients that give a reverberation time, (6,) of energy, and what the user has to be told.

    All walls absorb alike (`image_absorption`) where the room can have the time in this way, else as `even_absorption`
    has it. Where neither is possible but walls that absorb alike come near it, this is said (`too_dead`).

    Args and Raises: as `image_absorption`.
    """
    alike, hardly, problem = None, None, ValueError()
    try:
        alike = image_absorption(room_dimensions_m, rt60_s, speed_of_sound_m_s=speed_of_sound_m_s)
        hardly = too_dead(room_dimensions_m, rt60_s, alike, speed_of_sound_m_s)
        if hardly is None:
            return alike, None
    except ValueError as error:
        problem = error
    with contextlib.suppress(ValueError):
        even = even_absorption(room_dimensions_m, rt60_s, speed_of_sound_m_s)
        if too_dead(room_dimensions_m, rt60_s, even, speed_of_sound_m_s) is None:
            x, y, z = np.round(100 * even[::2])
            return even, (
                f"T60 {rt60_s:g} s is too short for this room if all walls absorb alike; walls that are farther apart "
                f"absorb more: {x:.0f} % at both ends of x, {y:.0f} % of y, {z:.0f} % of z"
            )
    if alike is None:
        raise problem
    return alike, hardly


def _solved(
    room_dimensions_m: ArrayLike,
    rt60_s: float,
    speed_of_sound_m_s: float,
    absorption: Callable[[float], np.ndarray],
    about: float,
    strongest: float,
) -> np.ndarray:
    """Return the absorption of which the time is wanted, of those that a scale from 0 to the strongest has."""
    if not rt60_s > 0:
        raise ValueError(f"T60 must be above 0 s, not {rt60_s:g} s")
    decay = _Decay(room_dimensions_m, rt60_s, speed_of_sound_m_s)
    scale = min(strongest / 2, about)
    low, high = 0.0, np.inf  # walls that absorb too little and too much
    power, last = -1.0, (0.0, 0.0)  # T60 is about proportional to the absorption to this power
    while high - low > 1e-4 * scale:
        if absorption(scale).max() < LEAST_ABSORPTION:
            raise ValueError(
                f"T60 {rt60_s:g} s is too long for this room; its image sources decay sooner at any absorption"
            )
        time = decay.time(absorption(scale))
        here = np.log(scale), np.log(max(time, 1e-9) / rt60_s)
        if abs(here[1]) < 1e-3:
            break
        low, high = (scale, high) if here[1] > 0 else (low, scale)
        if low == strongest:
            raise ValueError(
                f"T60 {rt60_s:g} s is too short for this room; its image sources decay in {time:.2g} s if the walls "
                f"absorb 99 %"
            )
        if last != (0.0, 0.0) and here[0] != last[0]:
            power = min((here[1] - last[1]) / (here[0] - last[0]), -0.5)
        last = here
        scale = min(scale * np.exp(-here[1] / power), strongest)
        if not low < scale < high and (low, high) != (0.0, scale):
            scale = (low + min(high, strongest)) / 2
    return absorption(scale)


def image_rt60(
    room_dimensions_m: ArrayLike,
    absorption: ArrayLike,
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
    air: float = 0.0,
) -> float:
    """Return the reverberation time of image sources, s: T30 as the mean over places of source and microphone.

    T30 is fitted to the decay from −5 to −35 dB (ISO 3382-2:2008, with Schroeder's backward integration). The energy of
    the nearest images is summed one by one for many pairs of places. That of the later ones is the mean over places:
    the squares of the distances along the three axes add up, so the distribution of their sum is a convolution.

    Args:
        room_dimensions_m: (3,) m.
        absorption: (6,) or a number, of energy, above 0 and below 1.
        speed_of_sound_m_s: m/s.
        air: 1/m, the pressure also decays by exp(−air · d) on a way d.
    """
    longest = sabine_rt60(room_dimensions_m, absorption) * SPEED_OF_SOUND_M_S / speed_of_sound_m_s
    if air > 0:
        longest = 1 / (1 / longest + 2 * air * speed_of_sound_m_s / (6 * np.log(10)))
    return _Decay(room_dimensions_m, longest, speed_of_sound_m_s).time(absorption, air)


def too_dead(
    room_dimensions_m: ArrayLike, rt60_s: float, absorption: ArrayLike, speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
) -> str | None:
    """Say of a room whether its walls absorb so much that its sound hardly decays but ends: one sentence, or None.

    T30 is then a mean over places with a decay that is longer than asked for, and places without any, and no
    absorption makes it right.

    Args:
        room_dimensions_m: (3,) m.
        rt60_s: reverberation time that was asked for, s.
        absorption: (6,) of energy, with which the room should have it.
        speed_of_sound_m_s: m/s.
    """
    if np.max(absorption) < DEAD:
        return None
    times, decays = _Decay(room_dimensions_m, rt60_s, speed_of_sound_m_s).times(absorption)
    if decays.mean() > 0.95:
        return None
    elsewhere = f"; elsewhere it decays in {times[decays].mean():.2g} s" if decays.any() else ""
    return (
        f"T60 {rt60_s:g} s is hardly possible in this room: the walls absorb {100 * np.max(absorption):.0f} %, and at "
        f"{100 * (1 - decays.mean()):.0f} % of places sound does not decay but ends{elsewhere}"
    )


DEAD = 0.9
"""absorption of walls above which a decay may be too short to be one."""


class _Decay:
    """The energy decay of the image sources of one room, for walls of any absorption.

    Args:
        room_dimensions_m: (3,) m.
        rt60_s: about the reverberation time, s.
        speed_of_sound_m_s: m/s.
    """

    def __init__(self, room_dimensions_m: ArrayLike, rt60_s: float, speed_of_sound_m_s: float):
        self._room, self._speed = np.asarray(room_dimensions_m, dtype=float), speed_of_sound_m_s
        self.volume = volume(self._room)
        self._end = max(1.3 * rt60_s * speed_of_sound_m_s, 2 * float(np.linalg.norm(self._room)))
        self._edges = np.linspace(0, self._end, STEPS)
        counted = COUNTED_IMAGES * (4 if self._room.max() > LONG * self._room.min() else 1)
        self._reach = min(self._end, float(np.cbrt(counted * self.volume / (4 / 3 * np.pi))))
        count = int(np.clip(PAIRS * counted / image_count(self._room, self._reach), PAIRS, 400))
        margin = np.minimum(0.3, self._room / 8)
        evenly = (0.5 + np.outer(np.arange(8 * count), RATIO ** -np.arange(1.0, 7))) % 1
        places = margin + evenly.reshape(-1, 2, 3) * (self._room - 2 * margin)
        apart = np.linalg.norm(places[:, 0] - places[:, 1], axis=1)
        places = places[apart > min(1.0, np.linalg.norm(self._room) / 4)][:count]
        self._axes = [self._axis(*of_axis) for of_axis in zip(self._room, places.transpose(2, 1, 0), strict=True)]
        self._find_near(places)

    def _axis(self, length: float, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return of all images along an axis the squared distances, as cells, and the orders at its two walls."""
        n, q = _along(length, self._end)
        distances = (1 - 2 * q) * places[1][:, None] + 2 * n * length - places[0][:, None]
        cells = (CELLS * (distances / self._end) ** 2).ravel().astype(int)
        inside = cells < CELLS
        orders = (np.tile(np.abs(order), len(places[0]))[inside] for order in (n - q, n))
        return (cells[inside], *orders)

    def _find_near(self, places: np.ndarray) -> None:
        """Note the orders, (6, n), of all images that may be within the reach, and of each pair of places what is.

        That is the number of the image, the energy that its distance leaves, and its step of the decay. They are kept
        small: memory that is new costs more than what is done with it.
        """
        axes = [_along(length, self._reach) for length in self._room]
        every = np.indices([len(n) for n, _ in axes]).reshape(3, -1)
        self._orders = np.concatenate(
            [np.abs(np.stack([n - q, n], dtype=float))[:, of_axis] for (n, q), of_axis in zip(axes, every, strict=True)]
        )
        numbers = np.min_scalar_type(every.shape[1])
        self._pairs, self._left = [], np.empty((len(places), STEPS))
        for source, microphone in places:
            x, y, z = (
                ((1 - 2 * q) * there + 2 * n * length - here) ** 2
                for (n, q), there, length, here in zip(axes, microphone, self._room, source, strict=True)
            )
            squares = np.add.outer(np.add.outer(x, y), z).ravel()
            near = np.flatnonzero(squares <= self._reach**2)
            squares = squares.take(near)
            steps = (np.sqrt(squares) / self._edges[1]).astype(np.uint16)
            self._pairs.append((near.astype(numbers), 1 / (16 * np.pi**2 * squares), steps))

    def time(self, absorption: ArrayLike, air: float = 0.0) -> float:
        """Return T30, s, the mean over pairs of places; see `image_rt60`."""
        return float(self.times(absorption, air)[0].mean())

    def times(self, absorption: ArrayLike, air: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return T30 of the pairs of places, (n,) s, and at which the energy really decays, (n,) bool.

        Elsewhere the direct sound, and little more, is all that is heard above -35 dB: T30 is twice the time until
        then.
        """
        lost, edges = np.log1p(-np.broadcast_to(np.asarray(absorption, dtype=float), 6)), self._edges
        gains, left = np.exp(lost @ self._orders), self._left
        for of_pair, (near, spreading, steps) in zip(left, self._pairs, strict=True):
            energies = gains.take(near)
            energies *= spreading
            if air > 0:
                energies *= np.exp(-air / (2 * np.pi * np.sqrt(spreading)))
            of_pair[:] = np.bincount(steps, energies, STEPS)
        np.cumsum(left[:, ::-1], axis=1, out=left[:, ::-1])
        left += self._later(lost, air, np.maximum(edges, self._reach))
        first, last = (np.count_nonzero(left > left[:, :1] * 10 ** (-db / 10), axis=1) for db in (5, 35))
        steps = np.arange(first.min(), last.max())
        between = (steps >= first[:, None]) & (steps < last[:, None])
        level = np.where(between, 10 * np.log10(left[:, first.min() : last.max()]), 0.0)
        begins, ends = (
            10 * np.log10(left[np.arange(len(left)), step]) for step in (np.minimum(first, STEPS - 1), last - 1)
        )
        count, middle = last - first, (first + last - 1) / 2
        decays = (count >= 2) & (begins - ends >= 15)
        slope = (level @ steps - middle * level.sum(axis=1)) / np.maximum(count * (count**2 - 1) / 12, 1)
        steps_until = np.where(decays, -60 / np.where(decays, slope, -1.0), 2.0 * count)  # a straight line's slope
        return steps_until * edges[1] / self._speed, decays

    def _later(self, lost: np.ndarray, air: float, distances: np.ndarray) -> np.ndarray:
        """Return the energy of all images beyond some distances, (n,), as a mean over places."""
        spectrum = np.ones(3 * CELLS // 2 + 1, complex)
        for (cells, *orders), of_walls in zip(self._axes, lost.reshape(3, 2), strict=True):
            gains = np.exp(of_walls[0] * orders[0] + of_walls[1] * orders[1]) / len(self._pairs)
            spectrum *= np.fft.rfft(np.bincount(cells, gains, CELLS), 3 * CELLS)
        squares = (np.arange(CELLS) + 1.5) / CELLS * self._end**2  # the floors of three numbers lose 1.5 on average
        energy = np.maximum(np.fft.irfft(spectrum, 3 * CELLS)[:CELLS], 0.0) / (16 * np.pi**2 * squares)
        energy *= np.exp(-2 * air * np.sqrt(squares))
        beyond = np.append(np.cumsum(energy[::-1])[::-1], 0.0)
        rates, shares = decay_rates(self._room, np.exp(lost / 2), self._speed)
        shares, rates = shares * rates / (rates + 2 * air * self._speed), rates + 2 * air * self._speed
        rest = np.sum(shares * np.exp(-rates * self._end / self._speed)) * self._speed / (4 * np.pi * self.volume)
        return np.interp(distances**2, np.append(squares, squares[-1] + squares[0] / 1.5), beyond) + rest


def _along(length: float, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return n and q of the images along an axis to beyond a reach; see `images`."""
    most = int(reach / (2 * length)) + 1
    return np.repeat(np.arange(-most, most + 1), 2), np.tile([0, 1], 2 * most + 1)
