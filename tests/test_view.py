"""avview: records sorted by kind, its page in a real browser, its files."""

import io
import json
import math
import re
import shutil
import signal
import subprocess
import urllib.error
import urllib.request

import numpy as np
import pytest
import soundfile
from browser import CHROMIUM, Browser
from conftest import BIN, done, refused, run
from test_aveval import lines, walk
from test_metrics_report import INKED, experiment

from avcli.formats import experiment as experiments
from avcli.formats import records
from avcli.view import sound
from avcli.view.experiment import Recorded
from avcli.view.recording import DETECTIONS, TRACKS, TRUTH, Recording


def record(t, objects, **more):
    return {"timestamp": t, "objects": objects, **more}


def test_records_are_sorted_by_their_keys():
    recording = Recording("x", {"ring": "microphones"})
    person = {"object_id": 0, "position": [1, 2, 0]}
    recording.add(record(0.0, []), "a")  # nothing says yet what this is
    recording.add(record(0.1, [{**person, "existence": 0.9}]), "a")
    recording.add(record(0.1, [{**person, "speaking": True}], frame={"rgb": "f.png"}), "scene")
    recording.add(record(0.1, [{"position": [1, 2, 1.5]}], sensor="ring"), "b")
    recording.add(record(0.2, [person]), "groundtruth")
    recording.add(record(0.2, [person]), "plain")
    recording.add(record(0.2, [{**person, "velocity": [1, 0, 0]}]), "scene")  # one pipe carries both
    kinds = [(stream.kind, stream.name, stream.sensor, len(stream.rows)) for stream in recording.streams]
    assert kinds == [
        (TRACKS, "a", None, 2),
        (TRUTH, "truth", None, 2),
        (DETECTIONS, "ring", "microphones", 1),
        (TRACKS, "plain", None, 1),
        (TRACKS, "scene", None, 1),
    ]
    assert recording.frames == [(0.1, "f.png")]


@pytest.mark.parametrize("objects", [5, [5], [{"object_id": 1}]])
def test_what_is_no_list_of_people_is_refused(objects):
    with pytest.raises(records.RecordError):
        Recording("x").add(record(0.0, objects), "t")


def test_people_named_by_text_keep_their_names():
    recording = Recording("x")
    recording.add(record(0.0, [{"object_id": "<b>", "position": [1, 2]}]), "t")
    assert recording.streams[0].rows == [[0.0, [["<b>", 1.0, 2.0]]]]


def test_sound_is_joined_encoded_and_drawn(tmp_path):
    rate = 44100
    tone = 0.1 * np.sin(2 * math.pi * 1000 * np.arange(rate) / rate)
    for name, piece in (("a", tone), ("b", np.ones(7))):
        soundfile.write(tmp_path / f"{name}.wav", np.stack([piece, 0 * piece], axis=1), rate, "FLOAT")
    files = [(1.5, tmp_path / "b.wav"), (0.5, tmp_path / "a.wav"), (0.5 + 1 / rate, tmp_path / "b.wav")]
    recorded = Recorded(files)
    track = recorded.channel(1)
    assert (track.start_s, len(track.samples)) == (0.5, rate + 7)
    np.testing.assert_allclose(recorded.read(-2, 3)[:, 0], [0, 0, 0, 1 + tone[1], 1 + tone[2]], atol=1e-6)
    track = sound.Track("m", 0.5, rate, track.samples - recorded.read(0, rate + 7)[:, 1])
    drawn = sound.pictured(track)
    assert drawn["step"] == pytest.approx(0.01)
    for new, expected in ((44100, 44100), (96000, 48000), (51200, 48000)):
        content, played = soundfile.read(io.BytesIO(sound.mp3(sound.Track("m", 0.0, new, track.samples))))
        assert played == expected
        assert len(content) / played == pytest.approx(len(track.samples) / new, abs=0.1)
        assert np.abs(content).max() == pytest.approx(0.89, abs=0.1)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    experiment(folder / "s3")
    (folder / "s3/audio/wav").mkdir(parents=True)
    tone = 0.3 * np.sin(2 * math.pi * 440 * np.arange(4 * 16000) / 16000)
    soundfile.write(folder / "s3/audio/wav/multichannel_audio_0.0000000000.wav", np.stack([tone, tone], axis=1), 16000)
    for name in ("a.html", "b.html"):
        assert run("avview", "s3", "--html", name, cwd=folder).stderr == ""
    assert (folder / "a.html").read_bytes() == (folder / "b.html").read_bytes()
    return folder


def test_standard_input_passes_through(made):
    content = (made / "s3/tracking/video_tracking.jsonl").read_bytes() + b"\n"
    result = run("avview", "-C", "s3", "--html", "pipe.html", stdin=content, cwd=made)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout == content
    text = (made / "pipe.html").read_text()
    assert '"kind":"tracks"' in text
    assert '"scores":null' in text


def test_bad_use_is_one_line(made):
    for arguments in (
        ["s3"],
        ["s3", "--html", "no/such.html"],
        ["s3", "--html", "x.html", "--microphone", "9"],
        [".", "--html", "x.html"],
        ["s3", "--html", "x.html", "--scenario", "none"],
        ["s3", "--html", "x.html", "--learnt", "none"],
        ["s3", "--html", "x.html", "--film", "none"],
    ):
        result = run("avview", *arguments, cwd=made)
        assert result.returncode in (1, 2), arguments
        assert result.stderr.count("\n") == 1, result.stderr
        assert not (made / "x.html").exists()


def test_pictures_of_another_size_are_said_once(made):
    raw = json.loads((made / "s3/config.json").read_text())
    raw["camera_config"] |= {"image_width_px": 1280, "image_height_px": 720}
    (made / "small.json").write_text(json.dumps(raw))
    result = run("avview", "s3", "-c", "small.json", "--html", "small.html", cwd=made)
    assert (result.returncode, result.stderr.count("\n")) == (0, 1)
    assert "camera_config 1280 × 720 px: what is drawn in it may be misplaced" in result.stderr


def test_a_large_page_has_a_folder(made):
    result = done("avview", "s3", "--html", "large.html", "--largest-mb", "0", cwd=made)
    assert "large.html.files" in result.stderr
    assert {path.name for path in (made / "large.html.files").iterdir()} == {
        "data.js",
        "film-0.webm",
        *("sound-0.mp3", "sound-0-0.mp3", "sound-0-1.mp3", "sound-0-2.mp3"),
    }
    assert (made / "large.html").stat().st_size < 75_000
    if not CHROMIUM:
        pytest.skip("no Chromium here")
    page = Browser((made / "large.html").as_uri())
    try:
        page.wait("document.getElementById('film').readyState > 1 && document.getElementById('speaker').readyState > 1")
        page.run("show(20); cue()")
        page.wait("Math.abs(document.getElementById('film').currentTime - 2.05) < 0.02")
        assert page.complaints() == []
    finally:
        page.close()


@pytest.mark.parametrize(("name", "codec"), [("film.webm", "VP80"), ("film.mp4", "mp4v"), ("film.avi", "MJPG")])
def test_a_film_that_browsers_play_is_copied_beside_a_page(made, name, codec):
    import cv2

    writer = cv2.VideoWriter(str(made / name), cv2.VideoWriter.fourcc(*codec), 10, (64, 48))
    for level in range(0, 250, 50):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    rows = (made / "s3/tracking/video_tracking.jsonl").read_bytes()
    done("avview", "--film", name, "--largest-mb", "0", "--html", f"{name}.html", stdin=rows, cwd=made)
    beside = made / f"{name}.html.files/film-0.webm"
    assert (beside.read_bytes() == (made / name).read_bytes()) == (codec == "VP80")
    film = cv2.VideoCapture(str(beside))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 5
    film.release()


@pytest.fixture(scope="module")
def browser(made):
    if not CHROMIUM:
        pytest.skip("no Chromium here")
    browser = Browser((made / "a.html").as_uri() + "#t=1.50")
    yield browser
    browser.close()


def test_it_opens_at_the_moment_of_the_address_and_keeps_it(browser):
    assert browser.run("now") == 15
    browser.key("ArrowRight")
    assert browser.run("location.hash") == "#t=1.60"
    assert browser.complaints() == []


def test_the_page_projects_through_the_exact_lens(browser, made):
    camera = experiments.read_config(made / "s3/config.json").camera
    rng = np.random.default_rng(0)
    points = rng.uniform([0.2, 0.2, 0], [4.4, 4.4, 1.9], (200, 3))
    from avcli import pose

    exact = camera.lens.project(pose.apply(pose.inverse(camera.T_room_camera), points))
    page = browser.run(f"{json.dumps(points.tolist())}.map(p => project(run.camera, p))")
    np.testing.assert_allclose(np.array(page, float), exact, atol=0.05)


def test_keys_work_after_every_click(browser):
    for button in ("#layers button", "#trackers button", "#closer", "#mute"):
        x, y = browser.run(
            f"(() => {{ const b = document.querySelector('{button}').getBoundingClientRect();"
            "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            browser.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        browser.key("Home")
        assert browser.run("now") == 0, button
        browser.key("ArrowRight")
        assert browser.run("now") == 1, button
        browser.key("End")
        assert browser.run("now") == 40, button


def test_a_click_on_the_error_goes_to_its_peak(browser):
    browser.run("run.scores[tracker.name].error.cm[33] = 90; look(0, 4); drawError()")
    x, y = browser.run(
        "(() => { const n = document.getElementById('error'); n.scrollIntoView({block: 'center'});"
        "const b = n.getBoundingClientRect(); return [b.x + n.at.x(3.3) + 4, b.y + 60]; })()"
    )
    browser.send("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left", clickCount=1)
    browser.send("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left", clickCount=1)
    assert browser.run("now") == 33


def test_all_trackers_stand_together(browser):
    browser.run("show(20)")
    browser.key("c", "KeyC")
    assert browser.run("document.querySelectorAll('#room [data-other]').length") == 6
    browser.key("c", "KeyC")
    assert browser.run("document.querySelectorAll('#room [data-other]').length") == 0


def test_a_click_on_a_track_listens_at_it(browser):
    browser.run("chooseTracker(trackers().at(-1)); show(20)")
    place = (
        "(() => { const n = document.querySelector('#room [data-track]'); n.scrollIntoView({block: 'center'});"
        "const b = n.getBoundingClientRect(); return [b.x + b.width / 2 + 5, b.y + b.height / 2]; })()"
    )
    for expected in ("You hear the beam at track", "You hear microphone 1"):
        x, y = browser.run(place)
        for kind in ("mousePressed", "mouseReleased"):
            browser.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        assert browser.run("document.getElementById('hearing').textContent").startswith(expected)
    browser.key("h", "KeyH")
    browser.wait("Math.abs(document.getElementById('speaker').duration - 4) < 0.2")
    assert browser.run("document.querySelectorAll('#people [aria-pressed=true]').length") == 1
    browser.run("listenTo(run.sound)")
    assert browser.complaints() == []


def test_lanes_and_sound_are_drawn_and_said(browser):
    assert browser.run(INKED.format("sound")) > 1000
    words = browser.run("document.getElementById('in-words').textContent")
    assert "speaks" in words
    assert "heard" in words


@pytest.mark.parametrize("width", [1400, 800, 400])
def test_it_fits(browser, width):
    browser.size(width, 800, mobile=width < 500)
    assert browser.run("document.documentElement.scrollWidth") <= width
    browser.wait(f"Math.abs(document.getElementById('timeline').clientWidth - {width}) < 80")
    picture, room = browser.run(
        "['picture', 'room'].map(id => document.getElementById(id).getBoundingClientRect().width)"
    )
    assert picture > 0.4 * width
    assert room > 0.25 * width


def test_an_hour_without_ground_truth(tmp_path):
    t = np.arange(36_000) / 10
    x = 2 + 1.5 * np.sin(t / 7)
    rows = [
        records.encode(
            record(float(s), [{"object_id": k, "position": [float(v), 1.0 + k], "existence": 1.0} for k in (0, 1)])
        )
        for s, v in zip(t, x, strict=True)
    ]
    result = run("avview", "--html", "hour.html", stdin=b"".join(rows), cwd=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    assert (tmp_path / "hour.html").stat().st_size < 4_000_000
    if not CHROMIUM:
        pytest.skip("no Chromium here")
    page = Browser((tmp_path / "hour.html").as_uri() + "#t=3599.9")
    try:
        assert page.run("now") == 35_999
        assert page.run("document.getElementById('clock').textContent") == "59:59.90"
        page.key("PageUp")
        assert page.run("run.ticks[now]") == pytest.approx(3589.9)
        for _ in range(6):
            page.key("+", "Equal")
        assert page.run("view[1] - view[0]") < 60
        assert page.complaints() == []
    finally:
        page.close()


def test_a_film_with_sound(made):
    rows = (made / "s3/tracking/video_tracking.jsonl").read_bytes().splitlines(keepends=True)[:6]
    result = run("avview", "-C", "s3", "--mp4", "f.mp4", stdin=b"".join(rows), cwd=made)
    assert (result.returncode, result.stderr) == (0, "")
    import cv2

    film = cv2.VideoCapture(str(made / "f.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 6
    assert film.read()[1].shape == (630, 1500, 3)
    film.release()
    if not CHROMIUM or shutil.which("ffmpeg"):
        pytest.skip("no Chromium here, or it may lack H.264")
    (made / "film.html").write_text('<b id="clock">0</b><video id="v" src="f.mp4" muted></video>')
    page = Browser((made / "film.html").as_uri())
    try:
        page.run("document.getElementById('v').play()")
        page.wait("document.getElementById('v').webkitAudioDecodedByteCount > 0")
        assert page.run("document.getElementById('v').duration") == pytest.approx(0.6, abs=0.1)
    finally:
        page.close()


def test_rerun_is_an_extra(made):
    result = run("avview", "s3", "--rrd", "f.rrd", cwd=made)
    try:
        import rerun  # noqa: F401
    except ModuleNotFoundError:
        assert result.returncode == 1
        assert "avcli[rerun]" in result.stderr
        assert not (made / "f.rrd").exists()
    else:
        assert (result.returncode, result.stderr) == (0, "")
        assert (made / "f.rrd").stat().st_size > 10_000


def test_a_live_page_follows_the_run(made):
    """The page has what was there when it was opened, gets the rest, and is for this machine alone."""
    command = [BIN / "avview", "-C", "s3", "--serve", "--port", "0"]
    process = subprocess.Popen(
        command, cwd=made, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0
    )
    rows = (made / "s3/tracking/video_tracking.jsonl").read_bytes().splitlines(keepends=True)
    page = None
    try:
        process.stdin.write(b"".join(rows[:10]))
        url = re.search(rb"http://127\.0\.0\.1:\d+/", process.stderr.readline())[0].decode()
        other = urllib.request.Request(url, headers={"Host": "example.org"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(other)
        if CHROMIUM:
            page = Browser(url)
            page.wait("run.ticks.length === 10 && now === 9")
        truth = (made / "s3/groundtruth_sources.jsonl").read_bytes().splitlines(keepends=True)
        process.stdin.write(b"".join(rows[10:]))
        process.stdin.write(b"".join(truth))
        frame = {"timestamp": 4.0, "frame": {"rgb": experiments.Layout.rgb(4.0)}}
        process.stdin.write(json.dumps(frame).encode() + b"\n")
        process.stdin.close()
        assert process.stdout.read().startswith(b"".join(rows + truth))  # and it ends, so that the next filter can
        if CHROMIUM:
            page.wait("run.ticks.length === 41 && now === 40")
            page.wait("document.getElementById('frame').naturalWidth > 0")
            page.wait("document.getElementById('about').textContent.includes('ended')")
            page.wait("run.scores && run.scores.tracks.error.cm.length === 41 && run.sound.peaks.length === 200")
            assert page.run("run.sound.brightest") == pytest.approx(255 + 40 * math.log10(0.3), abs=8)  # a tone of 0.3
            page.run("play()")
            page.wait("stream && stream.next > 1")
            page.run("stop(); listenTo(run.beams[0])")
            heard = (
                "fetch('sound?of=' + heard.id + '&from=1&to=1.5').then(a => a.arrayBuffer()).then(a => a.byteLength)"
            )
            assert page.run(heard) == 4 * 8000
            assert page.complaints(url) == []
    finally:
        if page:
            page.close()
        process.send_signal(signal.SIGINT)
        assert process.wait() == -signal.SIGINT
        process.stdout.close()
        process.stderr.close()


def test_nothing_to_show_still_stands(tmp_path):
    assert run("avview", "--html", "e.html", cwd=tmp_path).returncode == 0
    (tmp_path / "truth.jsonl").write_text(lines(walk()))
    assert run("avview", "truth.jsonl", "--html", "t.html", cwd=tmp_path).returncode == 0
    if not CHROMIUM:
        pytest.skip("no Chromium here")
    for name in ("e.html", "t.html"):
        browser = Browser((tmp_path / name).as_uri())
        try:
            assert browser.complaints() == []
        finally:
            browser.close()


def test_a_start_without_film_or_sound_is_wrong_usage(tmp_path):
    (tmp_path / "t.jsonl").write_text('{"timestamp":0,"objects":[{"object_id":1,"position":[1,1,0]}]}\n')
    result = run("avview", tmp_path / "t.jsonl", "--html", tmp_path / "p.html", "--start", "3")
    refused(result, "--start has no effect", status=2)
    assert not (tmp_path / "p.html").exists()
    for option in (["--beam", "1"], ["--microphone", "2"]):
        result = run("avview", tmp_path / "t.jsonl", "--html", tmp_path / "p.html", *option)
        refused(result, f"{' '.join(option)}: there is no sound", status=2)
    assert run("avview", tmp_path / "t.jsonl", "--html", tmp_path / "p.html", "--beam", "none").returncode == 0


@pytest.mark.parametrize(("start", "said"), [("0", True), ("1000.5", False)])
def test_sound_at_another_time_than_the_records_is_said(tmp_path, start, said):
    soundfile.write(tmp_path / "a.wav", np.zeros((8000, 2)), 8000)
    somebody = [{"object_id": 1, "position": [1, 1, 0]}]
    (tmp_path / "t.jsonl").write_text("".join(json.dumps(record(1000 + k / 10, somebody)) + "\n" for k in range(21)))
    options = ["--sound", tmp_path / "a.wav", "--start", start, "--html", tmp_path / "p.html"]
    result = done("avview", tmp_path / "t.jsonl", *options)
    apart = "the sound is from 0.0 to 1.0 s, but the records are from 1000.0 to 1002.0 s: is --start right?"
    assert (apart in result.stderr) == said


def test_a_film_replaces_no_file_that_is_shown(made):
    for name in ("config.json", "tracking/video_tracking.jsonl"):
        before = (made / "s3" / name).read_bytes()
        refused(run("avview", "s3", "--mp4", f"s3/{name}", cwd=made), "this file is an input", status=2)
        assert (made / "s3" / name).read_bytes() == before


def test_a_camera_whose_place_is_not_known_yet_draws_nothing_and_says_so(made, tmp_path):
    """A lens comes from avcalib calibrate, its place later from avcalib pose; of several cameras none is guessed."""
    raw = json.loads((made / "s3" / "config.json").read_text())
    lens = {key: value for key, value in raw["camera_config"].items() if key != "camera_position_m"}
    several = {
        "sensors": {name: {"kind": "camera", "camera_config": raw["camera_config"]} for name in ("left", "right")}
    }
    for camera in ({"camera_config": lens}, several):
        rest = {key: value for key, value in raw.items() if key != "camera_config"}
        (tmp_path / "c.json").write_text(json.dumps({**rest, **camera}))
        where = ("-C", made / "s3", "-c", tmp_path / "c.json", "--html", tmp_path / "p.html")
        result = done("avview", *where, made / "s3/groundtruth_sources.jsonl")
        assert "nothing is drawn into the pictures" in result.stderr


def test_the_named_camera_draws_into_its_pictures(made, tmp_path):
    """People are where the camera of --sensor sees them; it was the main camera's lens for any film."""
    raw = json.loads((made / "s3" / "config.json").read_text())
    moved = {**raw["camera_config"], "camera_position_m": [1.0, 1.5, 2.5]}
    named = {"left": {"kind": "camera", "camera_config": moved}}
    rest = {key: value for key, value in raw.items() if key != "camera_config"}
    for content, options, position in (
        ({**raw, "sensors": named}, ["--sensor", "left"], [1.0, 1.5, 2.5]),
        ({**raw, "sensors": named}, [], raw["camera_config"]["camera_position_m"]),
        ({**rest, "sensors": named}, [], [1.0, 1.5, 2.5]),
    ):
        (tmp_path / "c.json").write_text(json.dumps(content))
        where = ("-C", made / "s3", "-c", tmp_path / "c.json", "--html", tmp_path / "p.html")
        done("avview", *where, *options, made / "s3/groundtruth_sources.jsonl")
        page = (tmp_path / "p.html").read_text()
        assert f'"position":{json.dumps(position, separators=(",", ":"))}' in page
    wrong = run("avview", *where, "--sensor", "rihgt", made / "s3/groundtruth_sources.jsonl")
    refused(wrong, "no camera of this name", status=2)
