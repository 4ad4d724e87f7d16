"""The report in a real browser, and the figures."""

import json
import time

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from conftest import done, run
from test_aveval import lines, record, walk


def experiment(folder, sequence="s3", people=3):
    """An experiment with all that a report can show: truth with voices, three trackers, two sensors, camera frames."""
    from avcli.formats.experiment import Layout
    from avcli.formats.media import write_png

    for name in ("tracking", "localization", "video/rgb"):
        (folder / name).mkdir(parents=True)
    walks = [walk(k, y=1.33 + k) for k in range(people)]
    rows = []
    for t in range(41):
        objects = [{"object_id": k, "position": walks[k][t][2], "speaking": t // 14 == k} for k in range(people)]
        rows.append(record(t / 10, objects))
    (folder / "groundtruth_sources.jsonl").write_text("".join(rows))
    for tracker, offset in (("audio", 0.4), ("video", 0.2), ("audio_video", 0.1)):
        text = lines(*(walk(k + 3, y=1.33 + k, offset=offset) for k in range(people)))
        (folder / "tracking" / f"{tracker}_tracking.jsonl").write_text(text)
    for sensor in ("audio", "video"):
        text = ""
        for t in range(41):
            objects = [{"position": [*walks[k][t][2][:2], 1.6]} for k in range(people) if (t + k) % 3]
            if sensor == "video":
                objects = [{**item, "bbox_px": [60, 40, 120, 90]} for item in objects]
            text += json.dumps({"timestamp": f"{t / 10:.10f}", "sensor": sensor, "objects": objects}) + "\n"
        (folder / "localization" / f"{sensor}_localizations.jsonl").write_text(text)
    config = {
        "camera_config": {
            "camera_position_m": [2.33, 2.33, 2.5],
            "camera_rotation_deg": [90, 0, 0],
            "fx_px": 86.0,
            "fy_px": 86.0,
            "cx_px": 95.5,
            "cy_px": 53.5,
            "k1": 0.0,
            "k2": 0.0,
            "k3": 0.0,
            "k4": 0.0,
            "lens_model": "kannala_brandt",
            "image_width_px": 192,
            "image_height_px": 108,
        },
        "microphone_config": {"audio_sample_rate_hz": 44100, "mic_positions_m": [[0.1, 0.1, 2.5], [4.5, 4.5, 2.5]]},
        "room_config": {"room_dimensions_m": [4.66, 4.66, 3.0]},
    }
    (folder / "config.json").write_text(json.dumps(config))
    for t in range(0, 41, 10):
        image = np.full((108, 192, 3), 40 + t, np.uint8)
        image[40:90, 60 + t : 120 + t] = (200, 80, 60)
        write_png(folder / Layout.rgb(t / 10), image)
    return folder


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    experiment(folder / "s3")
    experiment(folder / "s1", people=1)
    # A name that would break out of the page if it were not escaped.
    source = folder / "s1" / "tracking" / "video_tracking.jsonl"
    (folder / "s1" / "tracking" / "<script>alert(1)<_script>_tracking.jsonl").write_bytes(source.read_bytes())
    done("aveval", "--experiments", "s3", "s1", "--html", "r.html", "--compare-thesis", "-q", cwd=folder)
    done("aveval", "--experiments", "s3", "s1", "--html", "again.html", "--compare-thesis", "-q", cwd=folder)
    assert (folder / "r.html").read_bytes() == (folder / "again.html").read_bytes()
    return folder / "r.html"


def test_the_report_is_one_file(page):
    text = page.read_text()
    assert "{{" not in text
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in text
    assert "<script>alert" not in text
    assert "data:image/jpeg" in text


@pytest.fixture(scope="module")
def browser(page):
    if not CHROMIUM:
        pytest.skip("no Chromium here")
    browser = Browser(page.as_uri())
    yield browser
    browser.close()


TRACKS = "[...document.querySelectorAll('#room [data-track]')].map(n => +n.getAttribute('cx'))"
INKED = (
    "(n => n.getContext('2d').getImageData(0, 0, n.width, n.height).data.filter((v, i) => i % 4 === 3 && v).length)"
    "(document.getElementById('{}'))"
)
SLIDE = (
    "(v => {{ const s = document.getElementById('slider'); s.value = v; s.dispatchEvent(new Event('input')); }})({})"
)


def test_the_slider_moves_the_drawing_and_nothing_complains(browser):
    browser.run(SLIDE.format(0))
    first = browser.run(TRACKS)
    picture = browser.run("document.getElementById('frame').src")
    browser.run(SLIDE.format(20))
    later = browser.run(TRACKS)
    assert len(first) == len(later) == 3
    np.testing.assert_allclose(np.subtract(later, first), 200, atol=1e-6)  # two metres
    assert browser.run("document.getElementById('clock').textContent") == "2.00 s"
    assert browser.run("document.getElementById('frame').src") != picture
    assert browser.run("document.querySelectorAll('#boxes rect[data-found]').length") > 0
    assert browser.run("document.querySelectorAll('#people .speaks').length") == 1
    assert browser.run("document.querySelectorAll('#hota path').length") == 4
    assert browser.run(INKED.format("timeline")) > 1000
    assert browser.run(INKED.format("error")) > 500
    assert browser.complaints() == []


def test_it_plays_and_obeys_the_keyboard(browser):
    browser.run("document.activeElement.blur()")
    browser.key("Home")
    assert browser.run("now") == 0
    browser.key("ArrowRight")
    assert browser.run("now") == 1
    browser.key("1", "Digit1")
    assert browser.run("tracker.name") == "audio"
    browser.key(" ", "Space")
    browser.wait("now > 3")
    browser.key(" ", "Space")
    held = browser.run("now")
    time.sleep(0.3)
    assert browser.run("now") == held
    browser.run("document.getElementById('slider').focus()")
    browser.key("End")
    assert browser.run("now") == 40
    assert browser.complaints() == []


def test_another_sequence_and_tracker(browser):
    browser.run(
        "document.getElementById('run').value = 1; document.getElementById('run').dispatchEvent(new Event('change'))"
    )
    assert browser.run("document.querySelectorAll('#room [data-track]').length") == 1
    assert browser.run("document.querySelectorAll('#trackers button').length") == 5  # four, and all together
    browser.run(
        "document.getElementById('run').value = 0; document.getElementById('run').dispatchEvent(new Event('change'))"
    )
    browser.run("document.querySelector('#layers button[data-name=tracks]').click()")
    assert browser.run(TRACKS) == []
    browser.run("document.querySelector('#layers button[data-name=tracks]').click()")
    assert browser.complaints() == []


def test_it_fits_a_phone_and_is_touched(browser):
    browser.size(360, 740, mobile=True)
    assert browser.run("document.documentElement.scrollWidth") <= 360
    assert browser.run("document.getElementById('play').getBoundingClientRect().height") >= 40
    place = browser.run(
        "(() => { const n = document.getElementById('timeline'); n.scrollIntoView({block: 'center'});"
        "const b = n.getBoundingClientRect(); return [b.right - 13, b.top + 10]; })()"
    )
    browser.run("show(0)")
    browser.touch(*place)
    browser.wait("now > 30")
    browser.size(1280, 900)


def test_light_and_dark(browser):
    seen = []
    for scheme in ("light", "dark"):
        browser.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        seen.append(browser.run("getComputedStyle(document.body).backgroundColor"))
    assert seen[0] != seen[1]


def test_a_report_of_nothing_stands(page, tmp_path):
    (tmp_path / "empty.jsonl").write_text("")
    assert run("aveval", "empty.jsonl", "-", "--html", "r.html", cwd=tmp_path).returncode == 0
    (tmp_path / "truth.jsonl").write_text(lines(walk()))
    assert run("aveval", "truth.jsonl", "empty.jsonl", "--html", "t.html", cwd=tmp_path).returncode == 0
    if not CHROMIUM:
        pytest.skip("no Chromium here")
    for name in ("r.html", "t.html"):
        browser = Browser((tmp_path / name).as_uri())
        try:
            assert browser.complaints() == []
        finally:
            browser.close()
