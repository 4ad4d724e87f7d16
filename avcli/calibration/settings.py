"""Settings of a calibration. The options of avcalib are made from them."""

from dataclasses import dataclass

from avcli.settings import setting

_SEEN = "as the pictures show"


@dataclass(frozen=True)
class BoardSettings:
    """The printed board."""

    board: str | None = setting(
        None,
        "Size of the board as printed: along a row, and along a column; squares, tags or circles. Make one count of "
        "squares odd and one even; otherwise the board looks the same upside down.",
        unit="COLSxROWS",
        default_text=_SEEN,
    )
    kind: str | None = setting(
        None,
        "What is printed. aprilgrid: as Kalibr draws it. asymmetric: every other row of circles is shifted.",
        choices=("checkerboard", "charuco", "aprilgrid", "circles", "asymmetric"),
        default_text=_SEEN,
    )
    square_mm: float | None = setting(
        None,
        "Side of a square or tag in mm, or the distance between circles. The lens does not depend on it; lengths are "
        "stated only if it is given.",
        unit="MM",
        above=0.0,
        flag="--square",
    )
    dictionary: str | None = setting(
        None,
        "Dictionary of the markers of a ChArUco board, as OpenCV calls it: 4X4_50 to 7X7_1000, APRILTAG_36h11, and so "
        "on.",
        unit="NAME",
        default_text=_SEEN,
    )
    ratio: float | None = setting(
        None,
        "charuco: side of a marker over side of a square. aprilgrid: space between tags over side of a tag "
        "(tagSpacing). circles: diameter over distance.",
        unit="N",
        above=0.0,
        below=1.0,
        default_text=_SEEN,
    )
    legacy: bool = setting(
        False, "The ChArUco board has an even number of rows and begins with a marker, as OpenCV drew it before 4.6."
    )


TO_PRINT: dict[str, dict[str, str]] = {
    "board": {"default_text": "7x10; 6x6 tags, 7x9 or 4x11 circles"},
    "kind": {"default_text": "checkerboard"},
    "square_mm": {"text": "Side of a square or tag in mm, or the distance between circles."},
    "dictionary": {"default_text": "5X5_250"},
    "ratio": {"default_text": "0.75; 0.3 of tags, 0.5 of circles"},
}
"""What else is said of a board's settings where it is drawn, by the names of the fields. See target.KINDS."""


@dataclass(frozen=True)
class PictureSettings:
    """Which pictures to take from a source."""

    rate_hz: float | None = setting(
        2.0,
        "Pictures per second to take from a video or a camera. Single picture files are all used.",
        unit="HZ",
        above=0.0,
        flag="--rate",
    )


@dataclass(frozen=True)
class FitSettings:
    """How the lens is fitted."""

    lens_model: str | None = setting(
        None,
        "Lens model to fit, as in config.json. kannala_brandt suits fisheyes, brown_conrady ordinary lenses. "
        "kannala_brandt+tangential and brown_conrady+tangential suit lenses that are not quite centred. auto: try all "
        "models, and take the simplest that held-out pictures cannot tell from the best.",
        unit="MODEL",
        default_text="kannala_brandt; another one if the pictures show that it does not fit",
        only="avcli",
    )
    procedure: str = setting(
        "avcli",
        "avcli: robust fit. thesis: OpenCV's fit, twice; pictures above --max-rms are dropped in between.",
        choices=("avcli", "thesis"),
    )
    max_rms_px: float = setting(
        0.75,
        "RMS residual in px above which --procedure thesis drops a picture.",
        unit="PX",
        above=0.0,
        flag="--max-rms",
        only="thesis",
    )
    board_shape: str = setting(
        "auto",
        "Also fit the bow and the stretch of the board. auto: only if this improves held-out pictures by 2 %.",
        choices=("auto", "yes", "no"),
        only="avcli",
    )


@dataclass(frozen=True)
class ProjectionSettings:
    """How pictures are straightened."""

    projection: str = setting(
        "perspective",
        "perspective: all straight lines stay straight. cylindrical: vertical lines stay straight, and the view may be "
        "wider. whole: everything that the lens sees, as azimuth and elevation.",
        choices=("perspective", "cylindrical", "whole"),
    )
    balance: float = setting(
        0.0,
        "Width of a perspective picture. 0: no black borders. 1: everything up to 80 degrees from the axis.",
        unit="N",
        least=0.0,
        most=1.0,
        only="perspective",
    )
    fov_deg: float | None = setting(
        None, "Width of the view in degrees. It replaces --balance.", unit="DEG", least=1.0, most=360.0, flag="--fov"
    )


@dataclass(frozen=True)
class ConvertSettings:
    """How a camera is converted."""

    to: str | None = setting(
        None,
        "Format to write. avcli: a camera_config.",
        choices=("avcli", "opencv", "ros", "kalibr", "colmap", "mrcal"),
        default_text="by the name of the output",
    )
    model: str | None = setting(
        None,
        "Lens model of the other tool to use, by its name there, such as OPENCV8.",
        unit="MODEL",
        default_text="the same lens, else the nearest one",
    )
    camera: str | None = setting(None, "Which camera of a file that has several, such as cam1.", unit="NAME")
    fisheye: bool | None = setting(
        None,
        "Whether four coefficients that OpenCV wrote are those of its fisheye model, where the file does not say.",
        flag="--fisheye/--no-fisheye",
        default_text="as the file says",
    )
    max_error_px: float = setting(
        0.5,
        "Exit 3 and write nothing if the nearest lens of the other tool is further from the camera than this many px "
        "(RMS).",
        unit="PX",
        least=0.0,
        flag="--max-error",
    )


@dataclass(frozen=True)
class CheckSettings:
    """When a lens no longer fits."""

    fail_over_px: float | None = setting(
        None, "Exit 3 if the RMS residual exceeds this many px.", unit="PX", above=0.0, flag="--fail-over"
    )


@dataclass(frozen=True)
class LiveSettings:
    """How filming is guided."""

    port: int = setting(
        8080,
        "Port of the page that shows the camera with corners, coverage and the next place for the board. 0: no page.",
        unit="N",
        least=0,
        most=65535,
    )
    host: str = setting(
        "127.0.0.1",
        "Address at which the page is served. With 0.0.0.0 a phone in the same network can open it; its address then "
        "holds a key.",
        unit="ADDRESS",
    )
    enough_px: float | None = setting(
        None,
        "Mean expected error over the picture, in px, that is enough.",
        unit="PX",
        above=0.0,
        flag="--enough",
        default_text="1/6400 of the picture's width, or 0.02° on the axis if that is more",
    )
    stops: bool = setting(True, "Whether to stop when it is enough, or only at Ctrl-C.", flag="--stop/--no-stop")


@dataclass(frozen=True)
class PrintSettings:
    """How a board is drawn."""

    paper: str | None = setting(
        None,
        "Paper: A4, A3, A2, A1, A0, letter, legal, tabloid, or its size in mm, such as 500x700; the sheet is turned as "
        "the board needs it.",
        unit="PAPER",
        default_text="a page as large as the board",
    )
    format: str | None = setting(
        None, "Format.", choices=("svg", "pdf", "png"), default_text="by the name of -o, otherwise svg"
    )
    dpi: float = setting(300.0, "Pixels per inch of a PNG.", unit="N", least=20.0, most=2400.0, only="png")


@dataclass(frozen=True)
class MicrophoneSettings:
    """What is known of an array, and of the voice, before they are measured by sound."""

    mouth_height_m: float = setting(
        1.6,
        "Height of the mouth in m, for records that do not give the position of the mouth.",
        unit="M",
        least=0.3,
        most=2.2,
        flag="--mouth-height",
    )
    position_sd_m: float = setting(
        0.04,
        "How far a microphone may be from its position in config.json along each axis: a standard deviation in m.",
        unit="M",
        least=0.001,
        most=1.0,
        flag="--position-sd",
    )
    track_sd_m: float = setting(
        0.05,
        "Standard deviation of a track along each axis in m; its error lasts 2 s.",
        unit="M",
        least=0.001,
        most=1.0,
        flag="--track-sd",
    )
    temperature_c: float | None = setting(
        None,
        "Temperature of the air in °C, if it is known to 1 degree.",
        unit="C",
        least=-50.0,
        most=60.0,
        flag="--temperature",
        default_text="the config's speed of sound, to 2 m/s",
    )


@dataclass(frozen=True)
class PlaceSettings:
    """How the camera's pose is found."""

    yaw_deg: float = setting(
        0.0,
        "Direction of the board's rows: degrees from the room's x axis, counter-clockwise seen from above.",
        unit="DEG",
        flag="--yaw",
    )
    sigma_px: float | None = setting(
        None,
        "Standard deviation of a pixel coordinate in px, for the covariance.",
        unit="PX",
        above=0.0,
        flag="--sigma",
        default_text="from the residuals",
    )
