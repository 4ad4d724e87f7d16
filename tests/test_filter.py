"""The command frame: streams, located errors, exit codes, signals, atomic output."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import orjson
import pytest
from forked import run_forked

FILTER = [sys.executable, str(Path(__file__).with_name("copy_records.py"))]
GOOD = b'{"timestamp":"0.1000000000","objects":[{"position":[1.0,2.0,null],"score":0.5,"extra":{}}]}\n'


def copy(*options, stdin=GOOD):
    result = run_forked("copy_records", *options, stdin=stdin)
    result.stderr = result.stderr.encode()
    return result


def started(*options, **keywords):
    return subprocess.Popen([*FILTER, *map(str, options)], stdin=subprocess.PIPE, stderr=subprocess.PIPE, **keywords)


def test_a_record_goes_through():
    result = copy()
    assert (result.returncode, result.stderr) == (0, b"")
    assert orjson.loads(result.stdout) == {"timestamp": "0.1000000000", "count": 1, "number": 1, "seed": 0}


@pytest.mark.parametrize(
    ("stdin", "count"),
    [
        (b"", 0),
        (b"\n  \n\r\n", 0),
        (b"\xef\xbb\xbf" + GOOD, 1),
        (GOOD.replace(b"\n", b"\r\n") * 2, 2),
        (GOOD.rstrip(), 1),
        (b'{"timestamp": 3, "objects": []}', 1),
        (b'{\n  "timestamp": "0.0",\n  "objects": [\n    {\n      "position": [0, 1.33, 0.0]\n    }\n  ]\n}\n' * 2, 2),
        (b'{"timestamp": "0", "objects": []}\\n {"timestamp": "1", "objects": []}\\n', 2),
    ],
    ids=["empty", "blank", "bom", "crlf", "no-newline", "number", "pretty", "literal-newline"],
)
def test_what_counts_as_records(stdin, count):
    result = copy(stdin=stdin)
    assert (result.returncode, result.stderr) == (0, b"")
    assert len(result.stdout.splitlines()) == count


BAD = {
    b'{"timestamp": "0", "obj': "<stdin>:2:24: invalid JSON: ",
    b"RIFF\xa8\xab\x5d\x00WAVEfmt ": "<stdin>:2: not text, but perhaps sound or a picture",
    b"RIFF\xa8\xf7": "<stdin>:2: not text, but perhaps sound or a picture",
    b"\x89PNG\r": "<stdin>:2: not text, but perhaps sound or a picture",
    b"[1, 2]": "<stdin>:2: must be a JSON object, found [1,2]",
    b'{"objects": []}': '<stdin>:2: "timestamp" is missing',
    b'{"timestamp": "soon", "objects": []}': '<stdin>:2: "timestamp"',
    b'{"timestamp": "nan", "objects": []}': '<stdin>:2: "timestamp"',
    b'{"timestamp": true, "objects": []}': '<stdin>:2: "timestamp"',
    b'{"timestamp": "0"}': '<stdin>:2: "objects" is missing',
    b'{"timestamp": "0", "objects": [{"position": [NaN, 1, 2]}]}': "<stdin>:2:46: invalid JSON: NaN is no number",
    b'{"timestamp": "0", "objects": [{"position": [1e999, 1, 2]}]}': "<stdin>:2:",
    b'{"timestamp": "0", "objects": [{"position": [null, 1, 2]}]}': "<stdin>:2:",
    b'{"timestamp": "0", "objects": [{"position": ["1", 1, 2]}]}': "<stdin>:2:",
    b'{"timestamp": "0", "objects": [{}]}': '<stdin>:2: objects[0]: "position" is missing',
    b'{"timestamp": "0", "objects": [{"position": [0, 1, 2], "score": 1.5}]}': '<stdin>:2: objects[0]: "score"',
    b'{"timestamp": "0", "objects": [{"position": [0, 1, 2], "covariance": [[1]]}]}': "<stdin>:2: objects[0]: ",
    b'{"timestamp": "0", "objects": [{"position": [0, 1], "covariance": [[1, 2], [2, 1]]}]}': "<stdin>:2: objects[0]: ",
    b"{\n": "<stdin>:2:",
    b"\xff\xfe": "<stdin>:2:",
}


@pytest.mark.parametrize("line", BAD, ids=range(len(BAD)))
def test_a_bad_line_is_named_and_ends_the_run(line):
    result = copy(stdin=GOOD + line + b"\n" + GOOD)
    error = result.stderr.decode()
    assert result.returncode == 1
    assert error.startswith(f"copy-records: {BAD[line]}")
    assert error.count("\n") == 1
    assert len(result.stdout.splitlines()) == 1


@pytest.mark.parametrize("line", [line for line in BAD if line != b"{\n"], ids=range(len(BAD) - 1))
def test_a_bad_line_can_be_skipped(line):
    result = copy("--skip-invalid", stdin=GOOD + line + b"\n" + GOOD)
    counts = [orjson.loads(row)["count"] for row in result.stdout.splitlines()]
    assert result.returncode == 0
    assert counts in ([1, 1], [1, 0, 1])
    assert result.stderr in (b"copy-records: skipped 1 invalid record\n", b"copy-records: skipped 1 invalid object\n")


def test_a_bad_object_alone_is_skipped():
    line = b'{"timestamp": "0", "objects": [{"position": [0, 1, 2]}, {"position": null}, {"position": [3, 4]}]}'
    result = copy("--skip-invalid", stdin=line)
    assert orjson.loads(result.stdout)["count"] == 2
    assert result.stderr == b"copy-records: skipped 1 invalid object\n"


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["missing.jsonl"], 2, "missing.jsonl: no such file"),
        (["/"], 2, "/: is a directory"),
        (["-", "-"], 2, "named twice"),
        (["--nonsense"], 2, "--nonsense"),
        (["-o", "/no/such/directory/x"], 74, "/no/such/directory/x: No such file"),
        (["-o", "/dev/full"], 74, "/dev/full: No space left"),
    ],
)
def test_exit_codes(options, code, words):
    result = copy(*options)
    assert result.returncode == code
    assert words in result.stderr.decode()
    assert result.stderr.startswith(b"copy-records: ")
    assert result.stderr.count(b"\n") == 1


def test_help_version_seed_and_presets():
    assert b"Copy records." in copy("-h").stdout
    assert copy("--version").stdout.startswith(b"copy-records ")
    numbers = [
        orjson.loads(copy(*options).stdout)
        for options in (["--preset", "thesis"], ["--number", 7, "--preset", "thesis", "--seed", 5])
    ]
    assert [row["number"] for row in numbers] == [42, 7]
    assert [row["seed"] for row in numbers] == [0, 5]


def test_a_fault_of_the_program_is_one_line():
    command = "import sys, click; sys.argv[0] = 'copy-records'\nfrom avcli.commands.filter import Filter, common\n"
    command += "@click.command('copy-records', cls=Filter)\n@common()\ndef main(session): [][0]\nmain()"
    quiet, verbose = (
        subprocess.run([sys.executable, "-c", command, *options], capture_output=True, text=True)
        for options in ([], ["-v"])
    )
    line = "copy-records: internal error: IndexError: list index out of range (please report it; -v shows where)\n"
    assert (quiet.returncode, quiet.stderr) == (70, line)
    assert verbose.stderr.startswith("Traceback")
    assert verbose.stderr.endswith(line)


def test_full_disk_on_standard_output():
    with open("/dev/full", "wb") as full:
        result = subprocess.run(FILTER, input=GOOD, stdout=full, stderr=subprocess.PIPE, timeout=60)
    assert result.returncode == 74
    assert result.stderr.count(b"\n") == 1
    assert b"No space left" in result.stderr


def test_a_closed_pipe_ends_it_silently():
    process = started(stdout=subprocess.PIPE)
    process.stdout.close()
    _, error = process.communicate(GOOD * 1000, timeout=60)
    assert process.returncode == -signal.SIGPIPE
    assert error == b""


def test_each_record_leaves_at_once():
    process = started(stdout=subprocess.PIPE)
    for _ in range(2):
        process.stdin.write(GOOD)
        process.stdin.flush()
        assert process.stdout.readline()
    process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_inside_a_destructor_is_not_lost(number):
    program = f"""
import os, time, click
from avcli.commands.filter import Filter
class Texture:
    def __del__(self):
        os.kill(os.getpid(), {int(number)})
        sum(range(1000))
@click.command("x", cls=Filter)
def main():
    texture = Texture()
    del texture
    for _ in range(600):
        time.sleep(0.1)
    print("went on")
main([])
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=120)
    assert (result.returncode, result.stdout, result.stderr) == (-number, b"", b"")


def test_a_signal_waits_for_an_import(tmp_path):
    (tmp_path / "loaded.py").write_text(f"""
import os
class Field:
    def __set_name__(self, owner, name):  # Python 3.11 makes a RuntimeError of what is raised here
        os.kill(os.getpid(), {int(signal.SIGTERM)})
        sum(range(1000))
class Record:
    field = Field()
print("loaded", flush=True)
""")
    program = """
import time, click
from avcli.commands.filter import Filter
@click.command("x", cls=Filter)
def main():
    import loaded
    for _ in range(600):
        time.sleep(0.1)
    print("went on")
main([])
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=120, cwd=tmp_path)
    assert (result.returncode, result.stdout, result.stderr) == (-signal.SIGTERM, b"loaded\n", b"")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_the_old_file_and_no_other(tmp_path, number):
    old = tmp_path / "old.jsonl"
    old.write_text("good\n")
    process = started("-o", old, "--pause", 60)
    process.stdin.write(GOOD)
    process.stdin.flush()
    deadline = time.monotonic() + 30
    while len(os.listdir(tmp_path)) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(os.listdir(tmp_path)) == 2, "the temporary file lies beside the old one"
    process.send_signal(number)
    _, error = process.communicate(timeout=30)
    assert process.returncode == -number
    assert error == b""
    assert old.read_text() == "good\n"
    assert os.listdir(tmp_path) == ["old.jsonl"]


def test_a_signal_at_any_instruction_of_the_writer_leaves_the_old_file_and_no_other(tmp_path):
    """A process for each instruction between the first and the last of the writer; each gets SIGTERM there."""
    program = f"""
import os, signal, sys
import click
from avcli.commands.filter import Filter
from avcli.formats import atomic
OURS = {{atomic.__file__, atomic.contextlib.__file__}}
@click.command("x", cls=Filter)
@click.argument("instruction", type=int)
@click.argument("path")
def main(instruction, path):
    left = instruction
    def trace(frame, event, argument):
        nonlocal left
        frame.f_trace_opcodes = True
        if event == "opcode":
            left -= 1
            if left == 0:
                os.kill(os.getpid(), {int(signal.SIGTERM)})
        return trace if frame.f_code.co_filename in OURS else None
    sys.settrace(trace)
    with atomic.replacing(path) as temporary:
        temporary.write_text("new")
    sys.settrace(None)
    sys.exit(9 if left > 0 else 8)
folder = sys.argv[1]
path = os.path.join(folder, "old")
for instruction in range(1, 100000):
    with open(path, "w") as stream:
        stream.write("good")
    child = os.fork()
    if child == 0:
        main([str(instruction), path])
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with open(path) as stream:
        print(code, stream.read(), *os.listdir(folder), flush=True)
    if code == 9:
        break
"""
    result = subprocess.run([sys.executable, "-c", program, tmp_path], capture_output=True, text=True, timeout=240)
    *ended, last = result.stdout.splitlines()
    assert (result.stderr, last) == ("", "9 new old")
    assert len(ended) > 100
    assert set(ended) <= {"-15 good old", "-15 new old"}


def test_a_failed_run_leaves_the_old_file(tmp_path):
    old = tmp_path / "old.jsonl"
    old.write_text("good\n")
    assert copy("-o", old, stdin=GOOD + b"?\n").returncode == 1
    assert old.read_text() == "good\n"
    assert os.listdir(tmp_path) == ["old.jsonl"]
    assert copy("-o", old).returncode == 0
    assert orjson.loads(old.read_text())["count"] == 1


def test_memory_does_not_grow_with_the_number_of_records():
    program = (
        "import resource, sys; sys.argv[0] = 'copy-records'; sys.path.insert(0, sys.argv.pop(1))\n"
        "import copy_records\n"
        "try:\n    copy_records.main()\n"
        "finally:\n    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)\n"
    )
    sizes = []
    for count in (100, 20000):
        result = subprocess.run(
            [sys.executable, "-c", program, str(Path(__file__).parent), "-o", "/dev/null"],
            input=GOOD * count,
            capture_output=True,
            timeout=120,
        )
        sizes.append(int(result.stderr))
    assert sizes[1] < sizes[0] + 4096, "KiB"


def test_standard_input_on_a_terminal_is_a_usage_error():
    master, terminal = os.openpty()
    try:
        result = subprocess.run(FILTER, stdin=terminal, capture_output=True, timeout=60)
    finally:
        os.close(master)
        os.close(terminal)
    assert result.returncode == 2
    assert b"usage: copy-records" in result.stderr
