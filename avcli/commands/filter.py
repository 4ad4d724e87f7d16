"""The frame that the seven filters share: streams, located errors, exit codes, signals.

A command is a click command of class `Filter` under `@common(...)`, whose first argument is the `Session`:

    @click.command("avfuse", cls=Filter)
    @click.argument("files", nargs=-1, metavar="[FILE]...")
    @common(skip_invalid=True)
    def main(session, files): ...

What click does by default and a Unix filter must not (exit 1 on a closed pipe, "Aborted!" on Ctrl-C, a traceback on a
full disk, a half-written file renamed over a good one) is done right here and nowhere else.
"""

import contextlib
import errno
import functools
import os
import signal
import stat
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import click

from avcli import __version__

EXIT_FAILURE, EXIT_USAGE, EXIT_GATE, EXIT_IO = 1, 2, 3, 74
LONGEST_LINE = 1 << 26
"""bytes; a line beyond it is no record, and reading on would fill the memory."""


class Failure(click.ClickException):
    """Bad data or a failed run: one line on stderr, exit 1."""


class GateNotMet(click.ClickException):
    """A quality gate was not met (`--fail-under`, an unobservable lens): one line on stderr, exit 3."""

    exit_code = EXIT_GATE


class InputOutputError(click.ClickException):
    """The machine would not read or write: one line on stderr, exit 74 (EX_IO)."""

    exit_code = EXIT_IO


class _Killed(BaseException):
    """A signal that ends the process, once everything that was begun has been put away."""

    def __init__(self, number: int):
        self.number = number


# --- how a command ends -----------------------------------------------------------------------------------------------


class _Frame:
    """What happens around a command: signals and exit codes (shared by a single command and a group of them)."""

    def main(self, args=None, prog_name=None, **extra):
        if f"_{self.name.replace('-', '_').upper()}_COMPLETE" in os.environ:
            return super().main(args, prog_name=self.name, **extra)
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            if signal.getsignal(number) is not signal.SIG_IGN:  # "nohup" and "&" ignore some on purpose
                signal.signal(number, _kill)
        try:
            code = self._run(list(sys.argv[1:] if args is None else args))
        except _Killed as killed:
            _die_of(killed.number)
        try:
            sys.stdout.flush()
        except OSError:  # what a full disk did not take must not be tried again when the interpreter ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(code)

    def _run(self, args: list[str]) -> int:
        verbose = any(a == "--verbose" or (a[:1] == "-" and a[1:2] != "-" and "v" in a) for a in args)
        try:
            with self.make_context(self.name, args) as context:
                self.invoke(context)
            sys.stdout.flush()
            return 0
        except click.exceptions.Exit as error:
            return error.exit_code
        except click.UsageError as error:
            path = error.ctx.command_path if error.ctx else self.name
            _say(self.name, f"{error.format_message()} (see '{path} --help')")
            return EXIT_USAGE
        except click.ClickException as error:
            _say(self.name, error.format_message())
            return error.exit_code
        except (ValueError, ModuleNotFoundError) as error:
            # Every stage refuses bad input by ValueError with a sentence made for the user.
            if verbose:
                traceback.print_exc()
            _say(self.name, str(error))
            return EXIT_FAILURE
        except BrokenPipeError:
            _die_of(signal.SIGPIPE)
        except OSError as error:
            _say(self.name, _reason(error))
            return EXIT_IO
        except MemoryError:
            _say(self.name, "out of memory")
            return EXIT_FAILURE


class Filter(_Frame, click.Command):
    """A filter with one action."""


class FilterGroup(_Frame, click.Group):
    """A filter with several actions (avcalib)."""


def _kill(number: int, _frame) -> None:
    signal.signal(number, signal.SIG_IGN)  # a second Ctrl-C must not interrupt the clean-up of the first
    raise _Killed(number)


def _die_of(number: int) -> None:
    """End as `cat` ends: of the signal itself, so that shells, loops and make see it."""
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.flush()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
    os._exit(128 + number)  # only if the signal is blocked


def _reason(error: OSError) -> str:
    text = error.strerror or str(error)
    return f"{error.filename}: {text}" if error.filename else text


def _say(name: str, text: str) -> None:
    with contextlib.suppress(OSError):
        print(f"{name}: {' '.join(text.split())}", file=sys.stderr, flush=True)


# --- what a command works with ----------------------------------------------------------------------------------------


class Session:
    """One run of one command: its streams, its experiment, and what it says on stderr."""

    def __init__(self, name: str, options: Mapping[str, Any]):
        self.name = name
        self.seed: int = options.get("seed") or 0
        self.quiet: bool = options["quiet"]
        self.verbose: bool = options["verbose"]
        self.output_path: str = options.get("output") or "-"
        self.skip_invalid: bool = bool(options.get("skip_invalid"))
        self._experiment: str | None = options.get("experiment")
        self._config_path: str | None = options.get("config")
        self._stdin_used = False
        self._warned: dict[str, int] = {}
        self._skipped = {"record": 0, "object": 0}
        self._timings: dict[str, float] = {}
        self._started = time.perf_counter()

    # What it says

    def warn(self, text: str, kind: str | None = None) -> None:
        """Print one line on stderr; of one `kind` only the first is printed and the others are counted."""
        kind = kind or text
        self._warned[kind] = self._warned.get(kind, 0) + 1
        if self._warned[kind] == 1 and not self.quiet:
            _say(self.name, text)

    def note(self, text: str) -> None:
        """Print one line on stderr under -v."""
        if self.verbose:
            _say(self.name, text)

    def fail(self, text: str) -> NoReturn:
        """End with one line on stderr and exit 1."""
        raise Failure(text)

    def usage(self, text: str) -> NoReturn:
        """End with one line on stderr and exit 2."""
        raise click.UsageError(text, click.get_current_context(silent=True))

    @contextlib.contextmanager
    def timing(self, stage: str) -> Iterator[None]:
        """Add the time that the block takes to the stage's, for -v."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._timings[stage] = self._timings.get(stage, 0.0) + time.perf_counter() - begin

    def progress(self, items: Iterable, total: int | None = None, label: str = "") -> Iterator:
        """Yield the items, with a progress bar on stderr where that is a terminal."""
        if self.quiet or not sys.stderr.isatty():
            yield from items
            return
        with click.progressbar(items, length=total, label=label or self.name, file=sys.stderr) as bar:
            yield from bar

    def finish(self) -> None:
        """Say what was skipped, what was warned of more than once and, under -v, what took how long."""
        for what, count in self._skipped.items():
            if count:
                _say(self.name, f"skipped {count} invalid {what}{'s' if count > 1 else ''}")
        if not self.quiet:
            for kind, count in self._warned.items():
                if count > 1:
                    _say(self.name, f"{count} times: {kind}")
        if self.verbose:
            for stage, seconds in self._timings.items():
                _say(self.name, f"{seconds:8.3f} s  {stage}")
            _say(self.name, f"{time.perf_counter() - self._started:8.3f} s  in all")

    # The experiment

    @property
    def experiment(self) -> Path:
        """The experiment's directory; usage error where -C was not given."""
        if self._experiment is None:
            self.usage("-C/--experiment DIR is needed")
        return Path(self._experiment)

    @property
    def has_experiment(self) -> bool:
        """Whether -C was given."""
        return self._experiment is not None

    @property
    def media_root(self) -> Path:
        """The directory that media paths in records are relative to."""
        return Path(self._experiment or ".")

    @property
    def has_config(self) -> bool:
        """Whether -C or -c was given."""
        return self._config_path is not None or self._experiment is not None

    @property
    def config_path(self) -> Path:
        """Where the config.json lies that -c or -C names."""
        return Path(self._config_path) if self._config_path else self.experiment / "config.json"

    @functools.cached_property
    def config(self):
        """The experiment's config.json, read when it is first asked for: after the first record."""
        from avcli.formats import experiment

        path = self.config_path
        try:
            return experiment.read_config(path)
        except FileNotFoundError:
            if self._config_path or not path.parent.is_dir():
                self.usage(f"{path}: no such file")
            raise Failure(f"{path}: no such file; avsim-scene writes it, and avcalib can") from None
        except IsADirectoryError:
            self.usage(f"{path}: is a directory")

    # In

    def open(self, path: str) -> BinaryIO:
        """Open a file that the user named, "-" for stdin, for reading bytes."""
        if path == "-":
            if sys.stdin is None or sys.stdin.isatty():
                context = click.get_current_context()
                self.usage(f"nothing on standard input; {' '.join(context.get_usage().split()).replace('U', 'u', 1)}")
            if self._stdin_used:
                self.usage("standard input ('-') is named twice")
            self._stdin_used = True
            return sys.stdin.buffer
        try:
            stream = open(path, "rb")  # noqa: SIM115 - its reader closes it
            if stat.S_ISDIR(os.fstat(stream.fileno()).st_mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), path)
        except OSError as error:
            self.usage(f"{path}: {(error.strerror or str(error)).lower()}")
        return stream

    def records(self, files: Iterable[str] = (), parse: Callable[[dict, Callable], Any] | None = None) -> Iterator[Any]:
        """Yield the records of the files one after another, stdin where none is named.

        `parse(record, bad)` turns a decoded record into what the command works with; what it refuses
        gets the place of its line. With --skip-invalid a bad line is dropped and counted, and so is a bad object that
        `parse` reports by `bad`. All files are opened at once, so that a missing one is known before any work is done.
        """
        streams = [(path, self.open(path)) for path in (tuple(files) or ("-",))]
        for path, stream in streams:
            with stream:
                yield from self.stream_records(stream, "<stdin>" if path == "-" else path, parse)

    def stream_records(self, stream: BinaryIO, name: str, parse: Callable | None = None) -> Iterator[Any]:
        """Yield the records of one open stream, as `records` does."""
        from avcli.formats import records

        for number, text in _texts(stream):
            place = f"{name}:{number}"
            try:
                if len(text) >= LONGEST_LINE:
                    raise records.RecordError("the line is too long for a record")
                record = records.decode(text)
                parsed = record if parse is None else parse(record, self._drop_object if self.skip_invalid else _strict)
            except records.RecordError as error:
                if not self.skip_invalid:
                    column = f":{error.column}" if error.column else ""
                    raise Failure(f"{place}{column}: {error}") from None
                self._skipped["record"] += 1
                self.note(f"{place}: skipped: {error}")
                continue
            yield parsed

    def _drop_object(self, reason: str) -> None:
        self._skipped["object"] += 1
        self.note(f"skipped: {reason}")

    # Out

    @contextlib.contextmanager
    def output(self) -> Iterator[Callable[[Mapping | bytes | str], None]]:
        """Yield `write`, which sends one record (or bytes, or text) to -o FILE or stdout and flushes it.

        A regular file appears whole when the block ends well, and otherwise not at all.
        """
        from avcli.formats import records
        from avcli.formats.atomic import replacing

        def writer(stream: BinaryIO) -> Callable:
            def write(item: Mapping | bytes | str) -> None:
                if isinstance(item, str):
                    item = item.encode()
                stream.write(item if isinstance(item, bytes) else records.encode(item))
                stream.flush()

            return write

        if self.output_path == "-":
            yield writer(sys.stdout.buffer)
            return
        path = Path(self.output_path)
        try:
            special = path.exists() and not path.is_file()
            if special and path.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            if path.is_file() and not os.access(path, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            with contextlib.ExitStack() as stack:
                target = path if special else stack.enter_context(replacing(path))
                with open(target, "wb") as stream:
                    yield writer(stream)
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise
            raise InputOutputError(f"{path}: {error.strerror or error}") from None


def _strict(reason: str) -> None:
    from avcli.formats.records import RecordError

    raise RecordError(reason)


def _texts(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield (line number, text) of each JSON text of a stream.

    A record is a line. Two habits of other writers are taken too, since the thesis's listings have them: an object
    printed over several lines (its first line is a lone brace, its last a brace in the same column), and records that
    are separated by a literal backslash-n.
    """
    number, block, begin, indent = 0, [], 0, b""
    while line := stream.readline(LONGEST_LINE):
        number += 1
        if number == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        text = line.strip()
        if block:
            block.append(line)
            if text in (b"}", b"},") and line[: len(line) - len(line.lstrip())] == indent:
                yield begin, b"".join(block).strip().removesuffix(b",")
                block = []
            elif sum(map(len, block)) > LONGEST_LINE:
                yield begin, b"".join(block)
                block = []
        elif text == b"{":
            block, begin, indent = [line], number, line[: len(line) - len(line.lstrip())]
        elif b"}\\n" in text:
            for part in text.replace(b"}\\n", b"}\n").split(b"\n"):
                if part.strip():
                    yield number, part.strip()
        elif text:
            yield number, text
    if block:
        yield begin, b"".join(block)


# --- the options that all share ---------------------------------------------------------------------------------------


def common(
    *,
    experiment: bool = True,
    seed: bool = False,
    skip_invalid: bool = False,
    output: bool = True,
    presets: Mapping[str, Mapping[str, Any]] | None = None,
) -> Callable:
    """Add the shared options to a command and hand it a Session as its first argument.

    Args:
        experiment: -C/--experiment and -c/--config.
        seed: --seed.
        skip_invalid: --skip-invalid.
        output: -o/--output.
        presets: for --preset: name -> parameter name -> value; an option that is given wins over the preset's.
    """
    options = []
    if experiment:
        options += [
            click.option(
                "-C", "--experiment", metavar="DIR", help="Experiment directory; media paths are relative to it."
            ),
            click.option("-c", "--config", metavar="FILE", help="config.json to use instead of DIR/config.json."),
        ]
    if output:
        options.append(
            click.option(
                "-o",
                "--output",
                metavar="FILE",
                default="-",
                show_default=True,
                help="Where the records go, whole or not at all; - is standard output.",
            )
        )
    if presets:
        options.append(
            click.option(
                "--preset",
                type=click.Choice(list(presets)),
                is_eager=True,
                expose_value=False,
                callback=functools.partial(_apply_preset, presets),
                help="Set the options to what the thesis did; options that are given still win.",
            )
        )
    if seed:
        options.append(
            click.option(
                "--seed",
                type=click.IntRange(0),
                default=0,
                show_default=True,
                help="Seed of all chance: the same inputs and seed give the same bytes.",
            )
        )
    if skip_invalid:
        options.append(
            click.option(
                "--skip-invalid", is_flag=True, help="Drop bad lines and bad objects, count them, say how many."
            )
        )
    options += [
        click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors on stderr."),
        click.option("-v", "--verbose", is_flag=True, help="Say more on stderr, with the time of each stage."),
        click.version_option(__version__, "--version", message="%(prog)s %(version)s"),
        click.help_option("-h", "--help"),
    ]
    shared = {"experiment", "config", "output", "seed", "skip_invalid", "quiet", "verbose"}

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def run(**values):
            context = click.get_current_context()
            session = Session(context.find_root().info_name, values)
            result = function(session, **{key: value for key, value in values.items() if key not in shared})
            session.finish()
            return result

        for option in reversed(options):
            run = option(run)
        return run

    return decorate


def _apply_preset(presets: Mapping, context: click.Context, _parameter, value: str | None) -> None:
    if value is not None:
        context.default_map = {**(context.default_map or {}), **presets[value]}
