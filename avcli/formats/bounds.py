"""What counts as a sane number in a record, a config.json or a scenario: the one place that says how large each may be.

Floats hold far larger numbers, but what is computed from them overflows, never ends or fills the memory. The bounds lie
well beyond what any room, sensor or clock needs. Readers refuse what is outside them by name, and the JSON Schemas and
avcli-formats(5) state them.
"""

from avcli.formats.schema import Integer, Number, Numbers

LATEST_S = 1e11
"""s; the largest time, before or after 0: 3000 years of Unix time."""
FARTHEST_M = 1e6
"""m; the largest coordinate, of a position, a velocity in m/s or a direction."""
LARGEST_VARIANCE = 1e12
"""m²; the largest entry of a covariance, the square of the largest coordinate."""
LONGEST_GAP_S = 10
"""s; a longer hole in the sound of a stream is not filled with silence, each step of which would give a record: the
recording starts anew after it."""
MOST_OBJECTS = 10_000
"""Objects in one record."""
MOST_CHANNELS = 1024
"""Microphones, and channels of a sound file; libsndfile has the same limit."""
MOST_PIXELS = 1 << 27
"""Pixels in one picture."""
LONGEST_RECORD = 1 << 24
"""bytes; a longer line is not a record, and what is read of it takes many times its size."""
LARGEST_JSON_FILE = 1 << 26
"""bytes of a config.json or a scenario."""
LARGEST_PICTURE_FILE = 1 << 30
"""bytes of a picture file, raw ones included."""

COORDINATE = Number(-FARTHEST_M, most=FARTHEST_M)
VECTOR = Numbers(3, COORDINATE)
BOX = Numbers(4, COORDINATE)
TURNED_BOX = Numbers(5, COORDINATE)
TIME = Number(-LATEST_S, most=LATEST_S)
DURATION = Number(0, most=LATEST_S)
TIMES = Numbers(2, TIME)
DEGREES = Number(-1e6, most=1e6)
DISTANCE = Number(0, most=FARTHEST_M)
LENGTH = Number(above=0, most=FARTHEST_M)
FRAME_RATE = Number(1e-3, most=1000)
SIDE = Number(1e-3, most=1e4)
REVERBERATION = Number(0, most=1000)
SPEED_OF_SOUND = Number(1, most=1e4)
SAMPLE_RATE = Integer(100, 1_000_000)
CHANNELS = Integer(1, MOST_CHANNELS)
SAMPLE = Integer(-(2**53), 2**53)
SAMPLES = Integer(0, 2**53)
PIXELS = Integer(1, MOST_PIXELS)
ANY_COUNT = Integer(-(2**53), 2**53)
