"""avcalib live: which pictures it takes, where it wants the board, when it is enough, its page, and cameras."""

import json
import signal
import subprocess
import time
import urllib.error
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from calibration_boards import BOARD, HALF, HALF_SIZE, THESIS, exact, film, jpeg, photograph, photographs, write_film
from conftest import BIN, run

from avcli import pose
from avcli.calibration import corners, gather, live, nextview, quality, robust, watch
from avcli.calibration.settings import FitSettings
from avcli.formats.camera import Camera
from avcli.formats.footage import Picture
from avcli.formats.media import MediaError

SIZE = (1920, 1080)
FAST = FitSettings(board_shape="no")


@pytest.fixture(scope="session")
def shots():
    rng = np.random.default_rng(4)
    filmed = film(10, rng, lens=HALF, size=HALF_SIZE, tilt=0.8, distance=(0.35, 0.9))
    return photographs(filmed, rng)


def gathered(guide, pictures):
    return gather.collect(pictures, BOARD, eager=True, reason=guide.reason, after=guide.after)


def timed(shots, seconds):
    return [Picture(f"shot {i}", i * seconds, image) for i, image in enumerate(shots)]


# --- what it takes, and when it is enough -----------------------------------------------------------------------------


def test_the_guide_stops_when_enough_is_known(shots):
    said, shown = [], []
    guide = live.Guide(FAST, 1.0, said.append, lambda image, state: shown.append((image, state)))
    seen = gathered(guide, timed(shots, 1.0))
    assert live.LEAST_VIEWS <= len(seen.views) < len(shots)
    assert guide.mean_px <= 1.0
    assert "1 view, " in said[0]
    assert "hold the board" in said[0]
    assert "enough" in said[-1]
    image, state = shown[-1]
    assert image.shape == (540, 960, 3)
    assert state.enough
    record = json.loads(json.dumps(state.record()))
    assert [bar["name"] for bar in record["bars"]] == [
        "coverage",
        "trust",
        "tilt",
        "distance",
        "sharpness",
        "certainty",
    ]
    assert all(0 <= bar["value"] <= 1 for bar in record["bars"])
    assert record["bars"][-1]["value"] == 1


def test_a_board_that_moves_or_stays_is_not_taken_again(shots):
    guide = live.Guide(FAST)
    stays = [shots[0], np.roll(shots[0], 2, axis=1), np.roll(shots[0], 3, axis=1)]
    seen = gathered(guide, timed([*stays, np.roll(shots[0], 40, axis=1), np.roll(shots[0], 41, axis=1)], 0.1))
    assert [record["why"] for record in seen.records()] == ["no fit", "duplicate", "duplicate", "moving", "no fit"]


def test_a_blurred_board_is_not_taken(shots):
    import cv2

    guide = live.Guide(FAST)
    streak = np.full((1, 13), 1 / 13)
    seen = gathered(guide, timed([shots[0], cv2.filter2D(shots[1], -1, streak), shots[2]], 1.0))
    assert [record["why"] for record in seen.records()] == ["no fit", "blurred", "no fit"]
    assert "blurred" not in guide.state.hint


def test_the_width_of_edges_follows_the_blur():
    rng = np.random.default_rng(0)
    filmed = film(1, rng)
    widths = []
    for blur in (0.8, 1.6, 3.2):
        grey = photograph(filmed.rotations[0], filmed.translations[0], rng, blur=blur)
        widths.append(live.edge_width(corners.find(grey, BOARD)))
    assert widths == sorted(widths)
    assert 2.0 < widths[0] < 4.5
    assert 1.5 < widths[2] / widths[1] < 2.2


def corners_of(filmed, rng):
    """The views of filmed boards, without their pictures."""
    seen = exact(filmed, noise=0.05, rng=rng)
    every = np.arange(len(BOARD.points))
    patches = np.zeros((len(every), 2 * corners.PATCH + 1, 2 * corners.PATCH + 1), np.uint8)
    pixels = seen.pixels.reshape(seen.views, -1, 2)
    return [corners.View(every, one, patches, np.rint(one).astype(int), *SIZE) for one in pixels]


def test_who_stays_in_the_middle_is_not_told_enough():
    rng = np.random.default_rng(0)
    views = corners_of(film(12, rng, aim=((960, 540), 150)), rng)
    guide = live.Guide(FAST)
    for count in range(4, len(views) + 1, 4):
        guide.take(BOARD, views[:count], views[count - 1], *SIZE)
    assert guide.quality.mean_sd_px < live.ENOUGH * SIZE[0]
    assert guide.mean_px > 2 * live.ENOUGH * SIZE[0]
    assert not guide.state.enough


def test_where_no_other_place_is_left_the_best_one_is_asked_for_again(monkeypatch):
    rng = np.random.default_rng(0)
    views = corners_of(film(4, rng), rng)
    guide = live.Guide(FAST)
    guide.take(BOARD, views, views[-1], *SIZE)
    asked = guide.proposal
    monkeypatch.setattr(nextview, "propose", lambda *given: None if given[-1] else asked)
    for _ in range(live._PATIENCE + 2):
        guide.take(BOARD, views, None, *SIZE)
    assert guide.proposal is asked
    assert not guide._avoid


# --- where it wants the board -----------------------------------------------------------------------------------------


def lens_of(count, seed=0, lens=THESIS):
    observations = exact(
        film(count, np.random.default_rng(seed), lens=lens), lens=lens, noise=0.1, rng=np.random.default_rng(1)
    )
    solution, kept = robust.fit_robustly(observations, *SIZE)
    return solution, observations.of_corners(kept)


def test_the_proposal_is_whole_in_the_picture_and_lit():
    solution, seen = lens_of(5)

    def lit(pixels):
        return np.hypot(pixels[:, 0] - 960, pixels[:, 1] - 540) < 500

    found = nextview.propose(BOARD, solution, seen, *SIZE, lit)
    assert lit(found.outline).all()
    assert (found.outline > 0).all()
    assert (found.outline < SIZE).all()
    assert 0 < found.gain < 1


def test_it_goes_where_nothing_was_seen():
    filmed = film(8, np.random.default_rng(2), aim=((960, 540), 200))
    seen = exact(filmed, noise=0.1, rng=np.random.default_rng(1))
    solution, kept = robust.fit_robustly(seen, *SIZE)
    seen = seen.of_corners(kept)
    found = nextview.propose(BOARD, solution, seen, *SIZE)
    before = quality.coverage(seen.pixels, *SIZE)
    asked = quality.coverage(found.seen(BOARD.points), *SIZE)
    assert asked[before == 0].sum() > 0.5 * len(BOARD.points)
    other = nextview.propose(BOARD, solution, seen, *SIZE, avoid=(found.middle,))
    assert np.linalg.norm(other.middle - found.middle) > 0.1 * SIZE[0]


def test_what_a_view_brings_is_what_the_fit_gains():
    """Information adds up over views, and none is negative; near boards tell the pupil, far ones do not."""
    solution, seen = lens_of(6)
    each = nextview.information(seen, solution, 0.1, BOARD.square_m)
    assert np.linalg.eigvalsh(each).min() > -1e-6 * np.abs(each).max()
    half = nextview.information(seen.of_views(np.arange(3)), solution.of_views(np.arange(3)), 0.1, BOARD.square_m)
    assert np.allclose(half, each[:3])
    far = replace(solution, translations=3 * solution.translations)
    assert (nextview.information(seen, far, 0.1, BOARD.square_m)[:, -1, -1] < each[:, -1, -1]).all()


def test_the_words_name_the_nearer_edge():
    lens = replace(THESIS, cx=959.5, cy=539.5)
    first = nextview.first(BOARD, lens, *SIZE)
    assert first.words.startswith("in the middle")
    assert np.ptp(first.outline[:, 1]) == pytest.approx(SIZE[1] / 2, rel=0.02)
    R = pose.rotation_from_vector(np.array([[0.0, 0.6, 0.0]]))[0]
    t = np.array([0.0, 0.0, 0.9])
    nearer = R @ [0.3, 0, 0] + t, R @ [-0.3, 0, 0] + t
    side = "right" if nearer[0][2] < nearer[1][2] else "left"
    found = nextview._proposal(BOARD, lens, R, t, *SIZE, 0.1)
    assert f"so that its {side} edge is nearer" in found.words


# --- the command ------------------------------------------------------------------------------------------------------


def test_ctrl_c_while_filming_keeps_what_was_collected(shots):
    command = [BIN / "avcalib", "live", "-", "--board", "6x8", "--kind", "checkerboard", "--port", "0", "--no-stop"]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(command, **pipes) as process:
        line = b""
        for number, shot in enumerate(shots[:6], 1):
            process.stdin.write(jpeg(shot))
            process.stdin.flush()
            while f"{number} view".encode() not in line:
                line = process.stderr.readline()
                assert line
            time.sleep(0.55)
        process.send_signal(signal.SIGINT)  # while it waits for the next picture
        output, said = process.communicate(timeout=60)
    assert process.returncode == 0, said
    assert json.loads(output)["fx_px"] == pytest.approx(HALF.fx, abs=2)


def test_a_film_plays_at_its_own_pace(shots, tmp_path):
    path = write_film(tmp_path / "film.avi", shots[:2], each=8, fps=10)
    begin = time.monotonic()
    result = run("avcalib", "live", path, "--board", "6x8", "--kind", "checkerboard", "--port", "0")
    assert time.monotonic() - begin > 1.4
    assert result.returncode == 3, result.stderr  # at most two views determine no lens
    assert "1 view, " in result.stderr
    assert run("avcalib", "live", path, "--port", "0", "--host", "0.0.0.0").returncode == 2
    assert run("avcalib", "live", path, "--size", "960x540").returncode == 2


# --- its page ---------------------------------------------------------------------------------------------------------


def answer(url, host=None):
    request = urllib.request.Request(url, headers={"Host": host} if host else {})
    with urllib.request.urlopen(request, timeout=10) as reply:
        return reply.read()


def test_the_page_shows_the_newest_picture_and_the_state():
    import cv2

    with watch.serving(0) as show:
        assert b"<!doctype html>" in answer(show.url)
        show(np.full((40, 60, 3), (250, 0, 0), np.uint8), {"hint": "there"})
        assert json.loads(answer(f"{show.url}state?after=0")) == {"hint": "there", "number": 1}
        picture = cv2.imdecode(np.frombuffer(answer(f"{show.url}picture?1"), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (40, 60, 3)
    assert picture[20, 30, 2] > 240  # red, as it was given


def test_another_name_for_this_machine_gets_no_picture():
    """A page from the network must not read the camera through a name that it has lead here."""
    with watch.serving(0) as show:
        show(np.zeros((4, 6, 3), np.uint8))
        assert answer(show.url, f"localhost:{show.port}")
        with pytest.raises(urllib.error.HTTPError):
            answer(f"{show.url}picture", f"evil.example:{show.port}")


def test_in_the_network_the_address_has_a_key():
    with watch.serving(0, "0.0.0.0") as show:
        show(np.zeros((4, 6, 3), np.uint8))
        key = show.url.rsplit("/", 2)[1]
        assert len(key) >= 10
        assert answer(f"http://127.0.0.1:{show.port}/{key}/picture")
        for path in ("", "picture", "state", f"{key[:-1]}/picture"):
            with pytest.raises(urllib.error.HTTPError):
                answer(f"http://127.0.0.1:{show.port}/{path}")


# --- cameras ----------------------------------------------------------------------------------------------------------


class FakeCapture:
    """What cv2.VideoCapture is to a camera: its properties, and pictures until its cable is pulled."""

    def __init__(self, pictures, fixed=(), fourcc="MJPG", opens=True):
        import cv2

        self.pictures, self.fixed, self.opens, self.asked = list(pictures), fixed, opens, []
        self.values = {
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*fourcc)),
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_AUTOFOCUS: 1.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
            cv2.CAP_PROP_EXPOSURE: 157.0,
        }

    def isOpened(self):
        return self.opens

    def get(self, key):
        return self.values.get(key, 0.0)

    def set(self, key, value):
        import cv2

        self.asked.append((key, value))
        if key in self.fixed or key == cv2.CAP_PROP_FOURCC:
            return False
        self.values[key] = value
        return True

    def grab(self):
        return bool(self.pictures)

    def retrieve(self):
        return True, self.pictures.pop(0)

    def release(self):
        self.pictures = []


def seen_by(captures, **options):
    """What a camera gives whose captures are opened one after another, and what is said."""
    said, waiting = [], iter(captures)
    camera = Camera("/dev/video7", say=said.append, open=lambda _: next(waiting), **options)
    camera.ended.wait = lambda _: camera.ended.is_set()  # no waiting in a test
    return [image for _, image in camera.pictures()], said


def still(count, size=(64, 48)):
    return [np.full((size[1], size[0], 3), i, np.uint8) for i in range(count)]


def test_mjpg_is_asked_for_first_and_what_was_obtained_is_said():
    import cv2

    capture = FakeCapture(still(3))
    images, said = seen_by([capture], size=(64, 48))
    assert len(images) == 3
    assert capture.asked[0] == (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
    assert said == ["/dev/video7: 64 × 48 px, 30 Hz, MJPG, focus locked"]


def test_what_the_driver_cannot_do_is_said():
    import cv2

    capture = FakeCapture(still(30), fixed=(cv2.CAP_PROP_AUTOFOCUS, cv2.CAP_PROP_AUTO_EXPOSURE), fourcc="YUYV")
    _, said = seen_by([capture], lock_exposure=True)
    assert "no focus that the driver can lock" in said[0]
    assert "does not give MJPG; YUYV" in said[1]
    assert "cannot lock the exposure" in said[2]


def test_the_exposure_is_locked_once_it_has_settled_and_given_back():
    import cv2

    capture = FakeCapture(still(30))
    _, said = seen_by([capture], lock_exposure=True)
    assert "exposure locked at 157" in said[-1]
    assert (cv2.CAP_PROP_AUTO_EXPOSURE, 1) in capture.asked
    assert capture.asked[-1] == (cv2.CAP_PROP_AUTO_EXPOSURE, 3.0)


def test_an_unplugged_camera_comes_back():
    captures = [
        FakeCapture(still(2)),
        FakeCapture([], opens=False),
        FakeCapture([], opens=False),
        FakeCapture(still(3)),
    ]
    images, said = seen_by([*captures, *[FakeCapture([], opens=False)] * 9], patience_s=5.0)
    assert len(images) == 5
    assert any("went away" in line for line in said)
    assert any("is back" in line for line in said)
    assert "did not come back" in said[-1]


def test_a_camera_that_comes_back_with_another_size_is_refused():
    with pytest.raises(MediaError, match="not 64 × 48"):
        seen_by([FakeCapture(still(2)), FakeCapture(still(2, (32, 24)))], patience_s=5.0)


def test_a_camera_that_cannot_be_opened_is_named():
    with pytest.raises(MediaError, match="/dev/video7"):
        seen_by([FakeCapture([], opens=False)])
