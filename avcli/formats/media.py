"""Pictures and sound in files: lossless PNG frames, WAV and FLAC.

A file appears whole or not at all. It holds no time of writing, so that the same content gives the same bytes.
"""

import contextlib
import errno
import functools
import math
import os
import stat
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from avcli.formats import atomic
from avcli.formats.bounds import LARGEST_PICTURE_FILE, MOST_CHANNELS, MOST_PIXELS
from avcli.formats.png import KINDS, SIGNATURE, decode_png, encode_png

if TYPE_CHECKING:
    import soundfile

FLAC_CHANNELS = 8
"""The most channels that a FLAC file can have (RFC 9639, 9.1.3)."""


class MediaError(ValueError):
    """A file that is not a picture or sound, or not the expected kind."""


@dataclass(frozen=True)
class Sound:
    """What microphones heard.

    Attributes:
        samples: (n, channels), full scale 1; sample 0 is time 0 of the scene.
        sample_rate_hz: Hz.
        tail_samples: how many of the samples come after the scene's end.
    """

    samples: np.ndarray
    sample_rate_hz: int
    tail_samples: int = 0


@dataclass(frozen=True)
class Shot:
    """What a camera saw at one time.

    Attributes:
        timestamp: s.
        rgb: (height, width, 3) uint8, None where there is none.
        depth: (height, width) uint16, in steps of the camera's `depth_step_m`; 0: unknown. None where there is none.
    """

    timestamp: float
    rgb: np.ndarray | None
    depth: np.ndarray | None


# --- pictures ---------------------------------------------------------------------------------------------------------


def write_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write a picture (height, width[, channels]), see `encode_png`, to a file, whole or not at all."""
    atomic.write_bytes(path, encode_png(image))


def read_rgb(path: str | os.PathLike) -> np.ndarray:
    """Read a colour picture (PNG, JPEG or raw .npy; grey, 16-bit and transparent ones are converted).

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        MediaError: the file is missing, empty or not a picture.
    """
    image = read_picture(path)
    if image.ndim not in (2, 3) or image.size == 0 or image.dtype not in (np.uint8, np.uint16):
        raise MediaError(f"{path}: not a picture of 8 or 16 bits, but {_described(image)}")
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 2:
        image = np.repeat(image[:, :, None], 3, axis=2)
    return np.ascontiguousarray(image[:, :, :3])


def read_depth(path: str | os.PathLike) -> np.ndarray:
    """Read a depth picture (one channel of 8 or 16 bits, PNG or raw .npy), in the steps that config.json states.

    Returns:
        (height, width) uint8 or uint16; 0 where there is no depth.

    Raises:
        MediaError: the file is missing, empty, not a picture, or has several channels.
    """
    image = read_picture(path)
    if image.ndim != 2 or image.size == 0 or image.dtype not in (np.uint8, np.uint16):
        raise MediaError(f"{path}: a depth picture has one channel of 8 or 16 bits, not {_described(image)}")
    return image


def is_depth(path: str | os.PathLike) -> bool:
    """Whether a PNG or raw .npy file holds one channel of 16 bits, as depth pictures do; from its header alone."""
    try:
        with open(path, "rb") as file:
            head = file.read(26)
        if head.startswith(b"\x93NUMPY"):
            image = np.load(path, mmap_mode="r")
            return image.ndim == 2 and image.dtype == np.uint16
    except (OSError, ValueError):
        return False
    return head.startswith(SIGNATURE) and head[24:26] == b"\x10\x00"  # bit depth 16, grey (PNG, 11.2.2)


def read_picture(path: str | os.PathLike, *, whole: bool = False, grey: bool = False) -> np.ndarray:
    """Read a picture file as it is (PNG, JPEG and what else OpenCV reads, or raw .npy).

    Args:
        path: of the file.
        whole: refuse a picture whose end is missing; otherwise what is there is taken.
        grey: the brightness of a JPEG is enough, which is quicker.

    Returns:
        (height, width[, 3 RGB or 4 RGBA]), in the type that the file holds: mostly uint8 or uint16.

    Raises:
        MediaError: the file is missing, empty or not a picture.
    """
    content = read_bytes(path)
    if whole and _is_cut_off(content):
        raise MediaError(f"{path}: the end of the picture is missing")
    if (size := stated_size(content)) and size[0] * size[1] > MOST_PIXELS:
        raise MediaError(f"{path}: a picture has at most {MOST_PIXELS} pixels, and this one has {size[0]} × {size[1]}")
    if content.startswith(b"\x93NUMPY"):
        image: np.ndarray | None = _raw_picture(content, path)
    else:
        image = decode_picture(content, grey=grey)
    if image is None:
        if content[4:8] == b"ftyp" and content[8:12] in _HEIC_BRANDS:
            raise MediaError(f"{path}: a HEIC picture, which cannot be read; convert it to JPEG or PNG")
        raise MediaError(f"{path}: not a picture that can be read ({len(content)} bytes)")
    return image


_HEIC_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1"}
"""ISO/IEC 23008-12, what the file type of a HEIC picture may be."""


def _is_cut_off(content: bytes) -> bool:
    """Whether a JPEG or PNG has no end."""
    if content.startswith(b"\xff\xd8"):
        return jpeg_end(content) < 0
    return content.startswith(SIGNATURE) and b"IEND" not in content[-4096:]


def jpeg_end(content: bytes, begin: int = 0) -> int:
    """Find where a JPEG that begins at `begin` ends; -1 where its end is missing.

    Its header is stepped over, since it may hold another picture (ITU-T T.81, B.1.1): phones put a small one there.
    """
    place = begin + 2
    while place + 4 <= len(content) and content[place] == 0xFF:
        marker = content[place + 1]
        if marker in (0xDA, 0xD9):  # the scan begins, or the picture ends
            break
        alone = marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD7
        place += 1 if marker == 0xFF else 2 if alone else 2 + int.from_bytes(content[place + 2 : place + 4], "big")
    if place + 4 > len(content):
        return -1
    end = content.find(b"\xff\xd9", place)
    return end + 2 if end >= 0 else -1


def _raw_picture(content: bytes, path: str | os.PathLike) -> np.ndarray:
    import io

    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        head = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_columns, kind = head(stream)
        if kind.hasobject or math.prod(shape) * kind.itemsize != len(content) - stream.tell():
            raise ValueError(f"its header states {kind} {shape}, which is not what follows")
        pixels: np.ndarray = np.frombuffer(content, kind, offset=stream.tell())
        return pixels.reshape(shape, order="F" if by_columns else "C")
    except (ValueError, EOFError) as error:
        raise MediaError(f"{path}: a broken .npy file: {error}") from None


def stated_size(content: bytes) -> tuple[int, int] | None:
    """Read the width and height in px from a picture's header; None where it is not PNG or JPEG, or is broken."""
    if content.startswith(SIGNATURE) and len(content) >= 24:
        return struct.unpack(">II", content[16:24])
    if not content.startswith(b"\xff\xd8"):
        return None
    place = 2
    while place + 9 <= len(content) and content[place] == 0xFF:  # JPEG's segments (ITU-T T.81, B.1.1)
        marker = content[place + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a frame header
            height, width = struct.unpack(">HH", content[place + 5 : place + 9])
            return width, height
        alone = marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD7
        place += 1 if marker == 0xFF else 2 if alone else 2 + struct.unpack(">H", content[place + 2 : place + 4])[0]
    return None


def decode_picture(content: bytes, *, grey: bool = False) -> np.ndarray | None:
    """Decode the content of a picture file, (height, width[, 3 RGB or 4 RGBA]); None where it is not a picture.

    With `grey` a JPEG gives its brightness only, (height, width).
    """
    if (size := stated_size(content)) and size[0] * size[1] > MOST_PIXELS:
        return None
    if (own := decode_png(content)) is not None:
        return own
    quiet_decoders()
    import cv2

    try:
        only = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        kind = only if grey and content.startswith(b"\xff\xd8") else cv2.IMREAD_UNCHANGED
        image = cv2.imdecode(np.frombuffer(content, np.uint8), kind)
    except cv2.error:
        return None
    return None if image is None else swapped(image)


def encode_picture(image: np.ndarray, suffix: str) -> bytes:
    """Encode a picture in the format of an extension, such as ".png" or ".jpg".

    Args:
        image: (height, width[, 3 RGB or 4 RGBA]) uint8 or uint16.
        suffix: the extension, with its dot.

    Raises:
        MediaError: there is no such format, or it does not take such a picture.
    """
    if suffix.lower() == ".png" and (image.dtype.name, image.shape[2] if image.ndim == 3 else 1) in KINDS:
        return encode_png(image)
    import cv2

    try:
        coded, content = cv2.imencode(suffix, swapped(image))
    except cv2.error:
        coded = False
    if not coded:
        raise MediaError(f"pictures of {_described(image)} cannot be written as {suffix!r}")
    return content.tobytes()


def swapped(image: np.ndarray) -> np.ndarray:
    """Turn a picture (height, width, 3 or 4) RGB[A] into OpenCV's BGR[A], and back; a grey one stays as it is."""
    import cv2

    if image.ndim == 3 and image.shape[2] in (3, 4):
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB)
    return image


def quiet_decoders() -> None:
    """Keep the messages of OpenCV's decoders off stderr: our own error says what is wrong with a file."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))  # for the formats that `stated_size` lacks


def _described(image: np.ndarray) -> str:
    return f"{image.dtype} {' × '.join(map(str, image.shape))}"


def read_bytes(path: str | os.PathLike) -> bytes:
    """Read a file that a record or a config names.

    Args:
        path: of a regular file.

    Raises:
        MediaError: it is missing, empty, too large, cannot be read, or is not a regular file.
    """
    try:
        with _open_regular(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            content = b"" if size > LARGEST_PICTURE_FILE else stream.read(size)
    except OSError as error:
        raise MediaError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    if size > LARGEST_PICTURE_FILE:
        raise MediaError(f"{path}: larger than {LARGEST_PICTURE_FILE >> 20} MiB")
    if not content:
        raise MediaError(f"{path}: the file is empty")
    return content


def _open_regular(path: str | os.PathLike) -> BinaryIO:
    """Open a file that is neither a directory nor a pipe, device or socket: those may never end, or never begin.

    Raises:
        MediaError: it is one of them.
        OSError: it cannot be opened.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(handle).st_mode
    if not stat.S_ISREG(mode):
        os.close(handle)
        kinds = {stat.S_IFDIR: "a directory", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
        raise MediaError(f"{path}: {kinds.get(stat.S_IFMT(mode), 'a device')}, not a file")
    return os.fdopen(handle, "rb")


def refuse_full_disk(temporary: Path, path: Path) -> None:
    """Find out by a write of our own why a library could not write a file.

    Raises:
        OSError: the disk is full, or whatever else the system says; `filename` is `path`.
    """
    try:
        with open(temporary, "ab") as stream:
            stream.write(bytes(1 << 16))
            stream.flush()
            os.fsync(stream.fileno())
            stream.truncate(stream.tell() - (1 << 16))
    except OSError as error:
        error.filename = str(path)
        raise


# --- sound ------------------------------------------------------------------------------------------------------------


def refuse_sound_format(name: str, suffix: str, channels: int, bit_depth: int) -> None:
    """Refuse what a format of sound files cannot hold.

    Args:
        name: begins the message.
        suffix: ".wav" or ".flac".
        channels: number of channels.
        bit_depth: bits of a sample.

    Raises:
        MediaError: the format does not have so many channels, or samples of so many bits.
    """
    flac = suffix.lower() == ".flac"
    if bit_depth not in ((16, 24) if flac else (16, 24, 32)):
        raise MediaError(f"{name}: {'FLAC takes 16 or 24' if flac else 'WAV takes 16, 24 or 32'} bits, not {bit_depth}")
    if flac and channels > FLAC_CHANNELS:
        raise MediaError(f"{name}: FLAC has at most {FLAC_CHANNELS} channels, not {channels}; use WAV")


def is_recording(path: str | os.PathLike) -> bool:
    """Whether a WAV file has another header than AudioWriter's, and so was not simulated; of FLAC nobody can tell."""
    with open(path, "rb") as file:
        head = file.read(76)
    ours = head[8:22] == b"WAVEfmt \x28\0\0\0\xfe\xff" and head[40:44] == bytes(4)
    return head[:4] != b"fLaC" and not (ours and head[60:68] == b"fact\4\0\0\0" and head[72:] == b"data")


class AudioWriter:
    """A WAV or FLAC file (by extension) that is written piece by piece and appears when it is complete.

    WAV is written here rather than by libsndfile, which puts the time of day into every float file. 32 bits are IEEE
    floats; 16 and 24 bits are integers, rounded half to even and clipped (`clipped` counts the samples). FLAC takes 16
    or 24 bits.

    Args:
        path: where the file goes.
        sample_rate_hz: Hz.
        channels: number of channels.
        bit_depth: 16, 24 or 32.
    """

    def __init__(self, path: str | os.PathLike, sample_rate_hz: int, channels: int, bit_depth: int = 32):
        self.path, self.sample_rate_hz, self.channels, self.bit_depth = Path(path), sample_rate_hz, channels, bit_depth
        self.flac = self.path.suffix.lower() == ".flac"
        refuse_sound_format(str(path), self.path.suffix, channels, bit_depth)
        self.num_samples = self.clipped = 0
        self._file: Any = None

    def __enter__(self) -> "AudioWriter":
        with contextlib.ExitStack() as stack:
            temporary = stack.enter_context(atomic.replacing(self.path))
            if self.flac:
                import soundfile

                kind = f"PCM_{self.bit_depth}"
                stack.push(functools.partial(self._refuse_broken, temporary))
                file = soundfile.SoundFile(temporary, "w", self.sample_rate_hz, self.channels, kind, format="FLAC")
                self._file = stack.enter_context(file)
            else:
                self._file = stack.enter_context(open(temporary, "wb"))
                self._file.write(self._wav_header())
                stack.push(self._complete)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def _complete(self, kind: type[BaseException] | None, *_error: object) -> None:
        """State the length in the header, now that it is known."""
        if kind is None:
            self._file.write(b"\0" * (self.num_samples * self.channels * self.bit_depth // 8 % 2))
            self._file.seek(0)
            self._file.write(self._wav_header())

    def _refuse_broken(
        self, temporary: Path, kind: type[BaseException] | None, error: BaseException | None, _trace: object
    ) -> None:
        """Turn what libsndfile says of a full disk into the system's words, and check that the file's end is there."""
        import soundfile

        if kind is not None and not isinstance(error, soundfile.LibsndfileError):
            return
        found = 0
        with contextlib.suppress(soundfile.LibsndfileError), soundfile.SoundFile(temporary) as file:
            file.seek(max(self.num_samples - 1, 0))
            found = file.frames if len(file.read(1)) else 0
        if kind is None and found == self.num_samples:
            return
        refuse_full_disk(temporary, self.path)
        reason = error.error_string if isinstance(error, soundfile.LibsndfileError) else "its end is missing"
        raise OSError(errno.EIO, f"the sound could not be written: {reason}", str(self.path)) from error

    def write(self, samples: np.ndarray) -> None:
        """Append samples, (n, channels) floats with full scale at 1."""
        samples = np.asarray(samples, dtype=np.float64)
        if self.bit_depth < 32:
            scale = 1 << (self.bit_depth - 1)
            scaled = np.rint(samples * scale)
            limited = np.clip(scaled, -scale, scale - 1)
            self.clipped += int((scaled != limited).sum())
            integers = limited.astype("<i4")
        if self.flac:
            self._file.write(integers << (32 - self.bit_depth))
        elif self.bit_depth == 32:
            self._file.write(samples.astype("<f4").tobytes())
        else:
            width = self.bit_depth // 8
            octets = np.ascontiguousarray(integers).view(np.uint8).reshape(-1, 4)[:, :width]
            self._file.write(octets.tobytes())
        self.num_samples += len(samples)
        if not self.flac and self.num_samples * self.channels * self.bit_depth // 8 > 0xFFFF0000:
            raise MediaError(f"{self.path}: longer than the 4 GiB that WAV can hold; write it in chunks")

    def _wav_header(self) -> bytes:
        """A WAVE_FORMAT_EXTENSIBLE header (Microsoft, Multiple channel audio data and WAVE files, 2001)."""
        width = self.bit_depth // 8
        data = self.num_samples * self.channels * width
        tag = 3 if self.bit_depth == 32 else 1
        subformat = struct.pack("<H", tag) + bytes.fromhex("000000001000800000aa00389b71")
        layout = struct.pack(
            "<HHIIHHHHI",
            0xFFFE,
            self.channels,
            self.sample_rate_hz,
            self.sample_rate_hz * self.channels * width,
            self.channels * width,
            self.bit_depth,
            22,
            self.bit_depth,
            0,
        )
        chunks = b"fmt " + struct.pack("<I", 40) + layout + subformat
        chunks += b"fact" + struct.pack("<II", 4, self.num_samples)
        return (
            b"RIFF"
            + struct.pack("<I", 4 + len(chunks) + 8 + data + data % 2)
            + b"WAVE"
            + chunks
            + (b"data" + struct.pack("<I", data))
        )


def read_audio(path: str | os.PathLike) -> tuple[np.ndarray, int]:
    """Read a whole sound file (anything that libsndfile reads).

    Returns:
        (n, channels) float64 with full scale at 1, and the sample rate in Hz.

    Raises:
        MediaError: the file is missing, empty, cut short or not sound.
    """
    blocks, rate = [], 0
    for block, rate in audio_blocks(path):  # noqa: B007 - the rate is the same in each
        blocks.append(block)
    return np.concatenate(blocks), rate


@contextlib.contextmanager
def _sound_file(path: str | os.PathLike) -> Iterator[tuple["soundfile.SoundFile", int]]:
    """Open a sound file, and tell its size in bytes.

    Raises:
        MediaError: the file is missing, empty or not sound, or what is done with it fails.
    """
    import soundfile

    try:
        with _open_regular(path) as stream:
            size = os.fstat(stream.fileno()).st_size
        if size == 0:
            raise MediaError(f"{path}: the file is empty")
        with soundfile.SoundFile(os.fsencode(path)) as file:  # a name need not be UTF-8
            if file.channels > MOST_CHANNELS:
                raise MediaError(f"{path}: sound has at most {MOST_CHANNELS} channels, and this has {file.channels}")
            yield file, size
    except OSError as error:
        raise MediaError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    except soundfile.LibsndfileError as error:
        raise MediaError(f"{path}: not a sound file that can be read: {error.error_string}") from None


def audio_blocks(path: str | os.PathLike, block_size: int = 1 << 16) -> Iterator[tuple[np.ndarray, int]]:
    """Yield a sound file's samples, (≤ block_size, channels) float64, each with the sample rate in Hz.

    Raises:
        MediaError: the file is missing, empty, cut short or not sound.
    """
    with _sound_file(path) as (file, size):
        found, block_size = 0, max(min(block_size, (1 << 24) // file.channels), 1)
        while len(block := file.read(block_size, dtype="float64", always_2d=True)):
            found += len(block)
            yield block, file.samplerate
        _refuse_short(path, size, found, file.frames)


def _refuse_short(path: str | os.PathLike, size: int, found: int, expected: int) -> None:
    """Refuse a sound file of so many bytes with fewer samples than its header states, or with none."""
    stated = _stated_bytes(path)
    if found < expected or (stated is not None and stated > size):
        raise MediaError(f"{path}: cut short: it has {found} samples, and its header states more")
    if found == 0:
        raise MediaError(f"{path}: there are no samples in it")


@dataclass(frozen=True)
class AudioForm:
    """How a sound file is made.

    Attributes:
        samples: of each channel.
        channels: number of channels.
        rate_hz: sample rate, Hz.
    """

    samples: int
    channels: int
    rate_hz: int


def audio_form(path: str | os.PathLike, *, growing: bool = False) -> AudioForm:
    """Tell how a sound file is made, without reading its samples.

    Args:
        path: of the file.
        growing: whether somebody still writes it, so that it may be shorter than its header states.

    Raises:
        MediaError: the file is missing, empty, cut short or not sound.
    """
    with _sound_file(path) as (file, size):
        if not growing:
            _refuse_short(path, size, file.frames, file.frames)
        return AudioForm(file.frames, file.channels, file.samplerate)


def audio_part(path: str | os.PathLike, first: int, count: int) -> np.ndarray:
    """Read a part of a sound file, (≤ count, channels) float32 with full scale at 1, from sample `first` on.

    Raises:
        MediaError: it cannot be read.
    """
    with _sound_file(path) as (file, _):
        file.seek(min(first, file.frames))
        return file.read(count, dtype="float32", always_2d=True)


def _stated_bytes(path: str | os.PathLike) -> int | None:
    """Return the end that the header of a sound file states; libsndfile does not report a file that is cut short.

    None where it states none: a stream's writer, which cannot go back, states 0 or the largest length.
    """
    with open(path, "rb") as file:
        head = file.read(28).ljust(28, b"\0")
        kind = head[:4]
        if kind == b"RIFF":
            return _data_end(file, 12, "<4sI", even=True)
        if kind == b"caff":
            return _data_end(file, 8, ">4sQ", even=False)
        end = {
            b"RIFX": int.from_bytes(head[4:8], "big") + 8,
            b"FORM": int.from_bytes(head[4:8], "big") + 8,
            b"RF64": int.from_bytes(head[20:28], "little") + 8,  # EBU Tech 3306: of its ds64
            b"riff": int.from_bytes(head[16:24], "little"),  # W64
            b".snd": int.from_bytes(head[4:8], "big") + int.from_bytes(head[8:12], "big"),
        }.get(kind, 0)
    return end if 8 < end < (1 << 62) and (kind != b".snd" or head[8:12] != b"\xff" * 4) else None


def _data_end(file: BinaryIO, begin: int, header: str, *, even: bool) -> int | None:
    """Return where the chunk "data" of a sound file ends, as its header states; chunks begin at `begin`."""
    size = struct.calcsize(header)
    largest = (1 << 8 * (size - 4)) - 1
    file.seek(begin)
    while len(chunk := file.read(size)) == size:
        kind, length = struct.unpack(header, chunk)
        if kind == b"data":
            unknown = length in (0, largest >> 1, largest) or length > largest - 0xFFF
            return None if unknown else file.tell() + length
        if length >= 1 << 62:
            return None
        file.seek(length + (length % 2 if even else 0), os.SEEK_CUR)
    return None


def wav_stream_blocks(stream: BinaryIO, name: str, block_size: int = 1 << 10) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the samples of a WAV that arrives on a pipe, (≤ block_size, channels) float64, each with the rate in Hz.

    A length that a live recorder could not know (0 or the largest) means "until the stream ends".

    Raises:
        MediaError: it is not a WAV of integers of 8 to 32 bits or floats, or it ends before its header says.
    """
    head = _exactly(stream, 12, name)
    if head[:4] not in (b"RIFF", b"RF64") or head[8:] != b"WAVE":
        raise MediaError(f"{name}: not a WAV file")
    layout = None
    while True:
        kind, length = struct.unpack("<4sI", _exactly(stream, 8, name))
        if kind == b"data":
            break
        length += length % 2
        if kind == b"fmt " and length <= 1 << 16:
            layout = _wav_layout(_exactly(stream, length, name), name)
        else:
            while length:
                length -= len(_exactly(stream, min(length, 1 << 20), name))
    if layout is None:
        raise MediaError(f"{name}: the WAV has no format")
    decode, width, channels, rate = layout
    frame = width * channels
    left = None if length == 0 or length >= 0x7FFFFFFF - 0x1000 else length - length % frame
    while left is None or left > 0:
        wanted = block_size * frame if left is None else min(block_size * frame, left)
        content = as_much_as(stream, wanted)
        if len(content) < wanted and left is not None:
            missing = (left - len(content)) // frame
            raise MediaError(f"{name}: cut short: {missing} samples fewer than its header states")
        whole = len(content) - len(content) % frame
        if whole:
            yield decode(content[:whole]).reshape(-1, channels), rate
        if len(content) < wanted:
            return
        if left is not None:
            left -= wanted


def _wav_layout(content: bytes, name: str) -> tuple[Callable[[bytes], np.ndarray], int, int, int]:
    """Read a WAV's format chunk: how to decode its samples, their bytes, the channels, the rate in Hz."""
    if len(content) < 16:
        raise MediaError(f"{name}: the WAV's format is cut short")
    tag, channels, rate, _, _, bits = struct.unpack("<HHIIHH", content[:16])
    if tag == 0xFFFE and len(content) >= 26:
        tag = struct.unpack("<H", content[24:26])[0]
    known = (tag, bits) in {(1, 8), (1, 16), (1, 24), (1, 32), (3, 32), (3, 64)}
    if not known or not 0 < channels <= MOST_CHANNELS or rate == 0:
        raise MediaError(f"{name}: a WAV of format {tag} with {bits} bits and {channels} channels cannot be read")
    decode, width = decoder(tag, bits)
    return decode, width, channels, rate


def decoder(tag: int, bits: int) -> tuple[Callable[[bytes], np.ndarray], int]:
    """Return how to decode samples of a WAV's format (1: integers, 3: floats) and bits, and their bytes."""

    def floats(content: bytes) -> np.ndarray:
        with np.errstate(invalid="ignore"):  # samples that are not numbers, as in what is no sound of floats
            return np.frombuffer(content, f"<f{bits // 8}").astype(np.float64)

    def integers(content: bytes) -> np.ndarray:
        octets: np.ndarray = np.frombuffer(content, np.uint8).reshape(-1, bits // 8)
        if bits == 8:  # eight bits alone are unsigned
            octets = octets ^ 0x80
        wide = np.zeros((len(octets), 4), np.uint8)
        wide[:, 4 - bits // 8 :] = octets
        return wide.view("<i4")[:, 0] / 2.0**31

    return (floats if tag == 3 else integers), bits // 8


def as_much_as(stream: BinaryIO, size: int) -> bytes:
    """Read until `size` bytes are there or the stream ends."""
    parts = []
    while size > 0 and (part := stream.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _exactly(stream: BinaryIO, size: int, name: str) -> bytes:
    content = as_much_as(stream, size)
    if len(content) < size:
        raise MediaError(f"{name}: the WAV ends within its header")
    return content
