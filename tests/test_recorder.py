"""Sound as a recorder sends it: raw samples, chosen channels, samples that are missing."""

import io
import json

import numpy as np
import pytest
from conftest import run
from localization_rooms import MICROPHONES, heard, voice

from avcli.formats import recorder
from avcli.formats.media import MediaError
from avcli.formats.recorder import Arrivals, Raw


def encoded(samples, kind):
    if kind == "f32le":
        return samples.astype("<f4").tobytes()
    bits = int(kind[1:3])
    integers = np.rint(samples * 2.0 ** (bits - 1)).astype("<i8")
    return np.ascontiguousarray(integers).view(np.uint8).reshape(-1, 8)[:, : bits // 8].tobytes()


@pytest.mark.parametrize("kind", recorder.KINDS)
def test_raw_samples_of_every_kind_are_read(kind):
    samples = np.random.default_rng(0).integers(-100, 100, (2500, 3)) / 128.0
    raw = Raw.parse(f"{kind},48000,3")
    pieces = list(recorder.raw_blocks(io.BytesIO(encoded(samples, kind)), raw, "x"))
    assert {rate for _, rate in pieces} == {48000}
    assert np.array_equal(np.concatenate([piece for piece, _ in pieces]), samples)


@pytest.mark.parametrize("text", ["s16le", "s16be,48000,8", "s16le,0,8", "s16le,48000,0", "s16le,48000,9999", ""])
def test_a_wrong_layout_is_refused(text):
    with pytest.raises(ValueError, match="expected KIND,HZ,CHANNELS"):
        Raw.parse(text)


def test_raw_sound_that_is_cut_or_empty_is_refused():
    raw = Raw.parse("s16le,48000,8")
    with pytest.raises(MediaError, match="ends within a sample"):
        list(recorder.raw_blocks(io.BytesIO(bytes(17)), raw, "x"))
    with pytest.raises(MediaError, match="no sound in it"):
        list(recorder.raw_blocks(io.BytesIO(b""), raw, "x"))


def test_channels_are_chosen_in_order_and_levelled():
    assert recorder.channels_of("3-5,1") == (2, 3, 4, 0)
    samples = np.arange(12.0).reshape(2, 6)
    ((found, rate),) = recorder.chosen([(samples, 8000)], "x", (2, 0), (20.0, 0.0))
    assert found.tolist() == [[20.0, 0.0], [80.0, 6.0]]
    assert rate == 8000
    for bad in ("0", "3-1", "a", "1,1", "2-4,3", ""):
        with pytest.raises(ValueError, match="channel"):
            recorder.channels_of(bad)
    with pytest.raises(MediaError, match="channel 7 is asked for, but the sound has 6"):
        list(recorder.chosen([(samples, 8000)], "x", (6,), None))
    with pytest.raises(MediaError, match="2 gains for 6 channels"):
        list(recorder.chosen([(samples, 8000)], "x", None, (0.0, 0.0)))


def missing(times, piece=0.02):
    """What is missing before each piece of so many s that arrives at these times."""
    times = iter(times)
    arrivals = Arrivals(clock=lambda: next(times))
    return [arrivals.missing(piece) for _ in range(500)]


def test_lost_samples_are_noticed_and_late_ones_are_not():
    steady = 0.02 * np.arange(500)
    assert not any(missing(steady))
    assert not any(missing(steady * 1.0005))  # another clock
    held_up = np.where((steady > 3.0) & (steady < 3.6), 3.6, steady)  # comes at once afterwards
    assert not any(missing(held_up))
    assert not any(missing(np.minimum(steady, 1e-4)))  # a file, not in real time
    lost = [one for one in missing(steady + 0.7 * (steady > 4.0)) if one]
    assert lost == [pytest.approx(0.7, abs=0.03)]


def test_raw_sound_gives_what_a_file_gives(tmp_path):
    rng = np.random.default_rng(1)
    samples = heard(np.array([1.5, 2.0, 1.5]), voice(1.0, 16000, rng), 16000)
    config = {
        "room_config": {"room_dimensions_m": [4.66, 4.66, 3.0]},
        "microphone_config": {"audio_sample_rate_hz": 16000, "mic_positions_m": MICROPHONES.tolist()},
    }
    (tmp_path / "config.json").write_text(json.dumps(config))
    wide = np.concatenate([np.zeros((len(samples), 2)), samples[:, ::-1]], axis=1)
    order = ",".join(str(channel) for channel in range(10, 2, -1))
    (tmp_path / "plain.raw").write_bytes(encoded(samples, "f32le"))
    plain = run("avdetect-audio", "-C", tmp_path, "--raw", "f32le,16000,8", tmp_path / "plain.raw")
    picked = run(
        "avdetect-audio", "-C", tmp_path, "--raw", "f32le,16000,10", "--channels", order, stdin=encoded(wide, "f32le")
    )
    assert plain.returncode == picked.returncode == 0
    assert plain.stdout == picked.stdout
    found = [json.loads(line)["objects"] for line in plain.stdout.splitlines()]
    assert sum(len(objects) == 1 for objects in found) >= 5
    config["microphone_config"]["audio_sample_rate_hz"] = 44100
    (tmp_path / "config.json").write_text(json.dumps(config))
    other = run("avdetect-audio", "-C", tmp_path, "--raw", "f32le,16000,8", tmp_path / "plain.raw")
    assert other.stdout == plain.stdout
    assert "16000 Hz, which counts" in other.stderr
