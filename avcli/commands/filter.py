"""The frame that all filters share: streams, located errors, exit codes, signals.

A command is a click command of class `Filter` under `@common(...)`, whose first argument is the `Session`:

    @click.command("avfuse", cls=Filter)
    @click.argument("files", nargs=-1, metavar="[FILE]...")
    @common(skip_invalid=True)
    def main(session, files): ...

click's defaults do not suit a Unix filter: exit 1 on a closed pipe, "Aborted!" on Ctrl-C, a traceback on a full disk, a
half-written file renamed over a good one. This module replaces them, and no other module does.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import gc
import importlib
import os
import signal
import stat
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

import click

from avcli import __version__
from avcli.commands.options import WholeRange

if TYPE_CHECKING:
    from avcli.formats.experiment import Config

EXIT_FAILURE, EXIT_USAGE, EXIT_GATE, EXIT_FAULT, EXIT_IO = 1, 2, 3, 70, 74


class Failure(click.ClickException):
    """Invalid data or a failed run: one line on stderr, exit 1."""


class GateNotMet(click.ClickException):
    """A quality gate was not met (`--fail-under`, an unobservable lens): one line on stderr, exit 3."""

    exit_code = EXIT_GATE


class InputOutputError(click.ClickException):
    """Reading or writing failed: one line on stderr, exit 74 (EX_IO)."""

    exit_code = EXIT_IO


class Killed(BaseException):
    """A signal that ends the process after all clean-up."""

    def __init__(self, number: int):
        self.number = number


# --- how a command ends -----------------------------------------------------------------------------------------------


class Filter(click.Command):
    """A filter with one action: the signals and exit codes of a Unix filter around a click command."""

    def main(self, args: Any = None, prog_name: Any = None, *others: Any, **extra: Any) -> Any:
        """Run the command and exit the process; only click's completion of shells returns to click."""
        if f"_{str(self.name).replace('-', '_').upper()}_COMPLETE" in os.environ:
            return super().main(args, self.name, *others, **extra)
        _reopen_closed()
        for number in _ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:  # "nohup" and "&" ignore some on purpose
                signal.signal(number, _kill)
        sys.unraisablehook = _deliver_again
        try:
            code = self._run(list(sys.argv[1:] if args is None else args))
        except Killed as killed:
            _die_of(killed.number)
        full = False
        try:
            sys.stdout.flush()
        except OSError:  # the interpreter must not try again at its end to write to a full disk
            full = True
        if full or args is None:  # the next stage sees the end now, and not after this one's memory is given back
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        gc.freeze()  # what is left goes with the process: to look for cycles in it takes as long as a library's import
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
            return self._ended(f"{error.format_message()} (see '{path} --help')", EXIT_USAGE)
        except click.ClickException as error:
            return self._ended(error.format_message(), error.exit_code)
        except BrokenPipeError:
            _die_of(signal.SIGPIPE)
        except OSError as error:
            return self._ended(_reason(error), EXIT_IO)
        except MemoryError:
            return self._ended("out of memory", EXIT_FAILURE)
        except Exception as error:
            if verbose:
                traceback.print_exc()
            # Every stage refuses invalid input by ValueError with a sentence made for the user.
            if isinstance(error, ValueError | ModuleNotFoundError):
                return self._ended(str(error), EXIT_FAILURE)
            said = f"internal error: {type(error).__name__}: {error} (please report it; -v shows where)"
            return self._ended(said, EXIT_FAULT)

    def _ended(self, text: str, code: int) -> int:
        _say(self.name, text)
        return code


class FilterGroup(Filter, click.Group):
    """A filter with several actions (avcalib)."""


def _reopen_closed() -> None:
    """Open streams that the caller has closed (>&-), so that no file takes their numbers.

    Messages on such a stderr are lost. Records on such a stdout are an error.
    """
    for number, name, mode in ((1, "stdout", os.O_RDONLY), (2, "stderr", os.O_WRONLY)):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, mode)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8"))


_ENDING = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
_waiting: list[int] | None = None  # signals that came in a block of `unbroken`; None outside of one


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """Put the end by a signal off until the block is done, so that what it changes is whole."""
    global _waiting
    waiting: list[int] = []
    _waiting = waiting
    try:
        yield
    finally:
        _waiting = None
        if waiting:
            raise Killed(waiting[0])


def _kill(number: int, frame: FrameType | None) -> None:
    for each in _ENDING:  # a second signal ends the process at once, even where the clean-up waits for something
        if signal.getsignal(each) is _kill:
            signal.signal(each, signal.SIG_DFL)
    if _waiting is not None:
        _waiting.append(number)
        return None
    while frame is not None:
        if frame.f_globals.get("__name__") == _IMPORT:
            return _kill_later(number)  # libraries in C that are being loaded may crash, or raise another error
        frame = frame.f_back
    raise Killed(number)


_IMPORT = "importlib._bootstrap"


def _kill_later(number: int) -> None:
    signal.signal(signal.SIGALRM, lambda _number, frame: _kill(number, frame))
    signal.setitimer(signal.ITIMER_REAL, 0.01)


def _deliver_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Deliver a signal again that arrived inside a __del__ (moderngl has many): Python drops what is raised there."""
    killed = unraisable.exc_value
    if isinstance(killed, Killed):
        _kill_later(killed.number)
    else:
        sys.__unraisablehook__(unraisable)


def _die_of(number: int) -> NoReturn:
    """End by the signal itself, as `cat` does, so that shells, loops and make see it."""
    from avcli.formats import atomic

    atomic.remove_unfinished()
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.flush()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
    os._exit(128 + number)  # only if the signal is blocked


def _reason(error: OSError) -> str:
    if error.errno == errno.EBADF and not error.filename:
        return "standard output is closed"
    text = error.strerror or str(error)
    return f"{error.filename}: {text}" if error.filename else text


def _keep_freed_memory() -> None:
    """Keep what large arrays leave for the next ones: to give pages back and ask for them anew takes longer than most
    of the work on them. Where the C library has no such setting (mallopt of glibc), nothing happens.
    """
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD)
        mallopt(_M_TRIM_THRESHOLD, _MOST_KEPT)


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_LARGEST_MMAP_THRESHOLD, _MOST_KEPT = 1 << 25, 1 << 30  # bytes; glibc refuses a larger threshold


def _say(name: str | None, text: str) -> None:
    with contextlib.suppress(OSError):
        print(f"{name}: {' '.join(text.split())}", file=sys.stderr, flush=True)


# --- what a command works with ----------------------------------------------------------------------------------------

Write = Callable[[Mapping[str, Any] | bytes | str], None]
"""Writes one record, bytes or text."""


class Session:
    """One run of one command: its streams, its experiment, and its messages on stderr."""

    def __init__(self, name: str, options: Mapping[str, Any]):
        _keep_freed_memory()
        self.name = name
        self.seed: int = options.get("seed") or 0
        self.quiet: bool = options["quiet"]
        self.verbose: bool = options["verbose"]
        self.output_path: str = options.get("output") or "-"
        self.skip_invalid: bool = bool(options.get("skip_invalid"))
        self.allow_outside: bool = bool(options.get("allow_outside"))
        self._must_be_complete: bool = bool(options.get("complete"))
        self._marks_end: bool = bool(options.get("mark_end"))
        self._experiment: str | None = options.get("experiment")
        self._config_path: str | None = options.get("config")
        self._stdin_used = False
        self._warned: Counter[str] = Counter()
        self._skipped: Counter[str] = Counter()
        self._timings: dict[str, float] = {}
        self._started = time.perf_counter()

    # Messages

    def warn(self, text: str, kind: str | None = None) -> None:
        """Print one line on stderr; of one `kind` only the first is printed and the others are counted."""
        kind = kind or text
        self._warned[kind] += 1
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

    def check_outputs(
        self, outputs: Mapping[str, str | None], inputs: Iterable[str] = (), *, writes_config: bool = False
    ) -> None:
        """End with a usage error, before any work, where a file that is to be written is an input or config.json, or
        has no directory, or has the name of another output.

        Args:
            outputs: by option, beside that of --output.
            inputs: files that are read.
            writes_config: whether --output gets a whole config.json, which may be the one that is read.
        """
        configs = [str(self.config_path)] if self.has_config else []
        read = ["/dev/stdin" if path == "-" else path for path in inputs]  # which may be a file: command <FILE -o FILE
        taken = {os.path.realpath(path): "this file is an input; name another one" for path in (*read, *configs)}
        replaceable = [os.path.realpath(path) for path in configs] if writes_config else []
        for option, path in {"": self.output_path, **outputs}.items():
            if option and path == "-":
                self.usage(f"{option} -: only --output writes to standard output; a file of that name is ./-")
            if not path or path == "-" or (os.path.exists(path) and not os.path.isfile(path)):  # a device takes several
                continue
            real = os.path.realpath(path)
            if real in taken and (option or real not in replaceable):
                self.usage(f"{option or '-o'} {path}: {taken[real]}")
            if option and not os.path.isdir(os.path.dirname(path) or "."):
                self.usage(f"{option} {path}: there is no such directory")
            taken[real] = "two outputs have the same name"

    def note_skipped(self, what: str, count: int, total: int, why: str, stage: str = "") -> None:
        """Say under -v how much was not computed, why, and what that saved.

        Args:
            what: was to be computed, in the plural.
            count: how many were not, of `total`.
            why: it was not needed, as "where nothing moves".
            stage: whose time was spent on the others; "" where that is not known.
        """
        if not total:
            return
        said = f"not computed: {count} of {total} {what} ({100 * count / total:.0f} %), {why}"
        saved = self._timings.get(stage, 0.0) * count / (total - count) if count < total else 0.0
        if saved >= 0.005:  # two digits are written
            said += f"; saved about {saved:.2f} s"
        self.note(said)

    @contextlib.contextmanager
    def timing(self, stage: str) -> Iterator[None]:
        """Add the time that the block takes to the stage's, for -v."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._timings[stage] = self._timings.get(stage, 0.0) + time.perf_counter() - begin

    def progress(self, items: Iterable[Any], total: int | None = None, label: str = "") -> Iterator[Any]:
        """Yield the items, with a progress bar on stderr where that is a terminal and records do not appear on it."""
        if not self.shows_progress:
            yield from items
            return
        with click.progressbar(items, length=total, label=label or self.name, file=sys.stderr) as bar:
            yield from bar

    @property
    def shows_progress(self) -> bool:
        """Whether a progress bar can be seen and disturbs nothing."""
        records_on_terminal = self.output_path == "-" and sys.stdout.isatty()
        return not self.quiet and sys.stderr.isatty() and not records_on_terminal

    def lines(self, files: Iterable[str]) -> int | None:
        """Return how many lines the files have, for a progress bar; None where there is none, or one is a stream."""
        paths = [Path(path) for path in files]
        if not (self.shows_progress and paths and all(path.is_file() for path in paths)):
            return None
        count = 0
        for path in paths:
            with open(path, "rb") as file:
                while chunk := file.read(1 << 20):
                    count += chunk.count(b"\n")
        return count

    def finish(self) -> None:
        """Print the numbers of skipped records and of repeated warnings and, under -v, the time of each stage."""
        for what, count in self._skipped.items():
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
            self.usage("-C/--experiment DIR is required")
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
        """The path of the config.json that -c or -C names."""
        return Path(self._config_path) if self._config_path else self.experiment / "config.json"

    @functools.cached_property
    def config(self) -> Config:
        """The experiment's config.json, read at first use: after the first record."""
        from avcli.formats import experiment

        path = self.config_path
        try:
            return experiment.read_config(path)
        except FileNotFoundError:
            if self._config_path or not path.parent.is_dir():
                self.usage(f"{path}: no such file")
            raise Failure(f"{path}: no such file; avsim-scene or avcalib can write it") from None
        except IsADirectoryError:
            self.usage(f"{path}: is a directory")

    # In

    @staticmethod
    def load(*modules: str) -> None:
        """Import the modules that the first record needs, while it is on its way."""
        for module in modules:
            importlib.import_module(module)

    def open(self, path: str) -> BinaryIO:
        """Open a file that the user named, "-" for stdin, for reading bytes."""
        if path == "-":
            if sys.stdin is None:
                self.usage("standard input is closed; name a FILE or pipe records in")
            if sys.stdin.isatty():
                usage = " ".join(click.get_current_context().get_usage().split()).replace("U", "u", 1)
                self.usage(f"standard input is a terminal; name a FILE or pipe records in; {usage}")
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

    def records(self, files: Iterable[str] = (), parse: Callable[..., Any] | None = None) -> Iterator[Any]:
        """Yield the records of the files one after another, stdin where none is named.

        All files are opened at once, so that a missing one is known before any work is done.

        Args:
            files: paths; "-" is stdin.
            parse: called with each decoded record and a function `bad`; its result is yielded. Where it raises
                RecordError, the message gets the place of the line. With --skip-invalid an invalid line is dropped and
                counted, and so is an invalid object that `parse` reports by calling `bad` with the reason.
        """
        streams = [(path, self.open(path)) for path in (tuple(files) or ("-",))]
        for path, stream in streams:
            with stream:
                yield from self.stream_records(stream, "<stdin>" if path == "-" else path, parse)

    def stream_records(self, stream: BinaryIO, name: str, parse: Callable[..., Any] | None = None) -> Iterator[Any]:
        """Yield the records of one open stream, as `records` does."""
        from avcli.formats import records

        bad = self._drop_object if self.skip_invalid else records.refuse
        marks = records.EndMarks()
        good = 0
        for number, text in records.texts(stream):
            place = f"{name}:{number}"
            try:
                record = records.decode(text)
                if marks.is_mark(record):
                    continue
                parsed = record if parse is None else parse(record, bad)
            except records.RecordError as error:
                another = isinstance(error, records.WrongKindError) and not good  # all records would be skipped
                if another or not self.skip_invalid:
                    column = f":{error.column}" if error.column else ""
                    raise Failure(f"{place}{column}: {error}") from None
                self._skipped["record"] += 1
                self.note(f"{place}: skipped: {error}")
                continue
            good += 1
            yield parsed
        if missing := marks.missing():
            if self._must_be_complete:
                self.fail(f"{name}: {missing}")
            self.warn(f"{name}: {missing}")

    def _drop_object(self, reason: str) -> None:
        self._skipped["object"] += 1
        self.note(f"skipped: {reason}")

    # Out

    @contextlib.contextmanager
    def output(self) -> Iterator[Write]:
        """Yield `write`, which sends one record (or bytes, or text) to -o FILE or stdout and flushes it.

        A regular file appears whole when the block ends well, and otherwise not at all. With --mark-end the first
        record announces a mark, which follows the last one when the block ends well.
        """
        from avcli.formats import atomic, records

        @contextlib.contextmanager
        def writer(stream: BinaryIO) -> Iterator[Write]:
            count, last = 0, 0.0

            def write(item: Mapping[str, Any] | bytes | str) -> None:
                nonlocal count, last
                if isinstance(item, Mapping):
                    announced = {**item, "end": False} if self._marks_end and not count else item
                    count, last = count + 1, item.get("timestamp", last)
                    item = records.encode(announced)
                stream.write(item.encode() if isinstance(item, str) else item)
                stream.flush()

            yield write
            if self._marks_end:
                stream.write(records.encode(records.end_mark(last, count)))
                stream.flush()

        if self.output_path == "-":
            with writer(sys.stdout.buffer) as write:
                yield write
            return
        try:
            with atomic.writing(self.output_path) as stream, writer(stream) as write:
                yield write
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise
            own = error.filename is None or atomic.is_temporary(error.filename)
            path = self.output_path if own else error.filename
            raise InputOutputError(f"{path}: {error.strerror or error}") from None


# --- the options that all share ---------------------------------------------------------------------------------------


def common(
    *,
    experiment: bool = True,
    seed: bool = False,
    skip_invalid: bool = False,
    media: bool = False,
    output: bool = True,
    mark_end: bool = False,
    presets: Mapping[str, Mapping[str, Any]] | None = None,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add the shared options to a command and hand it a Session as its first argument.

    Args:
        experiment: -C/--experiment and -c/--config.
        seed: --seed.
        skip_invalid: --skip-invalid and --complete, for a command that reads records.
        media: --allow-outside, for a command that reads the files which records name.
        output: -o/--output.
        mark_end: --mark-end, for a command that writes records with timestamps.
        presets: for --preset: name -> parameter name -> value; an option that is given wins over the preset's.
    """
    options = []
    if experiment:
        text = "Experiment directory; media paths are relative to it."
        options.append(click.option("-C", "--experiment", metavar="DIR", help=text))
        options.append(click.option("-c", "--config", metavar="FILE", help="Use this file instead of DIR/config.json."))
    if output:
        text = "Output file, written whole or not at all; - is standard output."
        options.append(click.option("-o", "--output", metavar="FILE", default="-", show_default=True, help=text))
    if presets:
        text = "Use the settings of the thesis; options that are given still win."
        words: dict[str, Any] = {"is_eager": True, "expose_value": False, "help": text}
        words["callback"] = functools.partial(_apply_preset, presets)
        options.append(click.option("--preset", type=click.Choice(list(presets)), **words))
    if seed:
        text = "Random seed; the same inputs and seed give the same bytes."
        options.append(
            click.option("--seed", type=WholeRange(0, 2**63 - 1), metavar="N", default=0, show_default=True, help=text)
        )
    if skip_invalid:
        options.append(click.option("--skip-invalid", is_flag=True, help="Drop and count invalid lines and objects."))
        text = "Exit 1 if an input announced an end mark and ended without it."
        options.append(click.option("--complete", is_flag=True, help=text))
    if media:
        text = "Also read files outside the experiment directory that records name."
        options.append(click.option("--allow-outside", is_flag=True, help=text))
    if mark_end:
        text = "Write an end mark after the last record; readers then notice a stream that was cut."
        options.append(click.option("--mark-end", is_flag=True, envvar="AVCLI_MARK_END", help=text))
    options += [
        click.option("-q", "--quiet", is_flag=True, help="Print only errors on stderr."),
        click.option("-v", "--verbose", is_flag=True, help="Print details on stderr, with the time of each stage."),
        click.version_option(__version__, "--version", message="%(prog)s %(version)s"),
        click.help_option("-h", "--help"),
    ]
    shared = {"experiment", "config", "output", "seed", "skip_invalid", "complete", "allow_outside", "mark_end"}
    shared |= {"quiet", "verbose"}

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def run(**values: Any) -> Any:
            context = click.get_current_context()
            session = Session(context.find_root().info_name or "", values)
            result = function(session, **{key: value for key, value in values.items() if key not in shared})
            session.finish()
            return result

        for option in reversed(options):
            run = option(run)
        return run

    return decorate


def _apply_preset(presets: Mapping[str, Any], context: click.Context, _parameter: object, value: str | None) -> None:
    if value is not None:
        context.default_map = {**(context.default_map or {}), **presets[value]}
