"""What each format may hold: the records and config.json. Readers, JSON Schemas and avcli-formats(5) follow from this.

`make formats` writes the schemas and the manual's key lists anew after a change here. A key that a reader is to use
gets its kind here, and its reader finds it in the dictionary that `read` returns.
"""

from dataclasses import dataclass

from avcli import lens
from avcli.formats.schema import (
    IDENTITY,
    Boolean,
    Choice,
    Covariance,
    Either,
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
    Written,
)
from avcli.formats.sensors import KINDS
from avcli.numeric import SPEED_OF_SOUND_M_S

DIRECTIVITIES = {"omni": 1.0, "subcardioid": 0.75, "cardioid": 0.5, "hypercardioid": 0.25, "bidirectional": 0.0}
"""Microphone patterns a + (1 − a) cos θ by their a; the thesis's file says "omni"."""

PROBABILITY = Number(least=0, most=1)
BOX = Numbers(4)
TIMESTAMP = Key(
    Timestamp(),
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
        "object_id": Key(IDENTITY, "identity of the person, the same in all records", required=True),
        "position": Key(Point(), "point on the floor under the body's axis, m in the room frame", required=True),
        "mouth_position": Key(Numbers(3), "where the voice comes from, m in the room frame"),
        "speaking": Key(
            Either((Boolean(), PROBABILITY)),
            "in ground truth, whether it is the person's turn to speak; in tracks, a probability",
        ),
        "bbox_px": Key(BOX, "box [x0, y0, x1, y1] around the visible pixels, px; absent where none is visible"),
        "velocity": Key(Numbers(3), "velocity, m/s"),
        "covariance": Key(Covariance(), "covariance of the position, m²"),
        "existence": Key(PROBABILITY, "probability that the track is a person"),
    }
)
"""A person of a ground-truth or track record, with the keys that readers use in either."""

FRAME = Object(
    {
        "rgb": Key(Text(), "path of the colour picture, relative to the experiment directory", required=True),
        "depth": Key(Text(), "path of the depth picture"),
        "mask": Key(Text(), "path of the picture of person numbers (avsim-scene --mask)", read=False),
    }
)

AUDIO = Object(
    {
        "path": Key(Text(), "path of the sound file, relative to the experiment directory", required=True),
        "start_sample": Key(Integer(), "number of the first sample; sample 0 is time 0 of the scene", required=True),
        "num_samples": Key(Integer(least=0), "number of samples in the file", required=True),
        "sample_rate_hz": Key(Integer(least=1), "sample rate, Hz", required=True),
        "num_channels": Key(Integer(least=1), "number of microphones", required=True),
        "tail_samples": Key(
            Integer(least=0),
            "number of samples after the scene's end, where only reverberation is left; at most "
            "num_samples; by default config.json's reverberation time, at the end of the recording",
        ),
    }
)

DETECTION = Object(
    {
        "position": Key(
            Point(height_may_be_null=True),
            "position, m in the room frame; z is null or absent where it was not observed",
            required=True,
        ),
        "covariance": Key(Covariance(), "covariance of the position, m²; a zero variance means: not observed"),
        "score": Key(PROBABILITY, "probability that the detection is right"),
        "bbox_px": Key(BOX, "box [x0, y0, x1, y1] in the full image, px"),
        "height": Key(Number(), "height of the person, m"),
    }
)

_TRUE_PERSON = Object(
    {
        **PERSON.keys,
        "visible_fraction": Key(
            PROBABILITY, "share of the body's pixels in view; occlusion and the image's border reduce it", read=False
        ),
        "bbox_full_px": Key(BOX, "the same box without occlusion and without the image's border", read=False),
        "keypoints_px": Key(
            ListOf(Numbers(3), 17, 17),
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
            "objects": Key(ListOf(_TRUE_PERSON), "the people", required=True),
            "frame": Key(FRAME, "the camera's pictures of this time"),
        }
    ),
)
LOCALIZATION = Format(
    "localization",
    "What one sensor found at one time (Listing .4 of the thesis, with more keys)",
    Object(
        {
            "timestamp": TIMESTAMP,
            "sensor": Key(Text(filled=True), "name of the sensor"),
            "kind": Key(Choice(KINDS), 'what the sensor is; where it is absent, "sensors" in config.json says it'),
            "objects": Key(
                ListOf(DETECTION), "the detections; an empty list where the sensor found nothing", required=True
            ),
        }
    ),
)
TRACK = Format(
    "track",
    "The tracks at one time (Listing .5 of the thesis, with more keys)",
    Object({"timestamp": TIMESTAMP, "objects": Key(ListOf(PERSON), "the people", required=True)}),
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
                MapOf(ListOf(Numbers(2))),
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


def _written(**keys: tuple[Kind, str]) -> Object:
    """Describe an object that always has all of these keys."""
    return Object({name: Key(kind, text, required=True) for name, (kind, text) in keys.items()})


_BIRTH = _written(
    label=_LABEL,
    detection=(_COUNT, "number of the detection that started the track"),
    existence=(PROBABILITY, "probability that it is a person"),
    object_id=_EXPLAINED_ID,
)
_DEATH = _written(
    label=_LABEL,
    existence=(PROBABILITY, "probability that it still is a person"),
    because=(Text(), "the reason"),
    object_id=_EXPLAINED_ID,
)
_EXPLAINED_PERSON = _written(
    label=_LABEL,
    most_likely=(
        Either((_COUNT, Choice(("missed", "absent")))),
        "number of the detection that the person most probably caused, or why there is none",
    ),
    probability=(PROBABILITY, "probability of that"),
    object_id=_EXPLAINED_ID,
)
_EXPLAINED_DETECTION = _written(
    position=(Numbers(2), "position, m"),
    unclaimed=(PROBABILITY, "probability that no known person caused it"),
    person_if_unclaimed=(PROBABILITY, "probability of a new person if no known person caused it"),
    clutter_density=(Number(least=0), "density of false detections here, 1/m²"),
    stranger_density=(Number(least=0), "density of people who are not known yet, 1/m²"),
)
_HYPOTHESIS = _written(
    weight=(PROBABILITY, "probability of the joint hypothesis"),
    detections=(ListOf(OrNull(_COUNT)), "one for each label; null: missed or absent"),
)
_CLUSTER = _written(
    labels=(ListOf(_COUNT, 1), "the people"),
    count=(Integer(least=1), "number of joint hypotheses"),
    best=(ListOf(_HYPOTHESIS, 1, 5), "the most probable joint hypotheses"),
)
EXPLAIN = Format(
    "explain",
    "What one record of one sensor meant to the tracker (avfuse --explain)",
    _written(
        timestamp=(
            Written({"type": "string", "pattern": r"^-?\d+\.\d{10}$"}, "a number of seconds with ten decimals"),
            "time of the sensor's record, s",
        ),
        sensor=(Text(), "name of the sensor"),
        expected_clutter=(Number(least=0), "expected number of false detections in one record"),
        detection_probability=(PROBABILITY, "probability that the sensor detects a person"),
        detections=(
            ListOf(_EXPLAINED_DETECTION),
            "detections in order of x, then y, without exact repetitions; other keys give their number in this list",
        ),
        people=(ListOf(_EXPLAINED_PERSON), "the known people"),
        clusters=(ListOf(_CLUSTER), "people whose detections are decided together"),
        existence_before=(MapOf(PROBABILITY), "probabilities of existence before this record, by label"),
        born=(ListOf(_BIRTH), "new tracks"),
        died=(ListOf(_DEATH), "tracks that ended"),
    ),
)

# --- config.json ------------------------------------------------------------------------------------------------------

_LENGTH = Number(above=0)
_DIRECTION = Numbers(3)
_PLACE = Numbers(3)

LENS_KEYS = {
    "lens_model": Key(
        Choice(tuple(lens.LENSES)),
        "the lens model; kannala_brandt is OpenCV's fisheye (KB-8), brown_conrady has four radial terms, division is "
        "the thesis's shader",
        default="division",
    ),
    "fx_px": Key(_LENGTH, "focal length, px", required=True),
    "fy_px": Key(_LENGTH, "focal length, px", required=True),
    "cx_px": Key(Number(), "principal point, px; pixel (0, 0) is the centre of the top-left pixel", required=True),
    "cy_px": Key(Number(), "principal point, px", required=True),
    **{f"k{i}": Key(Number(), "coefficient of the lens model", default=0.0) for i in (1, 2, 3, 4)},
}
CAMERA = Object(
    {
        **LENS_KEYS,
        "camera_position_m": Key(
            _PLACE, "position of the camera in the room, m; required by commands that place things in the room"
        ),
        "camera_rotation_deg": Key(
            _DIRECTION,
            "orientation: pitch, yaw, roll; [90, 0, 0] looks straight down with image right = +x and image up = +y",
            default=[90.0, 0.0, 0.0],
        ),
        "image_width_px": Key(Integer(least=1), "width of the image, px", default=1920),
        "image_height_px": Key(Integer(least=1), "height of the image, px", default=1080),
        "frame_rate_hz": Key(_LENGTH, "frames in a second, Hz", default=10.0),
        "depth_kind": Key(
            Choice(("radial", "z")),
            "meaning of depth: m along the pixel's ray (radial), or along the optical axis (z)",
            default="radial",
        ),
        "depth_step_m": Key(_LENGTH, "one step of a depth picture, m; value 0 means: no depth", default=1e-4),
        "background_depth": Key(Text(), "path of the empty room's depth picture, relative to the experiment directory"),
        "theta_max_observed_deg": Key(
            Number(least=0), "largest angle from the axis at which the calibration saw corners; no rays beyond it"
        ),
        "theta_max_valid_deg": Key(Number(least=0), "largest angle at which the lens is one-to-one; no rays beyond it"),
    }
)
_PATTERN = Choice(tuple(DIRECTIVITIES))
MICROPHONES = Object(
    {
        "mic_positions_m": Key(
            ListOf(
                Either(
                    (
                        _PLACE,
                        Object(
                            {
                                "object_id": Key(Integer(), "number of the microphone", read=False),
                                "position": Key(_PLACE, "position, m", required=True),
                            }
                        ),
                    )
                ),
                least=1,
            ),
            "positions in the order of the channels, m: lists [x, y, z], or objects",
            required=True,
        ),
        "audio_sample_rate_hz": Key(Integer(least=1), "sample rate, Hz", default=44100),
        "audio_bit_depth": Key(Choice((16, 24, 32)), "bits of a sample", default=32),
        "mic_directivity": Key(_PATTERN, "pattern of all microphones", default="omni"),
        "directivities": Key(ListOf(_PATTERN), "pattern of each microphone, in place of mic_directivity"),
        "orientations": Key(
            ListOf(_DIRECTION), "direction in which each microphone looks, a vector of any length; default: down"
        ),
    }
)
ROOM = Object(
    {
        "room_dimensions_m": Key(Numbers(3, _LENGTH), "size of the room along x, y and z, m", required=True),
        "reverberation_time_s": Key(Number(least=0), "reverberation time T60, s"),
        "absorption": Key(
            Either((PROBABILITY, Numbers(6, PROBABILITY))),
            "energy absorption of all walls, or of each in the order x0 x1 y0 y1 z0 z1",
        ),
        "speed_of_sound_m_s": Key(_LENGTH, "speed of sound, m/s", default=SPEED_OF_SOUND_M_S),
    }
)
SENSORS = MapOf(Object({"kind": Key(Choice(KINDS), "what the sensor is", required=True)}))
CONFIG = Format(
    "config",
    "config.json of an experiment (Listing .1 of the thesis, with more keys)",
    Object(
        {
            "session_id": Key(Text(), "any text", read=False),
            "camera_config": Key(CAMERA, "the camera: its lens, its place, its pictures"),
            "microphone_config": Key(MICROPHONES, "the microphones"),
            "room_config": Key(ROOM, "the room"),
            "sensors": Key(
                SENSORS,
                'what each named sensor is: {"ceiling": {"kind": "camera"}, "ring": {"kind": "microphones"}}; '
                "a sensor that is not listed, and whose records do not say their kind, is guessed from its name",
            ),
            "written_by": Key(
                Written({"type": "object"}),
                "command that wrote the file; a run overwrites only its own directory",
                read=False,
            ),
        }
    ),
)

FORMATS = (GROUNDTRUTH, FRAME_RECORD, AUDIO_RECORD, LOCALIZATION, TRACK, EXPLAIN, CONFIG)
