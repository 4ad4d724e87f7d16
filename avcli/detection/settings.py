"""Settings of the detector; the command's options are made from them."""

from dataclasses import dataclass

from avcli.settings import check, setting

FEWEST = 30
"""Pictures that a film must have to learn from it."""


@dataclass(frozen=True)
class Settings:
    """How people are found and placed; `only="net"` marks what the depth detector does not have."""

    detector: str = setting(
        "net",
        "How people are found: net, by a network in the colour picture; depth, as what is nearer than the empty room.",
        choices=("net", "depth"),
    )
    confidence: float | None = setting(
        None,
        "Least score of a person that the network finds.",
        unit="P",
        least=0.0,
        most=1.0,
        default_text="0.5; 0.3 for a person who was found there a moment before, and for the package's own "
        "network where the empty room's depth tells who is there",
        only="net",
    )
    iou: float | None = setting(
        None,
        "Two of the network's boxes whose intersection over union is larger than this are one person.",
        unit="P",
        least=0.0,
        most=1.0,
        default_text="the model's, else 0.7",
        only="net",
    )
    imgsz: tuple[int, int] | None = setting(
        None,
        "Size of the network's input in px, where the model leaves it open.",
        unit="WxH",
        least=32,
        most=4096,
        default_text="the model's longest side, else 640, in the picture's shape",
        only="net",
    )
    windows: int | None = setting(
        None,
        "Look at N windows in place of the whole picture. They are turned so that people stand upright in them, for a "
        "model that knows people from photographs, such as those of COCO.",
        unit="N",
        least=3,
        most=64,
        default_text="the whole picture",
        only="net",
    )
    learn_background: bool = setting(
        False,
        "Learn the colours of the room from the film, and leave out boxes that show nothing else.",
        only="net",
    )
    stillness: bool = setting(
        True,
        "Without the empty room's depth: give a lower score to a person who does not move at all in the film, since "
        "plants and chairs do not.",
        flag="--stillness/--no-stillness",
        only="net",
    )
    monocular: bool = setting(
        False, "Place people by the colour picture alone, even where there is a depth picture.", only="net"
    )
    position: str = setting(
        "body",
        "The position where there is depth: body, the body's axis, from all its pixels; centre, the surface at the "
        "middle pixel of the box, as in the thesis.",
        choices=("body", "centre"),
        only="net",
    )
    refresh: int = setting(
        10,
        "The network looks at the whole of every N-th picture, and at what has changed in the others; 1: at the whole "
        "of each.",
        unit="N",
        least=1,
        only="net",
    )
    threads: int = setting(
        1,
        "Threads of the network; more than one helps on an idle machine only.",
        unit="N",
        least=1,
        most=64,
        only="net",
    )

    sensor: str = setting(
        "video",
        'The camera\'s name in the records. If "sensors" in config.json has a camera_config of this name, that camera '
        "is used.",
        unit="NAME",
    )
    features: bool | None = setting(
        None,
        "Say what each person wears, from the colour picture, so that avfuse can tell people apart.",
        flag="--features/--no-features",
        default_text="features with --detector net",
    )

    def __post_init__(self) -> None:
        check(self)
        if not self.sensor:
            raise ValueError("sensor must be a name, not empty")


@dataclass(frozen=True)
class TeachingSettings:
    """How a small network learns one camera and room from a teacher."""

    windows: int = setting(
        8,
        "The teacher looks at N windows that are turned so that people stand upright in them; 0: at the whole picture.",
        unit="N",
        least=0,
        most=64,
    )
    confidence: float = setting(
        0.3, "Least score of the teacher that counts as a person.", unit="P", least=0.1, most=1.0
    )
    pictures: int = setting(
        300, "Learn from at most N pictures, at equal steps through the film.", unit="N", least=FEWEST, most=5000
    )
    steps: int = setting(
        150, "Learn for N steps of eight pictures; 150 take some two minutes.", unit="N", least=1, most=100_000
    )

    def __post_init__(self) -> None:
        check(self)
