"""Room acoustics: image sources, moving speakers, and what microphones hear of them."""

from avcli.acoustics.images import image_count, image_microphones, shoebox_rir
from avcli.acoustics.moving import MovingSource, Surroundings, interpolation
from avcli.acoustics.room import (
    eyring_absorption,
    minimum_rt60,
    sabine_absorption,
    sabine_rt60,
    schroeder_frequency,
    speed_of_sound,
    wall_areas,
)
from avcli.acoustics.signals import at_level, resample
from avcli.acoustics.speakers import Speakers

__all__ = [
    "MovingSource",
    "Speakers",
    "Surroundings",
    "at_level",
    "eyring_absorption",
    "image_count",
    "image_microphones",
    "interpolation",
    "minimum_rt60",
    "resample",
    "sabine_absorption",
    "sabine_rt60",
    "schroeder_frequency",
    "shoebox_rir",
    "speed_of_sound",
    "wall_areas",
]
