"""avcli as a library: the README's programs, and the same results as the filters give."""

import inspect
import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import HANG_S, ROOT

import avcli

PROGRAMS = [
    program
    for page in ("README.md", "examples/README.md")
    for program in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "most_lines"), list(zip(PROGRAMS, (12, 20), strict=True)), ids=["by ear", "by both"]
)
def test_the_programs_of_the_readme(program, most_lines, tmp_path):
    assert len([line for line in program.splitlines() if line.strip()]) <= most_lines
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=HANG_S
    )
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.splitlines() == re.findall(r"# (HOTA .*)$", program, re.MULTILINE)


@pytest.mark.slow
def test_the_library_gives_what_the_filters_give(finished_s1):
    scene = avcli.simulate("s1")
    truth = avcli.load(finished_s1 / "groundtruth_sources.jsonl")
    heard = avcli.localize(scene.config, avcli.hear(scene.config, scene.truth))
    seen = list(avcli.detect(scene.config, scene.shots(), background=scene.background))
    tracks = avcli.track(scene.config, heard, seen)
    for made, file in [
        (heard, "localization/audio_localizations.jsonl"),
        (seen, "localization/video_localizations.jsonl"),
        (tracks, "tracking/audio_video_tracking.jsonl"),
    ]:
        expected = avcli.load(finished_s1 / file)
        assert len(made) == len(expected) == 41
        for one, other in zip(made, expected, strict=True):
            assert one.timestamp == pytest.approx(other.timestamp, abs=1e-9)
            np.testing.assert_allclose(one.positions, other.positions, atol=1e-6)
            np.testing.assert_allclose(one.covariances, other.covariances, atol=1e-6)
    np.testing.assert_allclose([one.positions for one in scene.truth], [one.positions for one in truth], atol=1e-9)


def test_records_come_back_as_they_were_saved(finished_s1, tmp_path):
    for file in ("localization/video_localizations.jsonl", "tracking/audio_video_tracking.jsonl"):
        before = avcli.load(finished_s1 / file)
        avcli.save(tmp_path / "saved.jsonl", before)
        after = avcli.load(tmp_path / "saved.jsonl")
        for one, other in zip(after, before, strict=True):
            for name, value in vars(other).items():
                mine = getattr(one, name)
                if name == "features":
                    assert mine.keys() == value.keys()
                    mine, value = ([v for f in told.values() for v in vars(f).values()] for told in (mine, value))
                for a, b in zip(mine, value, strict=True) if name == "features" else [(mine, value)]:
                    np.testing.assert_array_equal(a, b, err_msg=name)


def test_the_door_is_lazy_and_complete():
    program = "import sys, avcli; print(*sorted({'numpy', 'scipy', 'cv2', 'click'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "\n"
    for name in avcli._DOOR:
        function = getattr(avcli, name)
        assert name in dir(avcli)
        assert all(p.annotation is not p.empty for p in inspect.signature(function).parameters.values()), name
        assert inspect.signature(function).return_annotation is not inspect.Signature.empty, name
        assert "Args:" in function.__doc__, name
        assert "Raises:" in function.__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        avcli.simulat  # noqa: B018
