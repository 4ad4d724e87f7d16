"""avcli as a library: the README's programs, and the same results as the filters give."""

import contextlib
import inspect
import io
import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

import avcli

PROGRAMS = [
    program
    for page in ("README.md", "examples/README.md")
    for program in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
]


def run_program(program: str) -> tuple[list[str], dict]:
    """What a program prints, and its variables."""
    variables: dict = {}
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(program, variables)
    return printed.getvalue().splitlines(), variables


@pytest.fixture(scope="module")
def by_both(tmp_path_factory):
    with contextlib.chdir(tmp_path_factory.mktemp("program")):
        return run_program(PROGRAMS[1])


@pytest.mark.slow
def test_the_programs_of_the_readme(by_both):
    made = [run_program(PROGRAMS[0]), by_both]
    for program, (printed, _), most_lines in zip(PROGRAMS, made, (12, 20), strict=True):
        assert len([line for line in program.splitlines() if line.strip()]) <= most_lines
        assert printed == re.findall(r"# (HOTA .*)$", program, re.MULTILINE)


@pytest.mark.slow
def test_the_library_gives_what_the_filters_give(finished_s1, by_both):
    scene, heard, seen, tracks = (by_both[1][name] for name in ("scene", "heard", "seen", "tracks"))
    truth = avcli.load(finished_s1 / "groundtruth_sources.jsonl")
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
