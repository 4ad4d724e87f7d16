"""An MP4 file with sound, where no other program is there to join the two: ISO/IEC 14496-12 (2015), 14496-14."""

import struct

_BITRATES = {  # kbit/s of Layer III by the index in the header: MPEG-1, and MPEG-2 with its half sample rates
    3: (0, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320),
    2: (0, 8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160),
}
_RATES_HZ = {3: (44100, 48000, 32000), 2: (22050, 24000, 16000), 0: (11025, 12000, 8000)}


def with_sound(video: bytes, mp3: bytes) -> bytes:
    """Add a track of MP3 to an MP4 file without sound; both begin together.

    Args:
        video: the file; its "moov" box is the last one, as FFmpeg writes it.
        mp3: the stream.

    Raises:
        ValueError: the file or the stream is built in another way.
    """
    begin, end = _last_box(video)
    if video[begin + 4 : begin + 8] != b"moov" or end != len(video):
        raise ValueError("the film does not end with its table of contents")
    frames, rate_hz, samples = _frames(mp3)
    content = video[begin + 8 : end]
    at = content.index(b"mvhd") + 4
    if content[at] != 0:
        raise ValueError("the film is too long")
    timescale = struct.unpack_from(">I", content, at + 12)[0]
    track = _track(frames, rate_hz, samples, timescale, begin + 8)
    content = content[: at + 96] + struct.pack(">I", 3) + content[at + 100 :]  # the number of the next track
    return video[:begin] + _box(b"mdat", b"".join(frames)) + _box(b"moov", content, track)


def _last_box(content: bytes) -> tuple[int, int]:
    place = last = 0
    while place + 8 <= len(content):
        size = struct.unpack_from(">I", content, place)[0]
        size = struct.unpack_from(">Q", content, place + 8)[0] if size == 1 else size
        if size < 8:
            raise ValueError("the film has an invalid box")
        last, place = place, place + size
    return last, place


def _frames(mp3: bytes) -> tuple[list[bytes], int, int]:
    """The frames of a stream of MP3 (without one that only describes the others), their rate, and samples of each."""
    frames, place, rate_hz, samples = [], 0, 0, 1152
    while place + 4 <= len(mp3):
        header = struct.unpack_from(">I", mp3, place)[0]
        version, index, rate_index = header >> 19 & 3, header >> 12 & 15, header >> 10 & 3
        if header >> 21 != 0x7FF or version == 1 or not 0 < index < 15 or rate_index == 3:
            raise ValueError("the sound is not plain MP3")
        rate_hz, samples = _RATES_HZ[version][rate_index], 1152 if version == 3 else 576
        kbit_s = _BITRATES[3 if version == 3 else 2][index]
        size = samples // 8 * 1000 * kbit_s // rate_hz + (header >> 9 & 1)
        frames.append(mp3[place : place + size])
        place += size
    describes = bool(frames) and (b"Xing" in frames[0][:64] or b"Info" in frames[0][:64])
    if len(frames) <= describes:
        raise ValueError("there is no sound")
    return frames[describes:], rate_hz, samples


def _track(frames: list[bytes], rate_hz: int, samples: int, timescale: int, offset: int) -> bytes:
    length = len(frames) * samples
    unity = struct.pack(">9i", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    duration = round(length * timescale / rate_hz)
    head = _full(b"tkhd", 7, struct.pack(">5I8x2hH2x", 0, 0, 2, 0, duration, 0, 1, 0x100), unity, bytes(8))
    kind = 0x6B if samples == 1152 else 0x69  # MPEG-1, MPEG-2 audio
    decoder = struct.pack(">BBBHBII", kind, 0x15, 0, 0, 0, 0, 0)[:13]
    stream = b"\0\0\0" + _descriptor(4, decoder) + _descriptor(6, b"\2")
    entry = struct.pack(">6xH8xHH4xI", 1, 1, 16, rate_hz << 16) + _full(b"esds", 0, _descriptor(3, stream))
    tables = (
        _full(b"stsd", 0, struct.pack(">I", 1), _box(b"mp4a", entry)),
        _full(b"stts", 0, struct.pack(">3I", 1, len(frames), samples)),
        _full(b"stsc", 0, struct.pack(">4I", 1, 1, len(frames), 1)),
        _full(b"stsz", 0, struct.pack(">2I", 0, len(frames)), b"".join(struct.pack(">I", len(f)) for f in frames)),
        _full(b"co64", 0, struct.pack(">IQ", 1, offset)),
    )
    here = _full(b"dref", 0, struct.pack(">I", 1), _full(b"url ", 1))
    information = _box(b"minf", _full(b"smhd", 0, bytes(4)), _box(b"dinf", here), _box(b"stbl", *tables))
    media_head = _full(b"mdhd", 0, struct.pack(">4IHH", 0, 0, rate_hz, length, 0x55C4, 0))
    handler = _full(b"hdlr", 0, bytes(4), b"soun", bytes(12), b"sound\0")
    return _box(b"trak", head, _box(b"mdia", media_head, handler, information))


def _box(name: bytes, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack(">I", 8 + len(content)) + name + content


def _full(name: bytes, flags: int, *parts: bytes) -> bytes:
    return _box(name, struct.pack(">I", flags), *parts)


def _descriptor(tag: int, content: bytes) -> bytes:
    return bytes((tag, len(content))) + content
