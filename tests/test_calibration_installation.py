"""avcalib check without pictures: is the installation whole, and is it plausible?"""

import json

import numpy as np
import pytest
from conftest import done, run

from avcli.calibration import installation
from avcli.formats.experiment import Config
from avcli.formats.media import write_png

WHOLE = {
    "camera_config": {
        "lens_model": "kannala_brandt",
        "fx_px": 431.1, "fy_px": 431.4, "cx_px": 524.5, "cy_px": 276.1, "k1": -0.0269, "k2": -0.0038,
        "image_width_px": 960, "image_height_px": 540,
        "theta_max_observed_deg": 69.0,
        "calibration": {"views_used": 24, "held_out_rms_px": 0.155},
        "camera_position_m": [2.3, 2.4, 2.6], "camera_rotation_deg": [88, 3, 0],
        "pose_covariance": (np.eye(6) * 1e-6).tolist(), "pose_rms_px": 0.4,
    },
    "microphone_config": {
        "mic_positions_m": [[0.1, 0.1, 2.0], [4.5, 0.1, 2.0], [0.1, 4.5, 2.0], [4.5, 4.5, 2.0]],
        "audio_sample_rate_hz": 48000,
    },
    "room_config": {"room_dimensions_m": [4.66, 4.66, 2.8]},
}  # fmt: skip


def changed(section, **values):
    """The whole installation with some keys of a section changed; None removes one."""
    raw = json.loads(json.dumps(WHOLE))
    raw[section] |= values
    raw[section] = {key: value for key, value in raw[section].items() if value is not None}
    return raw


def examined(raw, folder):
    return {part.name: part for part in installation.examine(Config(raw), folder)}


def test_a_whole_installation(tmp_path):
    parts = examined(WHOLE, tmp_path)
    assert all(part.is_good for part in parts.values())
    assert parts["lens"].state == "measured"
    assert parts["limits"].state == "measured"
    assert parts["pose"].state == "measured"
    assert "± 2 mm" in parts["pose"].text
    assert parts["microphones"].state == "stated"
    assert parts["doors"].state == parts["background"].state == "absent"
    assert json.loads(json.dumps(installation.record(list(parts.values()))))["lens"]["state"] == "measured"


@pytest.mark.parametrize(
    ("section", "values", "part", "state", "words"),
    [
        ("camera_config", {"fx_px": None}, "lens", "missing", "avcalib live"),
        ("camera_config", {"fx_px": "wide"}, "lens", "wrong", "fx_px"),
        ("camera_config", {"cx_px": 5.0}, "lens", "wrong", "principal point"),
        ("camera_config", {"calibration": None}, "lens", "stated", "nothing says how"),
        ("camera_config", {"theta_max_observed_deg": None}, "limits", "missing", "no angle"),
        ("camera_config", {"theta_max_observed_deg": 20.0}, "limits", "wrong", "up to 20°"),
        ("camera_config", {"camera_position_m": None}, "pose", "missing", "avcalib pose"),
        ("camera_config", {"camera_position_m": [2.3, 2.4, 3.1]}, "pose", "wrong", "outside the room"),
        ("camera_config", {"camera_rotation_deg": [-90, 0, 0]}, "pose", "wrong", "camera_rotation_deg"),
        ("camera_config", {"pose_rms_px": 116.0}, "pose", "wrong", "116.0 px"),
        ("camera_config", {"pose_covariance": None}, "pose", "stated", "nothing says how"),
        ("camera_config", {"pose_covariance": None, "camera_rotation_deg": None}, "pose", "stated", "assumed"),
        ("camera_config", {"background_depth": "none.png"}, "background", "wrong", "none.png"),
        ("camera_config", {"background_rgb": "none.png"}, "background", "wrong", "none.png"),
        ("microphone_config", {"mic_positions_m": [[9, 1, 1]]}, "microphones", "wrong", "microphone 1 is outside"),
        ("microphone_config", {"mic_positions_m": [[1, 1, 1]] * 2}, "microphones", "wrong", "in one place"),
        ("microphone_config", {"calibration": {"sd_m": 0.004}}, "microphones", "measured", "± 4 mm"),
        ("room_config", {"room_dimensions_m": [466, 466, 280]}, "room", "wrong", "is no room"),
        ("room_config", {"room_dimensions_m": None}, "room", "missing", "measure the room"),
    ],
)  # fmt: skip
def test_what_is_missing_or_wrong_is_named(tmp_path, section, values, part, state, words):
    found = examined(changed(section, **values), tmp_path)[part]
    assert (found.state, words in found.text) == (state, True), found


def test_pictures_and_sound_must_agree(tmp_path):
    import soundfile

    (tmp_path / "video" / "rgb").mkdir(parents=True)
    (tmp_path / "audio" / "wav").mkdir(parents=True)
    write_png(tmp_path / "video" / "rgb" / "RGB_frame_0.1000000000.png", np.zeros((480, 640, 3), np.uint8))
    soundfile.write(tmp_path / "audio" / "wav" / "a.wav", np.zeros((100, 8)), 48000)
    parts = examined(WHOLE, tmp_path)
    assert "the pictures are 640 × 480" in parts["lens"].text
    assert "8 channels" in parts["microphones"].text
    assert not parts["lens"].is_good


def test_the_command(tmp_path):
    config = tmp_path / "config.json"
    config.write_text(json.dumps(WHOLE))
    result = done("avcalib", "check", tmp_path)
    assert json.loads(result.stdout)["pose"]["state"] == "measured"
    config.write_text(json.dumps({**WHOLE, "microphone_config": None}))
    result = run("avcalib", "check", config)
    assert result.returncode == 3
    assert "not complete: microphones" in result.stderr
    assert run("avcalib", "check", config, "--part", "lens", "--part", "pose").returncode == 0
    assert run("avcalib", "check", config, "--part", "roof").returncode == 2
    assert run("avcalib", "check", config, "--fail-over", "1").returncode == 2
    assert run("avcalib", "check", tmp_path / "none.json").returncode == 2
    line = tmp_path / "line.json"
    line.write_text(json.dumps(WHOLE["camera_config"]))
    assert run("avcalib", "check", line, "--part", "lens").returncode == 0
