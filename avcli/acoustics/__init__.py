"""Room acoustics: image sources, moving speakers, and what microphones hear of them."""

from avcli.acoustics.images import MOST_IMAGES, image_count, image_microphones, shoebox_rir
from avcli.acoustics.moving import MovingSource
from avcli.acoustics.noise import Noise
from avcli.acoustics.responses import Surroundings, impulse_responses
from avcli.acoustics.room import (
    eyring_absorption,
    image_absorption,
    image_rt60,
    minimum_rt60,
    sabine_absorption,
    sabine_rt60,
    schroeder_frequency,
    wall_areas,
)
from avcli.acoustics.sampling import Switching, interpolation
from avcli.acoustics.signals import at_level, pascal, resample
from avcli.acoustics.speakers import Speakers
from avcli.acoustics.trajectory import Trajectory

__all__ = [
    "MOST_IMAGES",
    "MovingSource",
    "Noise",
    "Speakers",
    "Surroundings",
    "Switching",
    "Trajectory",
    "at_level",
    "eyring_absorption",
    "image_absorption",
    "image_count",
    "image_microphones",
    "image_rt60",
    "impulse_responses",
    "interpolation",
    "minimum_rt60",
    "pascal",
    "resample",
    "sabine_absorption",
    "sabine_rt60",
    "schroeder_frequency",
    "shoebox_rir",
    "wall_areas",
]
