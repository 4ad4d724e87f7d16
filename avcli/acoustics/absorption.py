"""How much the walls of a shoebox room absorb, and how its sound decays.

The order of the walls is x0, x1, y0, y1, z0, z1: x = 0, x = length, and so on; z0 is the floor.
"""

import numpy as np
from numpy.typing import ArrayLike

from avcli.materials.decay import octant
from avcli.numeric import SPEED_OF_SOUND_M_S

SABINE = 0.161
"""s/m, the constant of Sabine's equation as the thesis writes it (eq. 4.1); 24 ln 10 / c is 0.1611."""


def wall_areas(room_dimensions_m: ArrayLike) -> np.ndarray:
    """Return the areas of the six walls, (6,) m².

    Args:
        room_dimensions_m: (3,) m.
    """
    lx, ly, lz = np.asarray(room_dimensions_m, dtype=float)
    return np.repeat([ly * lz, lx * lz, lx * ly], 2)


def volume(room_dimensions_m: ArrayLike) -> float:
    """Return the volume of a room, m³.

    Args:
        room_dimensions_m: (3,) m.
    """
    return float(np.prod(np.asarray(room_dimensions_m, dtype=float)))


def sabine_absorption(room_dimensions_m: ArrayLike, rt60_s: float) -> np.ndarray:
    """Return the absorption coefficients of the six walls that give a reverberation time, (6,) of energy.

    T60 = 0.161 V / (α S) (W. C. Sabine, 1898; thesis eqs. 4.1 and 4.2), solved for α.

    >>> sabine_absorption([4.66, 4.66, 3.0], 0.35).round(4).tolist()
    [0.3016, 0.3016, 0.3016, 0.3016, 0.3016, 0.3016]

    Args:
        room_dimensions_m: (3,) m.
        rt60_s: reverberation time, s.

    Raises:
        ValueError: walls that absorb everything reverberate longer by this equation.
    """
    least = float(SABINE * volume(room_dimensions_m) / wall_areas(room_dimensions_m).sum())
    if not rt60_s >= least:
        raise ValueError(f"T60 {rt60_s:g} s is too short for this room; the shortest is {least:.4f} s")
    absorption = SABINE * volume(room_dimensions_m) / (rt60_s * wall_areas(room_dimensions_m).sum())
    return np.full(6, min(1.0, absorption))


def eyring_absorption(room_dimensions_m: ArrayLike, rt60_s: float) -> np.ndarray:
    """Return the absorption coefficients of the six walls by Eyring's equation, (6,) of energy.

    T60 = 0.161 V / (−S ln(1 − ᾱ)) with ᾱ the mean over the area (C. F. Eyring, 1930). Every T60 is possible.

    Args:
        room_dimensions_m: (3,) m.
        rt60_s: reverberation time, s.

    Raises:
        ValueError: rt60_s is not above 0.
    """
    if not rt60_s > 0:
        raise ValueError(f"T60 must be above 0 s, not {rt60_s:g} s")
    area = wall_areas(room_dimensions_m).sum()
    return np.full(6, -np.expm1(-SABINE * volume(room_dimensions_m) / (rt60_s * area)))


def decay_rates(
    room_dimensions_m: ArrayLike, reflection: ArrayLike, speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
) -> tuple[np.ndarray, np.ndarray]:
    """Return how the energy of image sources decays: the part after t is about Σ sharesᵢ exp(−ratesᵢ t).

    Args:
        room_dimensions_m: (3,) m.
        reflection: (6,) pressure coefficients above 0 and below 1, of any sign.
        speed_of_sound_m_s: m/s.

    Returns:
        rates, (n,) 1/s, of n directions, and shares, (n,), without unit.
    """
    lost = -2 * np.log(np.abs(reflection)).reshape(3, 2).mean(axis=1)
    weights, directions = octant(16)
    met = (lost / np.asarray(room_dimensions_m, dtype=float))[:, None] * directions
    rates = speed_of_sound_m_s * met.sum(axis=0)
    return rates, weights / rates


def audible_time(
    room_dimensions_m: ArrayLike, reflection: ArrayLike, error_db: float, speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
) -> float:
    """Return the time, s, after which the energy of image sources is below an error (dB) relative to all of it.

    Args:
        room_dimensions_m: (3,) m.
        reflection: (6,) pressure coefficients of any sign; infinite where one of a pair of walls reflects all.
        error_db: dB, below 0.
        speed_of_sound_m_s: m/s.
    """
    magnitude = np.abs(np.asarray(reflection, dtype=float))
    if np.any(magnitude.reshape(3, 2).prod(axis=1) >= 1):
        return np.inf
    rates, shares = decay_rates(room_dimensions_m, np.maximum(magnitude, 1e-3), speed_of_sound_m_s)
    allowed, time = 10 ** (error_db / 10) * shares.sum(), 1 / rates.max()
    while np.sum(shares * np.exp(-rates * time)) > allowed:
        time *= 1.05
    return float(time)


def sabine_rt60(room_dimensions_m: ArrayLike, absorption: ArrayLike) -> float:
    """Return Sabine's reverberation time of a room, s; infinite where nothing absorbs.

    Args:
        room_dimensions_m: (3,) m.
        absorption: (6,) or a number, of energy.
    """
    area = float(wall_areas(room_dimensions_m) @ np.broadcast_to(np.asarray(absorption, dtype=float), 6))
    return float(SABINE * volume(room_dimensions_m) / area) if area > 0 else np.inf


def schroeder_frequency(room_dimensions_m: ArrayLike, rt60_s: float) -> float:
    """Return the frequency, Hz, above which rays describe a room well (M. Schroeder, 1962; thesis eq. 4.4).

    Args:
        room_dimensions_m: (3,) m.
        rt60_s: reverberation time, s.
    """
    return float(2000.0 * np.sqrt(rt60_s / volume(room_dimensions_m)))
