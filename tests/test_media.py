"""Pictures and sound: what is written is read again, by us and by others."""

import io
import struct

import cv2
import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.formats import atomic, media, png


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from(["rgb", "grey", "depth"]), st.integers(0, 2**32 - 1))
def test_png_is_exact_for_other_readers(height, width, kind, seed):
    rng = np.random.default_rng(seed)
    shape = (height, width, 3) if kind == "rgb" else (height, width)
    dtype = np.uint16 if kind == "depth" else np.uint8
    image = rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    content = png.encode_png(image)
    decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decoded if decoded.ndim == 2 else decoded[:, :, ::-1], image)
    own = png.decode_png(content)
    assert own.dtype == dtype
    np.testing.assert_array_equal(own, image)


def test_what_is_as_in_the_picture_before_is_not_deflated_again(monkeypatch):
    deflated = []
    deflate = png._deflated
    monkeypatch.setattr(png, "_deflated", lambda band: deflated.append(len(band)) or deflate(band))
    film = np.random.default_rng(0).integers(0, 255, (5, 200, 30, 3), np.uint8)
    film[1:] = film[0]
    film[1, 70, 3, 1] ^= 1  # the row after it is stored as the difference to it, and both are in the second band
    film[3, 127, 3, 1] ^= 1  # the last row of that band: the third band is other too
    encoder, counts = png.Encoder(), []
    for image in [*film, film[0][:190], film[0][:190, :, 0]]:
        deflated.clear()
        content = encoder.encode(image)
        counts.append(len(deflated))
        np.testing.assert_array_equal(png.decode_png(content), image)
        assert content == png.encode_png(image)
    assert counts == [4, 1, 1, 2, 2, 3, 3]


def test_the_bytes_of_a_png_are_the_same_wherever_its_compressor_lies():
    image = np.resize(np.array([7, 9, 2], np.uint8), (1, 600))  # begins again at once, with the row's filter: 2
    between = []  # moves the next compressor to other memory; of 10,000 places two or three had other bytes
    contents = set()
    for _ in range(10_000):
        contents.add(png.encode_png(image))
        between.append(np.empty(70_000, np.uint8))
    assert len(contents) == 1


def test_floats_that_are_no_numbers_make_no_noise():
    decode, width = media.decoder(3, 32)
    assert width == 4
    assert np.isnan(decode(bytes([1, 0, 0x80, 0x7F]))).all()  # a signalling NaN; warnings are errors here


@settings(deadline=None, max_examples=200)
@given(st.data())
def test_a_damaged_png_is_left_to_opencv(data):
    content = bytearray(png.encode_png(np.random.default_rng(0).integers(0, 255, (9, 7, 3), np.uint8)))
    if data.draw(st.booleans()):
        content[data.draw(st.integers(0, len(content) - 13))] ^= data.draw(st.integers(1, 255))
    else:
        del content[data.draw(st.integers(0, len(content) - 13)) :]
    assert png.decode_png(bytes(content)) is None


def test_pngs_of_other_writers_are_left_to_opencv():
    image = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    for kind in (cv2.IMWRITE_PNG_STRATEGY_DEFAULT, cv2.IMWRITE_PNG_STRATEGY_FIXED):
        content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_STRATEGY, kind])[1].tobytes()
        assert png.decode_png(content) is None
        np.testing.assert_array_equal(media.decode_picture(content), image[:, :, ::-1])


def test_other_pictures_are_converted(tmp_path):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    cv2.imwrite(str(tmp_path / "rgba.png"), np.dstack([grey, grey + 1, grey + 2, grey]))
    cv2.imwrite(str(tmp_path / "deep.png"), np.dstack([grey.astype(np.uint16) * 257] * 3))
    np.save(tmp_path / "raw.npy", grey)
    assert media.read_rgb(tmp_path / "grey.png")[1, 2].tolist() == [6, 6, 6]
    assert media.read_rgb(tmp_path / "rgba.png")[1, 2].tolist() == [8, 7, 6]
    assert media.read_rgb(tmp_path / "deep.png")[1, 2].tolist() == [6, 6, 6]
    assert media.read_depth(tmp_path / "raw.npy")[1, 2] == 6
    with pytest.raises(media.MediaError, match="one channel"):
        media.read_depth(tmp_path / "rgba.png")


@pytest.mark.parametrize("content", [None, b"", b"no picture", b"\x89PNG\r\n\x1a\n" + b"\0" * 40, b"\x93NUMPY\x01"])
def test_a_file_that_is_no_picture_is_named(tmp_path, content):
    path = tmp_path / "frame.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(media.MediaError, match=r"frame\.png: "):
        media.read_rgb(path)


@pytest.mark.parametrize(
    ("name", "bits", "step"),
    [("a.wav", 32, 2**-24), ("a.wav", 24, 2**-23), ("a.wav", 16, 2**-15), ("a.flac", 24, 2**-23)],
)
def test_sound_is_read_back_by_us_and_by_libsndfile(tmp_path, name, bits, step):
    samples = np.random.default_rng(0).uniform(-0.99, 0.99, (1001, 3))
    with media.AudioWriter(tmp_path / name, 48000, 3, bits) as writer:
        writer.write(samples[:10])
        writer.write(samples[10:])
    for read, rate in (media.read_audio(tmp_path / name), soundfile.read(tmp_path / name, always_2d=True)):
        assert rate == 48000
        np.testing.assert_allclose(read, samples, atol=step)


def test_integers_are_clipped_and_counted(tmp_path):
    with media.AudioWriter(tmp_path / "a.wav", 8000, 1, 16) as writer:
        writer.write(np.array([[2.0], [-2.0], [0.5]]))
    assert writer.clipped == 2
    assert media.read_audio(tmp_path / "a.wav")[0][:, 0].tolist() == [1 - 2**-15, -1.0, 0.5]


def test_a_wav_that_was_cut_short_is_refused(tmp_path):
    with media.AudioWriter(tmp_path / "a.wav", 8000, 2) as writer:
        writer.write(np.zeros((1000, 2)))
    (tmp_path / "b.wav").write_bytes((tmp_path / "a.wav").read_bytes()[:-100])
    with pytest.raises(media.MediaError, match=r"b\.wav: cut short"):
        media.read_audio(tmp_path / "b.wav")


@pytest.mark.parametrize("kind", ["WAV", "RIFX", "RF64", "W64", "AIFF", "AU", "CAF", "FLAC"])
def test_a_sound_file_of_any_kind_that_was_cut_short_is_refused(tmp_path, kind):
    """libsndfile reads what is left of most kinds as if it were all."""
    sound = np.random.default_rng(0).uniform(-0.5, 0.5, (3000, 3))
    form, endian = ("WAV", "BIG") if kind == "RIFX" else (kind, "FILE")
    soundfile.write(tmp_path / "a", sound, 16000, "PCM_16", endian=endian, format=form)
    assert media.read_audio(tmp_path / "a")[0].shape == sound.shape
    (tmp_path / "b").write_bytes((tmp_path / "a").read_bytes()[:-6])
    with pytest.raises(media.MediaError, match=r"b: (cut short|not a sound file)"):
        media.read_audio(tmp_path / "b")


def test_a_wav_from_a_stream_has_no_length_and_is_read(tmp_path):
    buffer = io.BytesIO()
    soundfile.write(buffer, np.zeros((100, 1)), 8000, "PCM_16", format="WAV")
    content = bytearray(buffer.getvalue())
    place = content.index(b"data") + 4
    content[place : place + 4] = struct.pack("<I", 0xFFFFFFFF)
    (tmp_path / "a.wav").write_bytes(content)
    assert len(media.read_audio(tmp_path / "a.wav")[0]) == 100


@pytest.mark.parametrize("content", [None, b"", b"no sound at all, only text"])
def test_a_file_that_is_no_sound_is_named(tmp_path, content):
    path = tmp_path / "a.wav"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(media.MediaError, match=r"a\.wav: "):
        media.read_audio(path)


def test_a_failed_write_leaves_nothing(tmp_path):
    atomic.write_bytes(tmp_path / "a", b"good")

    def fail():
        with atomic.replacing(tmp_path / "a") as temporary:
            temporary.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_bytes() == b"good"


def test_a_full_disk_is_named(tmp_path):
    with pytest.raises(OSError, match="No space left") as caught, atomic.replacing(tmp_path / "a"):
        raise OSError(28, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []
