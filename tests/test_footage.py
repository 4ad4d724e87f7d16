"""What names of pictures mean, the times of picture files, and pictures written again."""

import cv2
import numpy as np
import pytest

from avcli.formats import footage, media
from avcli.formats.footage import Picture, Sink, UnreadShot

GREY = np.arange(48 * 64, dtype=np.uint32).reshape(48, 64) % 251


def picture(kind=np.uint8, channels=3):
    return np.repeat(GREY[..., None], channels, axis=2).astype(kind) if channels > 1 else GREY.astype(kind)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "folder").mkdir()
    for name in ("b.PNG", "a.png"):
        media.write_png(tmp_path / "folder" / name, picture())
    (tmp_path / "folder" / "notes.txt").write_text("not a picture")
    return tmp_path / "folder"


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("-", "stream"),
        ("0", "camera"),
        ("/dev/video3", "camera"),
        ("a.png", "picture"),
        ("a.JPG", "picture"),
        ("frame_%03d.png", "pattern"),
        ("frame_%03d", "video"),
        ("rtsp://host/stream", "url"),
        ("http://host/film.mp4", "video"),
        *((f"film{suffix}", "video") for suffix in footage.VIDEOS),
        ("frames.jsonl", "file"),
        ("no-suffix", "file"),
    ],
)
def test_what_a_name_means(name, kind):
    assert footage.source(name).kind == kind
    assert footage.source(name).is_live == (kind in ("stream", "camera", "url"))


def test_a_folder_has_its_pictures_in_the_order_of_their_names(folder):
    source = footage.source(str(folder))
    assert source.kind == "folder"
    assert [path.name for path in source.files()] == ["a.png", "b.PNG"]
    names = [str(folder), str(folder / "a.png")]
    assert footage.count_pictures(names) == 3
    assert [one.timestamp for one in footage.pictures(names)] == [0.0, 1.0, 2.0]


def test_a_folder_has_picture_10_after_picture_2(tmp_path):
    for name in ("f10.png", "f2.png", "f1.png", "a_10.5.png", "a_9.5.png"):
        media.write_png(tmp_path / name, picture())
    names = [path.name for path in footage.source(str(tmp_path)).files()]
    assert names == ["a_9.5.png", "a_10.5.png", "f1.png", "f2.png", "f10.png"]


@pytest.mark.parametrize(("name", "missing"), [("gone.png", "no such file"), ("9876", "no such camera")])
def test_what_is_missing_is_named(folder, name, missing):
    with pytest.raises(FileNotFoundError, match=missing) as error:
        footage.sources([str(folder), "-", name])
    assert error.value.filename.endswith(name)


def test_times_stand_in_the_names_of_all_pictures_or_of_none(tmp_path):
    named = [tmp_path / f"RGB_frame_{time}.png" for time in ("0.5000000000", "2.25")]
    assert footage.stamped(named, 10.0) == [(0.5, named[0]), (2.25, named[1])]
    late = tmp_path / "RGB_frame_10.5000000000.png"
    assert [time for time, _ in footage.stamped([late, *named], 10.0)] == [0.5, 2.25, 10.5]  # * has 10.5 before 2.25
    mixed = [*named, tmp_path / "other.png"]
    assert [time for time, _ in footage.stamped(mixed, 4.0)] == [0.0, 0.25, 0.5]


def test_what_a_shell_names_is_taken_in_the_order_of_numbers_and_anything_else_as_named(tmp_path):
    shell = sorted((tmp_path / f"{folder}/img{k}.png" for folder in "ab" for k in (1, 2, 10)), key=str)
    taken = [f"{path.parent.name}{path.stem}" for _, path in footage.stamped(shell, 10.0)]
    assert taken == ["aimg1", "aimg2", "aimg10", "bimg1", "bimg2", "bimg10"]
    assert [path for _, path in footage.stamped(shell[::-1], 10.0)] == shell[::-1]


def test_shots_decoded_ahead_are_the_same_and_read_once():
    read = []

    def reader(kind, number):
        def load():
            read.append((kind, number))
            return np.full((2, 2), number)

        return load

    shots = [UnreadShot(k / 10, reader("rgb", k), reader("depth", k) if k % 2 else None) for k in range(9)]
    ahead = list(footage.decoded_ahead(shots, rgb=True, depth=False))
    assert [one.timestamp for one in ahead] == [one.timestamp for one in shots]
    assert sorted(read) == [("rgb", k) for k in range(9)]
    assert [int(one.rgb()[0, 0]) for one in ahead] == list(range(9))
    assert [one.depth is None for one in ahead] == [one.depth is None for one in shots]
    assert len(read) == 9


def test_an_error_of_a_picture_ahead_comes_with_its_own_shot():
    def broken():
        raise media.MediaError("broken")

    shots = [UnreadShot(0.0, lambda: GREY, None), UnreadShot(0.1, broken, None)]
    first, second = footage.decoded_ahead(shots, rgb=True, depth=False)
    assert first.rgb() is GREY
    with pytest.raises(media.MediaError):
        second.rgb()


@pytest.mark.parametrize(
    "image", [picture(), picture(channels=1), picture(np.uint16, 1), picture(channels=4), picture(np.uint16)]
)
def test_a_png_holds_what_was_written(tmp_path, image):
    with Sink(tmp_path / "out", (64, 48), 10.0, single=False, prefix="new") as sink:
        sink.write(Picture("", 0.25, image), image)
    path = tmp_path / "out" / "new_0.2500000000.png"
    assert np.array_equal(media.read_picture(path), image)


@pytest.mark.parametrize("suffix", sorted(footage.VIDEOS))
def test_each_kind_of_video_can_be_written_and_read(tmp_path, suffix):
    path = tmp_path / f"film{suffix}"
    with Sink(path, (64, 48), 10.0, single=True) as sink:
        for k in range(5):
            sink.write(Picture("", k / 10, picture()), np.full((48, 64, 3), [200, 100, 40], np.uint8))
    found = list(footage.pictures([str(path)]))
    assert len(found) == 5
    assert np.abs(found[2].image.mean(axis=(0, 1)) - [200, 100, 40]).max() < 8


def test_of_a_long_film_pictures_after_key_frames_are_taken(tmp_path):
    path = tmp_path / "film.mp4"
    with Sink(path, (64, 48), 10.0, single=True) as sink:
        for k in range(600):
            sink.write(Picture("", k / 10, picture()), np.full((48, 64, 3), k * 240 // 600, np.uint8))
    found = list(footage.pictures([str(path)], 2.0, grey=True, most=40))
    assert footage.count_pictures([str(path)], 2.0, most=40) == 40
    times = np.array([one.timestamp for one in found])
    assert 33 <= len(found) <= 40
    assert times[0] < 3
    assert times[-1] > 56
    assert np.diff(times).min() > 1
    for one in found:
        assert abs(one.image.mean() - one.timestamp * 4) < 8
    every = list(footage.pictures([str(path)], 2.0, grey=True, most=400))
    assert len(every) == 120


@pytest.mark.parametrize("whole", [True, False])
def test_what_becomes_of_an_unfinished_video(tmp_path, whole):
    path = tmp_path / "film.avi"

    def begin():
        with Sink(path, (64, 48), 10.0, single=True, whole=whole) as sink:
            sink.write(Picture("", 0.0, picture()), picture())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begin()
    assert [one.name for one in tmp_path.iterdir()] == ([] if whole else ["film.avi"])
    if not whole:
        assert cv2.VideoCapture(str(path)).read()[0]


def test_one_picture_file_takes_one_picture(tmp_path):
    with pytest.raises(ValueError, match="one picture"):
        Sink(tmp_path / "a.png", (64, 48), 10.0, single=False)
    with Sink(tmp_path / "a.jpg", (64, 48), 10.0, single=True) as sink:
        sink.write(Picture("", 0.0, picture()), picture())
        with pytest.raises(media.MediaError, match="one picture"):
            sink.write(Picture("", 0.1, picture()), picture())
    with (
        Sink(tmp_path / "a.xyz", (64, 48), 10.0, single=True) as sink,
        pytest.raises(media.MediaError, match=r"cannot be written as '\.xyz'"),
    ):
        sink.write(Picture("", 0.0, picture()), picture())


def test_pictures_of_one_name_do_not_replace_each_other(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        media.write_png(tmp_path / folder / "one.png", picture())
    with Sink(tmp_path / "new", (64, 48), 10.0, single=False) as sink:
        sink.write(Picture(str(tmp_path / "a" / "one.png"), 0.0, picture()), 0 * picture())
        with pytest.raises(media.MediaError, match=r"one\.png was written already; .*b/one\.png needs another folder"):
            sink.write(Picture(str(tmp_path / "b" / "one.png"), 1.0, picture()), picture())
    assert not media.read_picture(tmp_path / "new" / "one.png").any()
    with Sink(tmp_path / "new", (64, 48), 10.0, single=False) as sink:  # another run may replace them
        sink.write(Picture(str(tmp_path / "b" / "one.png"), 0.0, picture()), picture())


def test_what_a_folder_holds_in_the_order_of_numbers(tmp_path):
    for name in ("img10.png", "img2.png", "img1.png"):
        media.write_png(tmp_path / name, picture())
    names = [str(tmp_path / f"img{k}.png") for k in (1, 2, 10)]
    assert footage.in_numbers([str(tmp_path), "film.mp4"]) == [*names, "film.mp4"]


def film_of(path, count=20):
    """A film of noise, MJPG at 10 Hz, each picture of another brightness."""
    chance = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (160, 120))
    for number in range(count):
        writer.write((chance.integers(0, 40, (120, 160, 3)) + 10 * number).astype(np.uint8))
    writer.release()
    return path.read_bytes()


def test_a_film_goes_on_behind_damaged_pictures_and_says_so(tmp_path):
    path, said = tmp_path / "film.avi", []
    whole = film_of(path)
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes(range(256)) * 64 + whole[middle + 16384 :])
    brightness = [one.image.mean() for one in footage.pictures([str(path)], say=said.append)]
    assert len(brightness) >= 15
    assert brightness[-1] == pytest.approx(20 + 10 * 19, abs=3)
    assert len(said) == 1
    assert said[0].startswith(f"{path}: damaged pictures are left out: ")


def test_a_film_that_is_cut_short_is_said_to_be(tmp_path):
    path, said = tmp_path / "film.avi", []
    whole = film_of(path, 40)
    assert len(list(footage.pictures([str(path)], say=said.append))) == 40
    assert said == []
    path.write_bytes(whole[: len(whole) // 2])
    assert 15 < len(list(footage.pictures([str(path)], say=said.append))) < 25
    assert len(said) == 1
    assert said[0].startswith(f"{path}: its header states 4.0 s, but it ends after ")
