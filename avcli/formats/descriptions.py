"""What each kind of record may hold. Readers, JSON Schemas and avcli-formats(5) follow from this.

`make formats` writes the schemas and the manual's key lists anew after a change here. A key that a reader is to use
gets its kind here, and its reader finds it in the dictionary that `read` returns. config.json is described in
avcli.formats.experiment, and scenarios are in avcli.scene.scenario.
"""

from dataclasses import dataclass

from avcli.formats import bounds
from avcli.formats.features import FEATURES
from avcli.formats.schema import (
    Boolean,
    Choice,
    Covariance,
    Either,
    Identity,
    Integer,
    Key,
    Kind,
    ListOf,
    MapOf,
    Number,
    Numbers,
    Object,
    OrNull,
    Point,
    Text,
    Timestamp,
    UnitVector,
    Written,
)
from avcli.formats.sensors import KINDS

PROBABILITY = Number(least=0, most=1)
BOX = bounds.BOX
POSITION = Point(bounds.FARTHEST_M)
SPREAD = Covariance(bounds.LARGEST_VARIANCE)
TIMESTAMP = Key(
    Timestamp(bounds.LATEST_S),
    "time since the start of the scene (live sensors: Unix time), s; written as text with ten decimals",
    required=True,
)


@dataclass(frozen=True)
class Format:
    """A format: its name (of the schema's file and of the manual's list), a title and its description."""

    name: str
    title: str
    content: Object


# --- records ----------------------------------------------------------------------------------------------------------

PERSON = Object(
    {
        "object_id": Key(Identity(), "identity of the person, the same in all records", required=True),
        "position": Key(POSITION, "point on the floor under the body's axis, m in the room frame", required=True),
        "mouth_position": Key(bounds.VECTOR, "where the voice comes from, m in the room frame"),
        "speaking": Key(
            Either((Boolean(), PROBABILITY)),
            "in ground truth, whether it is the person's turn to speak; in tracks, a probability",
        ),
        "bbox_px": Key(BOX, "box [x0, y0, x1, y1] around the visible pixels, px; absent where none is visible"),
        "velocity": Key(bounds.VECTOR, "velocity, m/s"),
        "covariance": Key(SPREAD, "covariance of the position, m²"),
        "existence": Key(PROBABILITY, "probability that the person is there, within 1 m of the position"),
        "observed": Key(Boolean(), "whether a sensor detected the person since the record before"),
        "last_seen": Key(bounds.TIME, "when a sensor detected the person last, s"),
    }
)
"""A person of a ground-truth or track record, with the keys that readers use in either."""

FRAME = Object(
    {
        "rgb": Key(Text(), "path of the colour picture, relative to the experiment directory"),
        "depth": Key(Text(), "path of the depth picture; a frame has at least one of the two"),
        "mask": Key(Text(), "path of the picture of person numbers (avsim-scene --mask)", read=False),
    },
    needed=(("rgb",), ("depth",)),
)

AUDIO = Object(
    {
        "path": Key(Text(), "path of the sound file, relative to the experiment directory", required=True),
        "start_sample": Key(
            bounds.SAMPLE, "number of the first sample; sample 0 is time 0 of the scene", required=True
        ),
        "num_samples": Key(bounds.SAMPLES, "number of samples in the file", required=True),
        "sample_rate_hz": Key(bounds.SAMPLE_RATE, "sample rate, Hz", required=True),
        "num_channels": Key(bounds.CHANNELS, "number of microphones", required=True),
        "tail_samples": Key(
            bounds.SAMPLES,
            "number of samples after the scene's end, where only reverberation is left; at most "
            "num_samples; by default config.json's reverberation time, at the end of the recording",
        ),
    }
)

DETECTION = Object(
    {
        "position": Key(
            Point(bounds.FARTHEST_M, height_may_be_null=True),
            "position, m in the room frame; z is null or absent where it was not observed; may be left out beside a "
            "direction or a range",
        ),
        "covariance": Key(
            SPREAD, "covariance of the position, m²; a zero variance means: not observed; zeros alone: not known"
        ),
        "score": Key(PROBABILITY, "probability that the detection is right"),
        "machine": Key(
            PROBABILITY,
            "probability that a machine sounds there, such as a fan, and nobody speaks; the score counts it already",
        ),
        "bbox_px": Key(BOX, "box [x0, y0, x1, y1] in the full image, px"),
        "height": Key(bounds.COORDINATE, "height of the person, m"),
        "turned_px": Key(
            bounds.TURNED_BOX,
            "box turned as the person stands: middle x and y, width and height, px, and the angle from the picture's x "
            "axis to the box's, towards y, degrees",
        ),
        "explained": Key(
            Boolean(),
            "false where no body explains the box (somebody lies, reaches out, or is mostly hidden; or it is nobody): "
            "the position is hardly known, as the covariance says",
        ),
        "features": Key(FEATURES, 'what tells this person from others, by name: "looks", "voice"; at most 8'),
        "origin": Key(
            Point(bounds.FARTHEST_M, height_may_be_null=True),
            "where the sensor stands from which direction and range_m count, m in the room frame",
        ),
        "direction": Key(
            UnitVector(),
            "unit vector from the origin towards the person, in the room frame; without z only the direction on the "
            "floor was observed; a position beside it is a guess, which avfuse does not use",
        ),
        "direction_sd_deg": Key(
            Number(above=0, most=180), "standard deviation of the direction, across it to each side, degrees"
        ),
        "range_m": Key(bounds.DISTANCE, "distance from the origin, m; on the floor if the origin has no z"),
        "range_sd_m": Key(bounds.LENGTH, "standard deviation of the distance, m"),
    },
    needed=(("position",), ("direction",), ("range_m",)),
    beside={"direction": "origin", "range_m": "origin"},
)


def _objects(kind: Object) -> ListOf:
    return ListOf(kind, most=bounds.MOST_OBJECTS)


_TRUE_PERSON = Object(
    {
        **PERSON.keys,
        "visible_fraction": Key(
            PROBABILITY, "share of the body's pixels in view; occlusion and the image's border reduce it", read=False
        ),
        "bbox_full_px": Key(BOX, "the same box without occlusion and without the image's border", read=False),
        "keypoints_px": Key(
            ListOf(bounds.VECTOR, 17, 17),
            "the 17 joints of COCO as [u, v, visibility]; 0: outside the image, 1: hidden, 2: visible",
            read=False,
        ),
    }
)
GROUNDTRUTH = Format(
    "groundtruth",
    "One time step of ground truth (Listing .5 of the thesis, with more keys)",
    Object(
        {
            "timestamp": TIMESTAMP,
            "objects": Key(_objects(_TRUE_PERSON), "the people", required=True),
            "frame": Key(FRAME, "the camera's pictures of this time"),
        }
    ),
)
FAULT = Object(
    {
        "channel": Key(bounds.CHANNELS, "the channel, from 1", required=True),
        "fault": Key(
            Choice(("dead", "late", "polarity", "swapped", "level", "unexplained")),
            "what is wrong with it",
            required=True,
        ),
        "delay_s": Key(bounds.COORDINATE, "by which it is late, s"),
        "microphone": Key(bounds.CHANNELS, "whose sound it carries, from 1"),
        "level_db": Key(Number(), "its level over that of the median channel, dB"),
        "corrected": Key(Boolean(), "whether the fault does no harm any more; else the channel is left out"),
    }
)
STEADY = Object(
    {
        "position": Key(bounds.VECTOR, "where it is, m in the room frame"),
        "direction": Key(bounds.VECTOR, "where it is as microphones close together see it, a unit vector"),
    },
    needed=(("position",), ("direction",)),
)
LOCALIZATION = Format(
    "localization",
    "The detections of one sensor at one time (Listing .4 of the thesis, with more keys)",
    Object(
        {
            "timestamp": TIMESTAMP,
            "sensor": Key(Text(filled=True), "name of the sensor"),
            "kind": Key(Choice(KINDS), 'kind of the sensor; if it is absent, "sensors" in config.json gives it'),
            "objects": Key(
                _objects(DETECTION), "the detections; an empty list where the sensor found nothing", required=True
            ),
            "channel_faults": Key(
                ListOf(FAULT), "what is known by then to be wrong with the microphones' channels", read=False
            ),
            "steady_sources": Key(
                ListOf(STEADY), "places of sources that sound without end and are no talkers, such as a fan", read=False
            ),
        }
    ),
)
TRACK = Format(
    "track",
    "The tracks at one time (Listing .5 of the thesis, with more keys)",
    Object({"timestamp": TIMESTAMP, "objects": Key(_objects(PERSON), "the people", required=True)}),
)
FRAME_RECORD = Format(
    "frame", "One camera frame", Object({"timestamp": TIMESTAMP, "frame": Key(FRAME, "the pictures", required=True)})
)
AUDIO_RECORD = Format(
    "audio",
    "One piece of sound",
    Object(
        {
            "timestamp": TIMESTAMP,
            "audio": Key(AUDIO, "the sound file", required=True),
            "activity": Key(
                MapOf(ListOf(bounds.TIMES)),
                "when each voice sounds (avsim-audio): object_id -> list of [start, end], s",
                read=False,
            ),
        }
    ),
)

# --- what is written and never read -----------------------------------------------------------------------------------

_COUNT = Integer(least=0)
_EXPLAINED_ID = (OrNull(_COUNT), "identity in the tracks; null: not in the tracks so far")
_LABEL = (_COUNT, "the tracker's own name for a person")


def always(**keys: tuple[Kind, str]) -> Object:
    """Describe an object that always has all of these keys."""
    return Object({name: Key(kind, text, required=True) for name, (kind, text) in keys.items()})


_BIRTH = always(
    label=_LABEL,
    detection=(_COUNT, "number of the detection that started the track"),
    existence=(PROBABILITY, "probability that it is a person"),
    object_id=_EXPLAINED_ID,
)
_DEATH = always(
    label=_LABEL,
    existence=(PROBABILITY, "probability that it still is a person"),
    because=(Text(), "the reason"),
    object_id=_EXPLAINED_ID,
)
_EXPLAINED_PERSON = always(
    label=_LABEL,
    most_likely=(
        Either((_COUNT, Choice(("missed", "absent")))),
        "number of the detection that the person most probably caused, or why there is none",
    ),
    probability=(PROBABILITY, "probability of that"),
    leave_rate=(Number(least=0), "rate at which the person leaves where he or she was before this record, 1/s"),
    last_seen=(OrNull(bounds.TIME), "when a sensor detected the person last before this record, s"),
    object_id=_EXPLAINED_ID,
)
ERRORS = always(
    noise_factor=(Number(above=0, most=1e6), "the covariances of its detections are multiplied by this"),
    floor_factor=(Number(above=0, most=1e6), "and so is the square of what is added to them"),
    detections=(
        Number(0, most=1e12),
        "number of detections on which the factors rest; what is known beforehand counts, too",
    ),
    bias=(bounds.VECTOR, "systematic error along x, along y, and forward in the direction of walking, m"),
    bias_sd=(Numbers(3, bounds.DISTANCE), "standard deviations of these, m"),
    lasting_sd=(bounds.DISTANCE, "standard deviation of the error that does not average away, m"),
)
FALSE_PLACE = always(
    position=(Numbers(2, bounds.COORDINATE), "where, m"),
    variance=(Number(above=0, most=1e12), "variance of its detections along each axis, m²"),
    hits=(Number(above=0, most=1e12), "records with a false detection there, with the prior's worth"),
    misses=(Number(above=0, most=1e12), "records without one"),
    log_odds=(Number(-100, most=100), "log odds that nobody is there"),
)
_EXPLAINED_DETECTION = always(
    position=(Numbers(2), "position without the sensor's bias, m"),
    unclaimed=(PROBABILITY, "probability that no known person caused it"),
    person_if_unclaimed=(PROBABILITY, "probability of a new person if no known person caused it"),
    clutter_density=(
        Number(least=0),
        "density of false detections here, 1/m² (of directions 1/rad or 1/rad², of distances 1/m)",
    ),
    stranger_density=(Number(least=0), "density of people without a track, in the same unit"),
)
_EXPLAINED_DETECTION = Object(
    {
        **_EXPLAINED_DETECTION.keys,
        "features": Key(
            MapOf(Number()),
            "for known people near it, by label: log ratio of the probabilities of its features, if it is that person "
            "and if it is anybody; absent where it has no features",
        ),
    }
)
_HYPOTHESIS = always(
    weight=(PROBABILITY, "probability of the joint hypothesis"),
    detections=(ListOf(OrNull(_COUNT)), "one for each label; null: missed or absent"),
)
_CLUSTER = always(
    labels=(ListOf(_COUNT, 1), "the people"),
    count=(Integer(least=1), "number of joint hypotheses"),
    best=(ListOf(_HYPOTHESIS, 1, 5), "the most probable joint hypotheses"),
)
EXPLAIN = Format(
    "explain",
    "How the tracker used one record of one sensor (avfuse --explain)",
    always(
        timestamp=(
            Written({"type": "string", "pattern": r"^-?\d+\.\d{10}$"}, "a number of seconds with ten decimals"),
            "time of the sensor's record, s",
        ),
        sensor=(Text(), "name of the sensor"),
        expected_clutter=(Number(least=0), "expected number of false detections in one record"),
        detection_probability=(PROBABILITY, "probability that the sensor detects a person"),
        hide_rate=(Number(least=0), "rate at which a person becomes hidden from the sensor, 1/s"),
        show_rate=(Number(least=0), "rate at which a hidden person becomes visible or audible again, 1/s"),
        all_left=(
            PROBABILITY,
            "when the sensor suddenly detects nobody: probability that everybody left, as far as earlier cases tell",
        ),
        blind=(PROBABILITY, "probability that the sensor can detect nobody at the moment"),
        detections=(
            ListOf(_EXPLAINED_DETECTION),
            "detections in order of x, then y, without exact repetitions; other keys give their number in this list",
        ),
        people=(ListOf(_EXPLAINED_PERSON), "the known people"),
        clusters=(ListOf(_CLUSTER), "people whose detections are assigned together"),
        existence_before=(MapOf(PROBABILITY), "probabilities of existence before this record, by label"),
        errors=(ERRORS, "what is known of the errors of the sensor"),
        false_places=(
            ListOf(FALSE_PLACE),
            "places where the sensor probably detects somebody falsely, again and again",
        ),
        born=(ListOf(_BIRTH), "new tracks"),
        died=(ListOf(_DEATH), "tracks that ended"),
    ),
)

RECORDS = (GROUNDTRUTH, FRAME_RECORD, AUDIO_RECORD, LOCALIZATION, TRACK, EXPLAIN)
