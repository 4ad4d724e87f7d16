"""Sound in small shoebox rooms, by image sources of few reflections, for the tests of avcli.localization.

It is not avsim-audio's code, on purpose: what one simulator gets wrong the other must not repeat.
"""

import numpy as np

ROOM = np.array([4.66, 4.66, 3.0])
MICROPHONES = np.array(
    [
        [0.115, 4.545, 2.493],
        [2.401, 4.498, 2.385],
        [4.545, 4.545, 2.484],
        [4.498, 2.342, 2.380],
        [4.545, 0.115, 2.489],
        [2.395, 0.162, 2.378],
        [0.115, 0.115, 2.489],
        [2.386, 2.253, 2.489],
    ]
)
SPEED = 343.0


def voice(seconds, fs, rng):
    """Something like a voice, (n,): a gliding pulse train and breath through three resonances, in syllables."""
    n = round(seconds * fs)
    t = np.arange(n) / fs
    pitch = 120.0 + 30.0 * np.sin(2.0 * np.pi * 0.7 * t + rng.uniform(0.0, 6.0))
    phase = np.cumsum(pitch) / fs
    pulses = np.diff(np.floor(phase), prepend=0.0)
    source = pulses + 0.05 * rng.standard_normal(n)
    frequency = np.fft.rfftfreq(n, 1.0 / fs)
    gain = 0.02 + sum(1.0 / (1.0 + ((frequency - f) / b) ** 2) for f, b in ((500, 80), (1500, 120), (2800, 200)))
    sound = np.fft.irfft(np.fft.rfft(source) * gain, n)
    syllables = np.clip(np.sin(2.0 * np.pi * 3.0 * t) + 0.6, 0.0, 1.0)
    sound *= syllables
    return 0.1 * sound / np.abs(sound).max()


def heard(source, sound, fs, *, microphones=MICROPHONES, reflection=0.0, order=3, room=ROOM, speed=SPEED):
    """What the microphones hear of a sound (n,) from a place (3,) m: (n, m), exact fractional delays.

    Args:
        reflection: amplitude that each wall gives back.
        order: most reflections on each axis.
    """
    source = np.asarray(source, dtype=float)
    size = 1 << int(np.ceil(np.log2(len(sound) + fs * 0.3)))
    frequency = np.fft.rfftfreq(size, 1.0 / fs)
    spectrum = np.fft.rfft(sound, size)
    images = [(source, 1.0)]
    if reflection:
        images = []
        span = range(-order, order + 1)
        for index in np.array(np.meshgrid(span, span, span)).reshape(3, -1).T:
            if np.abs(index).sum() <= order:
                place = np.where(index % 2 == 0, source, room - source) + index * room
                images.append((place, reflection ** np.abs(index).sum()))
    result = np.empty((len(sound), len(microphones)))
    for channel, microphone in enumerate(microphones):
        response = np.zeros(len(frequency), complex)
        for place, amplitude in images:
            distance = np.linalg.norm(place - microphone)
            response += amplitude / max(distance, 0.01) * np.exp(-2j * np.pi * frequency * distance / speed)
        result[:, channel] = np.fft.irfft(spectrum * response, size)[: len(sound)]
    return result


def decibels(found, expected):
    """Power of the difference over that of what is expected, dB."""
    return 10 * np.log10(np.sum((found - expected) ** 2) / np.sum(expected**2))


def noisy(samples, decibels, rng):
    """The samples with white noise in each channel, this far below their mean power."""
    level = np.sqrt(np.mean(samples**2)) * 10.0 ** (-decibels / 20.0)
    return samples + level * rng.standard_normal(samples.shape)
