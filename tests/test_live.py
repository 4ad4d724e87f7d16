"""Live sources: what is taken when the reader is behind, what is said about it, and how it ends."""

import contextlib
import io
import json
import os
import signal
import subprocess
import threading
from dataclasses import dataclass

import numpy as np
import pytest
import soundfile
from conftest import BIN, done, refused, run
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.commands import avcalib
from avcli.commands.live import newest
from avcli.formats import experiment, footage, media
from avcli.formats.camera import Camera
from avcli.formats.live import LiveSource, Pace, Stoppable
from avcli.localization import localizer
from avcli.localization.stream import Block

FS = 16000
HANG_S = 300


# --- what arrives -----------------------------------------------------------------------------------------------------


def test_all_that_arrives_comes_in_order():
    with LiveSource(range(1000)) as arrivals:
        assert list(arrivals) == list(range(1000))
    assert arrivals.skipped == 0


def test_what_waits_can_be_measured():
    with LiveSource([3, 4, 5]) as arrivals:
        arrivals.thread.join(HANG_S)
        assert arrivals.waiting(float) == 12.0
        assert next(iter(arrivals)) == 3
        assert arrivals.waiting(float) == 9.0


def test_an_error_of_the_source_comes_after_its_items():
    def items():
        yield 1
        raise ValueError("broken")

    with LiveSource(items(), newest=True) as arrivals:
        taken = iter(arrivals)
        assert next(taken) == 1
        with pytest.raises(ValueError, match="broken"):
            next(taken)


def test_a_pipe_that_says_nothing_can_be_left():
    out, into = os.pipe()
    with open(out, "rb") as stream, open(into, "wb", buffering=0) as writer:
        pipe = Stoppable(stream)
        with LiveSource(io.BufferedReader(pipe), stop=pipe.stop) as arrivals:
            writer.write(b"one\ntwo\nth")
            taken = iter(arrivals)
            assert [next(taken), next(taken)] == [b"one\n", b"two\n"]
        assert not arrivals.thread.is_alive()


@dataclass
class Said:
    """A session that keeps what it is to print."""

    texts: list

    def warn(self, text, kind=None):
        self.texts.append(text)


@dataclass
class Item:
    timestamp: float


def test_the_newest_is_taken_and_skipping_is_said_once_and_counted():
    taken, full = [threading.Semaphore(0), threading.Semaphore(0)], threading.Semaphore(0)

    def items():
        yield Item(0)
        assert taken[0].acquire(timeout=HANG_S)
        yield Item(1)
        assert taken[1].acquire(timeout=HANG_S)
        for burst in (range(2, 6), range(6, 8)):
            for time in burst:
                yield Item(time)
            full.release()
            assert taken[1].acquire(timeout=HANG_S)

    session, got = Said([]), []
    with contextlib.ExitStack() as stack:
        shots = newest(session, stack, items())
        for release in (taken[0], taken[1]):
            got.append(next(shots).timestamp)
            release.release()
        for _ in range(2):
            assert full.acquire(timeout=HANG_S)
            got.append(next(shots).timestamp)
            taken[1].release()
        assert list(shots) == []
    assert got == [0, 1, 5, 7]
    assert len(session.texts) == 2
    assert "t = 5.0 s" in session.texts[0]
    assert session.texts[1] == "skipped 4 of 8 pictures"


# --- sound ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound():
    rng = np.random.default_rng(3)
    return noisy(heard(np.array([3.1, 1.3, 1.6]), voice(3.0, FS, rng), FS), 30, rng)


@pytest.fixture(scope="module")
def config():
    microphones = {"audio_sample_rate_hz": FS, "mic_positions_m": MICROPHONES.tolist()}
    return experiment.Config({"microphone_config": microphones, "room_config": {"room_dimensions_m": ROOM.tolist()}})


def decided(config, sound, waiting):
    pieces = [sound[begin : begin + 400] for begin in range(0, len(sound), 400)]
    return list(localizer(config).localize(Block(piece, waiting=waiting(k / 40)) for k, piece in enumerate(pieces)))


def test_time_steps_are_skipped_while_sound_waits(config, sound):
    every = decided(config, sound, lambda time: 0.0)
    assert {decision.skipped for decision in every} == {0}
    assert decided(config, sound, lambda time: 0.09)[5].time == every[5].time  # less than a step is not behind
    some = decided(config, sound, lambda time: 0.5 if 1.0 <= time < 2.0 else 0.0)
    times = [decision.time for decision in some]
    assert [decision.skipped for decision in some if decision.skipped] == [10]
    assert set(times) == {decision.time for decision in every if not 0.8 <= decision.time < 1.75}
    for one in some:
        same = every[round(one.time * 10)]
        assert len(one.positions) == len(same.positions)
        if len(one.positions):
            assert np.linalg.norm(one.positions[0] - same.positions[0]) < 0.1


def test_a_stream_that_is_always_behind_is_decided_about_at_its_end(config, sound):
    some = decided(config, sound, lambda time: 0.5)
    assert some
    assert sum(1 + decision.skipped for decision in some) == len(decided(config, sound, lambda time: 0.0))
    assert some[-1].time == pytest.approx(len(sound) // 1600 / 10)


# --- the commands -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory, config, sound):
    """An experiment with one small picture of an empty room, and a recording."""
    folder = tmp_path_factory.mktemp("live")
    camera = {
        "lens_model": "kannala_brandt",
        "fx_px": 60, "fy_px": 60, "cx_px": 79.5, "cy_px": 59.5, "image_width_px": 160, "image_height_px": 120,
        "camera_position_m": [2, 2, 2.5], "camera_rotation_deg": [90, 0, 0], "depth_step_m": 0.001,
        "background_depth": "empty.png",
    }  # fmt: skip
    experiment.write_config(folder / "config.json", {**config.raw, "camera_config": camera})
    media.write_png(folder / "empty.png", np.full((120, 160), 2500, np.uint16))
    soundfile.write(folder / "a.wav", sound, FS, subtype="FLOAT")
    return folder


def frame(index, depth="empty.png"):
    return json.dumps({"timestamp": index / 10, "frame": {"rgb": "-", "depth": depth}}).encode() + b"\n"


VIDEO = "avdetect-video", "--detector", "depth", "--live"


def test_pictures_that_come_too_fast_are_skipped_but_not_the_last(folder):
    result = done(*VIDEO, "-C", folder, stdin=b"".join(frame(index) for index in range(100)))
    times = [float(json.loads(line)["timestamp"]) for line in result.stdout.splitlines()]
    assert times == sorted(times)
    assert times[-1] == 9.9
    if len(times) < 100:
        assert f"skipped {100 - len(times)} of 100 pictures" in result.stderr


def test_sound_that_comes_too_fast_is_skipped_but_not_its_end(folder):
    content = (folder / "a.wav").read_bytes()
    every = run("avdetect-audio", "-C", folder, stdin=content).stdout.splitlines()
    result = done("avdetect-audio", "--live", "-C", folder, stdin=content)
    some = result.stdout.splitlines()
    assert json.loads(some[-1])["timestamp"] == json.loads(every[-1])["timestamp"]
    if len(some) < len(every):
        assert f"skipped {len(every) - len(some)} of {len(every)} time steps" in result.stderr


@contextlib.contextmanager
def started(*command):
    """A running command, whose standard input stays open."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "bufsize": 0}
    with subprocess.Popen([BIN / command[0], *command[1:]], **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_live_pipe_is_answered_picture_by_picture(folder):
    with started(*VIDEO, "-C", folder) as process:
        for index in range(5):
            process.stdin.write(frame(index))
            assert json.loads(process.stdout.readline())["timestamp"].startswith(f"{index / 10:.1f}")
        process.stdin.close()
        assert process.wait(HANG_S) == 0
        assert process.stderr.read() == b""


def test_an_error_ends_a_live_command_although_its_source_says_nothing_more(folder):
    with started(*VIDEO, "-C", folder) as process:
        process.stdin.write(frame(0, "nowhere.png"))
        assert process.wait(HANG_S) == 1
        assert process.stderr.read().count(b"\n") == 1
    with started("avdetect-audio", "--live", "-C", folder) as process:
        process.stdin.write(b"no record\n")
        assert process.wait(HANG_S) == 1
        assert process.stderr.read().count(b"\n") == 1


@pytest.mark.parametrize("command", [VIDEO, ("avdetect-audio", "--live")])
def test_a_signal_ends_a_live_command_that_waits(folder, command):
    with started(*command, "-C", folder) as process:
        process.stdin.write(frame(0) if command is VIDEO else (folder / "a.wav").read_bytes()[:60000])
        if command is VIDEO:
            process.stdout.readline()
        else:
            wait_until_empty(process.stdin)
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG_S) == -signal.SIGTERM


def test_what_was_learnt_live_is_kept_when_a_signal_ends_the_run(tmp_path):
    learnt = tmp_path / "room.json"
    with started("avfuse", "--live", "--rate", "10", "--learn", learnt) as process:
        for k in range(30):
            at = {"timestamp": k / 10, "sensor": "eye", "kind": "camera", "objects": [{"position": [2 + k / 50, 2]}]}
            process.stdin.write(json.dumps(at).encode() + b"\n")
        while b'"2.8' not in process.stdout.readline():
            pass
        assert not learnt.exists()
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG_S) == -signal.SIGTERM
    assert json.loads(learnt.read_bytes())["sensors"].keys() == {"eye"}


def wait_until_empty(pipe):
    """Wait until all that was written into a pipe has been read."""
    import fcntl
    import termios
    import time

    end = time.monotonic() + HANG_S
    while fcntl.ioctl(pipe, termios.FIONREAD, b"\0" * 4) != b"\0" * 4:
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("avdetect-video", "--live", "frames.jsonl"), "frames.jsonl is a file"),
        (("avdetect-video", "--live", "empty.png"), "--live has no effect on files"),
        (("avdetect-video", "--live", "-", "more"), "more: no such file"),
        (("avdetect-audio", "--live", "a.wav"), "a.wav is a file"),
        (("avdetect-audio", "--live", "-", "a.wav"), "--live reads one source"),
        (("avdetect-audio", "--live", "--method", "3d-ssl"), "--live has no effect with --method 3d-ssl"),
    ],
)
def test_live_is_for_what_is_live(folder, command, words):
    (folder / "frames.jsonl").write_bytes(frame(0))
    refused(run(*command, "-C", folder, cwd=folder), words, status=2)


CAMERA = """
import numpy as np
from avcli.formats import footage

def pictures(camera):
    for number in range(50):
        yield footage.Picture(camera.name, number / 10, np.full((120, 160, 3), 90, np.uint8))

footage.camera_pictures = pictures
footage.sources = lambda names: [footage.source(name) for name in names]
from avcli.commands.avdetect_video import main
main()
"""


def test_a_camera_is_live(folder):
    result = done(BIN / "python", "-c", CAMERA, "-C", folder, "/dev/video99")
    times = [float(json.loads(line)["timestamp"]) for line in result.stdout.splitlines()]
    assert times[-1] == 4.9
    assert f"skipped {50 - len(times)} of 50 pictures" in result.stderr or len(times) == 50


# --- a picture that hangs ---------------------------------------------------------------------------------------------

HANGING = r"""
import sys, time
from avcli.formats import media

def hang(path):
    print("reading\n", end="", flush=True)  # in one write: another thread reads ahead
    time.sleep(3600)

media.read_depth = hang
from avcli.commands.avdetect_video import main
main()
"""


@pytest.mark.parametrize("source", ["files", "pipe", "live"])
def test_a_signal_ends_the_reading_of_a_picture_that_hangs(folder, source):
    (folder / "frames.jsonl").write_bytes(b"".join(map(frame, range(10))))
    options = {"files": [folder / "frames.jsonl"], "pipe": [], "live": ["--live"]}[source]
    with started("python", "-c", HANGING, "--detector", "depth", "-C", folder, *options) as process:
        if source != "files":
            process.stdin.write(frame(0))
        assert process.stdout.readline() == b"reading\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG_S) == -signal.SIGTERM


# --- the pace -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("camera_hz", "wanted_hz"), [(15, 5), (30, 10), (30, 12), (10, 10), (29.97, 30), (10, 25)])
def test_so_many_a_second_are_taken_as_are_wanted(camera_hz, wanted_hz):
    rng = np.random.default_rng(0)
    times = (np.arange(int(60 * camera_hz)) + rng.uniform(0, 0.2, int(60 * camera_hz))) / camera_hz
    clock = iter(times)
    pace = Pace(wanted_hz, lambda: next(clock))
    taken = sum(pace.takes() for _ in times)
    assert taken / 60 == pytest.approx(min(camera_hz, wanted_hz), rel=0.03)
    assert all(Pace(None).takes() for _ in range(10))


def test_pictures_go_on_after_a_stall_and_after_a_clock_is_set_back(monkeypatch):
    clock = iter([0.0, 0.1, 60.0, 60.01, 60.1])
    pace = Pace(10.0, lambda: next(clock))
    assert [pace.takes() for _ in range(5)] == [True, True, True, False, True]
    walls = iter([1e9, 1e9 - 3600, 1e9 - 3599])
    camera = Camera("/dev/video7", 10.0, open=lambda _: Still(3), clock=lambda: next(walls))
    steady = iter([0.0, 1.0, 2.0])
    monkeypatch.setattr("avcli.formats.camera.Pace", lambda rate: Pace(rate, lambda: next(steady)))
    assert [now for now, _ in camera.pictures()] == [1e9, 1e9 - 3600, 1e9 - 3599]


class Still:
    """A camera, as OpenCV has it, that gives some black pictures."""

    def __init__(self, count):
        self.left = count

    def isOpened(self):
        return True

    def grab(self):
        self.left -= 1
        return self.left >= 0

    def retrieve(self):
        return True, np.zeros((4, 6, 3), np.uint8)

    def get(self, _key):
        return 0.0

    def set(self, _key, _value):
        return False

    def release(self):
        pass


def test_a_stream_at_an_address_is_filmed_live(monkeypatch):
    shown = [footage.Picture(str(number), float(number), np.zeros((4, 6), np.uint8)) for number in range(50)]
    monkeypatch.setattr(footage, "pictures", lambda *_: iter(shown))
    with contextlib.ExitStack() as stack:
        source = footage.source("rtsp://camera/path")
        arriving, _ = avcalib._pictures(None, stack, source, {"rate_hz": 0.1})
        assert len(list(arriving)) == 1
