"""Gathering the views of a board from many pictures, and what became of each picture."""

import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from avcli.calibration import corners, recognise
from avcli.calibration.circle import Light
from avcli.calibration.corners import View
from avcli.calibration.fit import NoFit
from avcli.calibration.pyramid import Pyramid
from avcli.calibration.recognise import Wanted
from avcli.calibration.target import Board
from avcli.formats.footage import Picture
from avcli.formats.media import MediaError

_THREADS = 4
"""Pictures that are searched at once for markers or circles, which OpenCV does without Python's lock. The search for
checkerboards holds the lock: several at once would cost a quarter more."""
_MISSES = 4
"""Pictures without a board that are kept, to guess another board's size from."""
_GUESS_AFTER = (4, 12)
"""Numbers of pictures after which another size of the board is tried. Fewer in all: after the last."""

_SELDOM = 8
"""Where the first pictures show no board that is known, one is looked for in every eighth of the others alone. Once it
is recognised, it is searched in the pictures between them too. Where a board is known and none was found, only every
eighth picture is searched thoroughly. So a folder without a board costs no more than one with boards."""
_THOROUGH = 2
"""Pictures that are looked at thoroughly while none before them shows a board."""
_NAMED = 5
"""Pictures that a message names before it counts the others."""

Found = View | Board | None
"""The view of the board in a picture; as long as the board is unknown, the board that it shows."""
Look = tuple[Picture, Pyramid, Found]
"""A picture, the same in grey, and what was found in it."""


class Seen:
    """What became of each picture, in order.

    Attributes:
        board: the board that was looked for; the usual one as long as it is unknown.
        is_known: whether the board is known.
        views: those that can be used.
        names: what the picture of each of them is called.
        misses: some pictures without a board, reduced.
        size: (width, height) px of the pictures; None before the first. See `settle_size`.
        samples: of each size (width, height) the first picture with a board, (height, width) uint8.
        lights: of each size the mean of its pictures, which shows where light reaches them.
    """

    def __init__(self, board: Board, *, is_known: bool = True):
        self.board, self.is_known = board, is_known
        self.views: list[View] = []
        self.names: list[str] = []
        self.misses: list[Pyramid] = []
        self.size: tuple[int, int] | None = None
        self.samples: dict[tuple[int, int], np.ndarray] = {}
        self.lights: dict[tuple[int, int], Light] = {}
        self._pictures: list[dict] = []

    def __len__(self) -> int:
        """Count the pictures."""
        return len(self._pictures)

    def take(self, name: str, timestamp: float, picture: Pyramid, view: View | None, why: str | None = None) -> None:
        """Add a picture and the view in it, which is left out if there is a reason `why`."""
        size = picture.grey.shape[1], picture.grey.shape[0]
        self.size = self.size or size
        self.lights.setdefault(size, Light()).take(picture)
        if view is None:
            why = "no board"
            if len(self.misses) < _MISSES:
                self.misses.append(corners.shrunk(picture))
        elif why is None and is_duplicate(view, self.views):
            why = "duplicate"
        elif why is None:
            self.views.append(view)
            self.names.append(name)
            self.samples.setdefault(size, picture.grey)
        index = None if why else len(self.views) - 1
        self._pictures.append({"timestamp": timestamp, "picture": name, "why": why, "view": index, "size": size})

    def settle_size(self, wanted: tuple[int, int] | None = None) -> list[str]:
        """Leave out the pictures that do not have the size of most views (of most pictures where there is no view).

        Args:
            wanted: width and height in px of a known camera, which are kept if any picture has them.

        Returns:
            what is left out, in sentences without a full stop.
        """
        every = [picture["size"] for picture in self._pictures]
        counted = [(view.width, view.height) for view in self.views] or every
        if not every:
            return []
        here = wanted if wanted and wanted in every else Counter(counted).most_common(1)[0][0]
        self.size = here
        said = []
        for size in dict.fromkeys(every):
            if size == here:
                continue
            others = [picture for picture in self._pictures if picture["size"] == size]
            for picture in others:
                picture["why"], picture["view"] = "another size", None
            names = [picture["picture"] for picture in others]
            some = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
            turned = ", as if turned by 90 degrees" if size == here[::-1] else ""
            said.append(
                f"left out: {some}: {size[0]} × {size[1]} px{turned}; a lens is found from pictures of one size, here "
                f"{here[0]} × {here[1]} px"
            )
        if said:
            self._renumber()
        return said

    def _renumber(self) -> None:
        """Keep the views of the chosen size alone."""
        kept = [i for i, view in enumerate(self.views) if (view.width, view.height) == self.size]
        places = {old: new for new, old in enumerate(kept)}
        self.views, self.names = [self.views[i] for i in kept], [self.names[i] for i in kept]
        for picture in self._pictures:
            picture["view"] = places.get(picture["view"])

    @property
    def sample(self) -> np.ndarray | None:
        """A picture with the board, (height, width) uint8; None before the first."""
        return self.samples.get(self.size) if self.size else None

    @property
    def light(self) -> Light:
        """The mean of the pictures of the chosen size."""
        return self.lights.get(self.size, Light()) if self.size else Light()

    def count(self, why: str) -> int:
        """Count the pictures left out for a reason: "no board", "another size", "duplicate", "moving" or "blurred"."""
        return sum(picture["why"] == why for picture in self._pictures)

    @property
    def last_view(self) -> View | None:
        """The view in the last picture."""
        index = self._pictures[-1]["view"] if self._pictures else None
        return None if index is None else self.views[index]

    @property
    def few(self) -> bool:
        """Whether the board was found so seldom that it may have another size."""
        return bool(self._pictures) and self.count("no board") > 0.7 * len(self)

    def require_views(self) -> None:
        """Check that a picture shows the board.

        Raises:
            NoFit: none does; the message says what may be wrong.
        """
        if self.views:
            return
        if not len(self):
            raise NoFit("there are no pictures in the sources")
        if unsteady := self.count("moving") + self.count("blurred"):
            raise NoFit(
                f"{unsteady} of the {len(self)} pictures show the board, but it moves in all of them; hold it still "
                "for a moment at each place, and send pictures no faster than they were taken"
            )
        board, none = self.board, f"none of the {len(self)} pictures shows"
        conditions = "must be sharp, evenly lit and wholly inside the picture, with a white border as wide as a square"
        if not self.is_known:
            raise NoFit(f"{none} a whole board that is known; it {conditions}; --kind and --board say what to look for")
        if board.markers:
            raise NoFit(f"{none} six corners of the {board.words}; check it, and that the pictures are not mirrored")
        if board.has_circles:
            raise NoFit(f"{none} the whole {board.words}; it {conditions}")
        raise NoFit(
            f"{none} a whole board of {board} squares ({board.inner[0]}x{board.inner[1]} inner corners); the board "
            f"{conditions}"
        )

    def forget(self, count: int) -> None:
        """Take back the last pictures, none of which has a view."""
        del self._pictures[len(self._pictures) - count :]

    def records(
        self, kept: np.ndarray | None = None, rms_px: np.ndarray | None = None, dropped: np.ndarray | None = None
    ) -> Iterator[dict]:
        """Yield a record for each picture; one that shows the board has its corners.

        Args:
            kept: (views,) bool, which views the fit used; None: there is no fit.
            rms_px: (views,) residual of each view.
            dropped: (views,) how many of its corners the fit did not use.
        """
        for number, picture in enumerate(self._pictures):
            row = {"timestamp": picture["timestamp"], "frame_number": number, "picture": picture["picture"]}
            index, why, used = picture["view"], picture["why"], False
            if index is not None:
                view, why = self.views[index], "no fit"
                row["corner_ids"], row["corners_px"] = view.ids, view.pixels
                if view.blur is not None:
                    row["blur_px"], row["smear_px"] = view.blur.least_px, view.blur.smear_px
                if dropped is not None:
                    row["corners_dropped"] = int(dropped[index])
                if kept is not None and rms_px is not None:
                    used = bool(kept[index])
                    row["rms_px"] = float(rms_px[index])
                    why = None if used else "does not fit"
            yield {**row, "kept": used, "why": why}


def is_duplicate(view: View, others: list[View], motion_px: float = 1.0) -> bool:
    """Tell whether a board stood where it stood in one of the others: its corners moved less than `motion_px` (RMS)."""
    # Whose corners are the same ones did not move less than their mean: few others are left to be compared.
    (x, y), run, far = view.middle, view.run, motion_px
    others = [
        other
        for other in others
        if other.run != run or not run[1] or (abs(other.middle[0] - x) < far and abs(other.middle[1] - y) < far)
    ]
    if not others:
        return False
    counts = np.array([len(other.ids) for other in others])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    ids = np.concatenate([other.ids for other in others])
    pixels = np.concatenate([other.pixels for other in others])
    mine = np.full((max(int(ids.max()), int(view.ids.max())) + 1, 2), np.nan)
    mine[view.ids] = view.pixels
    moved = ((mine[ids] - pixels) ** 2).sum(1)
    common = np.add.reduceat(np.isfinite(moved).astype(int), starts)
    total = np.add.reduceat(np.nan_to_num(moved), starts)
    if ((2 * common > np.maximum(counts, len(view.ids))) & (total < common * motion_px**2)).any():
        return True
    alike = np.repeat(counts == len(view.ids), counts)  # a board may be read turned by 180 degrees
    turned = ((pixels[alike].reshape(-1, len(view.ids), 2) - view.pixels[::-1]) ** 2).sum(2).mean(1)
    return bool((turned < motion_px**2).any())


def collect(
    pictures: Iterable[Picture | np.ndarray],
    board: Board | Wanted,
    *,
    thorough: bool = True,
    eager: bool = False,
    size: tuple[int, int] | None = None,
    say: Callable[[str], None] = lambda _: None,
    reason: Callable[[Seen, Picture, View | None], str | None] = lambda *_: None,
    after: Callable[[Seen, np.ndarray, View | None], bool] = lambda *_: False,
) -> Seen:
    """Look for the board in all pictures.

    If hardly any of the first pictures shows the board, another size is tried: people often count inner corners instead
    of squares. If that one is found, the search continues with it.

    Args:
        pictures: pictures, or arrays (height, width[, 3 RGB or 4 RGBA]).
        board: what they are expected to show; what is unknown of it is read from the first pictures that show it.
        thorough: see corners.find.
        eager: look at each picture before the next one is asked for, as hints while filming need it.
        size: width and height in px of the camera, if it is known; otherwise the size of most pictures is taken.
        say: gets sentences for the user, such as which pictures have another size and are left out.
        reason: is called with what was seen before, each picture and its view; why the view is left out, or None.
        after: is called after each picture with what was seen, the grey picture (height, width) uint8 and its view;
            True ends the search.

    Raises:
        MediaError: the source fails before any picture shows the board.
    """
    search = _Search.of(board, thorough, eager, say, reason)
    try:
        for picture, grey, found in search.look_ahead(pictures):
            view = search.take(picture, grey, found)
            if after(search.seen, grey.grey, view):
                break
    except MediaError as error:
        if not search.seen.views:
            raise
        say(f"{error}; the calibration continues with the pictures before it")
    search.end()
    for words in search.seen.settle_size(size):
        say(words)
    return search.seen


@dataclass
class _Search:
    """A search for a board whose size may be corrected on the way.

    Attributes:
        seen: so far.
        thorough, eager, say, reason: see `collect`.
        wanted: what was known of the board before; None where it was given.
        first: the pictures so far, while another board may still be tried.
        shown: the boards that pictures show, while the board is unknown.
        rows: that they show together.
        passed: pictures that were not looked at while the board is unknown, the last ones.
        not_looked: how many there are.
        guessed: how many of `seen.misses` another size was guessed from.
    """

    seen: Seen
    thorough: bool
    eager: bool
    say: Callable[[str], None]
    reason: Callable[[Seen, Picture, View | None], str | None]
    wanted: Wanted | None = None
    first: list[Picture] = field(default_factory=list)
    shown: list[Board] = field(default_factory=list)
    rows: int = 0
    passed: list[Picture] = field(default_factory=list)
    not_looked: int = 0
    guessed: int = 0

    @staticmethod
    def _is_passed(number: int) -> bool:
        """Whether a picture is not looked at while the board is unknown."""
        return number >= _GUESS_AFTER[0] and number % _SELDOM != 0

    @classmethod
    def of(
        cls,
        board: Board | Wanted,
        thorough: bool,
        eager: bool,
        say: Callable[[str], None],
        reason: Callable[[Seen, Picture, View | None], str | None],
    ) -> "_Search":
        """Begin a search; what is wanted is recognised first where something is left open."""
        if isinstance(board, Board):
            return cls(Seen(board), thorough, eager, say, reason)
        return cls(Seen(board.board(), is_known=board.is_complete), thorough, eager, say, reason, board)

    @property
    def sought(self) -> Board | Wanted:
        """The board to look for, or what is known of it."""
        return self.seen.board if self.seen.is_known or self.wanted is None else self.wanted

    def take(self, picture: Picture, grey: Pyramid, found: Found) -> View | None:
        """Add a picture and return the view in it; after some of them, recognise the board or try another size."""
        view = found if isinstance(found, View) else None
        known = self.seen.is_known
        if view is not None and not self.seen.views:
            self.look_again()
        self._add(picture, grey, view)
        if not known:
            self.first = [*self.first[1 - _GUESS_AFTER[-1] :], picture]
            if self._is_passed(len(self.seen) - 1):
                self.not_looked += 1
                self.passed = [*self.passed[1 - _GUESS_AFTER[-1] :], picture]
            if isinstance(found, Board):
                self.shown.append(found)
                self.recognise()
        else:
            if len(self.seen) <= _GUESS_AFTER[-1]:
                self.first.append(picture)
            if len(self.seen) in _GUESS_AFTER:
                self.try_another_size()
            if len(self.seen) == _GUESS_AFTER[-1]:
                self.first = []
        return view if known else self.seen.last_view

    def _add(self, picture: Picture, grey: Pyramid, view: View | None) -> None:
        self.seen.take(picture.name, picture.timestamp, grey, view, self.reason(self.seen, picture, view))

    def recognise(self, *, at_last: bool = False) -> None:
        """As soon as pictures agree on a board, look for it in those that are at hand, and continue with it."""
        board = recognise.agreed(self.shown, at_last=at_last)
        if board is None or self.wanted is None:
            return
        if not board.markers:
            self._refuse_mirrored()
        given = self.wanted.size
        if board.markers and given and given[0] != board.columns:
            self.say(f"the board is given as {given[0]}x{given[1]}, but the pictures show {board.columns} columns")
            self.wanted = replace(self.wanted, size=None)
        known = self.wanted.board(board)
        self.seen.forget(len(self.first))
        self.seen.board, self.seen.is_known = self.wanted.searched(board), True
        for picture in self.first:
            self._add(picture, *self._again(picture))
        if self.wanted.size is None or known.kind != "checkerboard":
            self.say(f"the pictures show {_with_article(known.words)}; --kind and --board fix another one")
        self.rows = known.rows
        if len(self.seen) > _GUESS_AFTER[-1]:
            self.first = []

    def _refuse_mirrored(self) -> None:
        """Check that the first pictures show no board with markers in a mirror, as some cameras deliver them.

        Raises:
            NoFit: one does. Its markers read as blobs, and their mirror image as a board.
        """
        if self.wanted is None:
            return
        for picture in self.first[-2:]:
            if board := recognise.look_in_mirror(corners.to_grey(picture.image), self.wanted):
                raise NoFit(
                    f"{picture.name} is mirrored: its mirror image shows {_with_article(board.words)}; switch the "
                    "camera's mirroring off, or mirror the pictures back"
                )

    def end(self) -> None:
        """After the last picture: recognise or try with what there is, and settle how many rows the board has."""
        if not self.seen.is_known:
            if self.shown and self.wanted:  # the pictures between those that were looked at may show it too
                looked = [recognise.look(corners.to_grey(picture.image), self.wanted) for picture in self.passed]
                self.shown += [board for board in looked if board]
            self.recognise(at_last=len(self.seen) <= _GUESS_AFTER[0])
            if not self.seen.is_known:
                self._refuse_mirrored()
            if not self.seen.is_known and self.not_looked:
                self.say(
                    f"the first {_GUESS_AFTER[0]} pictures show no board that is known; of the others every "
                    f"{_SELDOM}th was looked at, {self.not_looked} were not (--kind and --board search them all)"
                )
        else:
            self.try_another_size()
        seen = self.seen
        if self.wanted is not None and self.wanted.size is None and seen.board.markers and seen.views:
            seen.board = recognise.trimmed(seen.board, seen.views)
            seen.views = [recognise.within(view, seen.board) for view in seen.views]
            if seen.board.rows != self.rows:
                self.say(f"with all pictures it is {_with_article(seen.board.words)}")

    def look_again(self) -> None:
        """Once a picture shows the board, look thoroughly at those before it, of which most were looked at quickly."""
        if self.thorough and _THOROUGH < len(self.first) == len(self.seen):
            self.seen.forget(len(self.first))
            for picture in self.first:
                self._add(picture, *self._again(picture))

    def try_another_size(self) -> None:
        """If hardly any of the first pictures shows the board, look in them for one of the size that they show."""
        given = self.seen.board
        misses = len(self.seen.misses)
        if not self.first or given.kind != "checkerboard" or not self.seen.few or misses == self.guessed:
            return
        self.guessed = misses
        other = corners.guess_board(self.seen.misses, given)
        if other is None:
            return
        again = Seen(other)
        for picture in self.first:
            again.take(picture.name, picture.timestamp, *self._again(picture, other))
        if len(again.views) < len(self.seen.views):
            return
        self.seen, self.first = again, []
        self.say(
            f"a board of {given} squares has {given.inner[0]}x{given.inner[1]} inner corners, but the pictures show "
            f"{other.inner[0]}x{other.inner[1]}; continuing with a board of {other} squares"
        )

    def _again(self, picture: Picture, board: Board | None = None) -> tuple[Pyramid, View | None]:
        grey = Pyramid(corners.to_grey(picture.image))
        return grey, corners.find(grey, board or self.seen.board, thorough=self.thorough)

    def is_thorough(self, number: int) -> bool:
        """Whether to look at a picture thoroughly: seldom where none before it showed a board."""
        if not self.seen.is_known:
            return number < _THOROUGH
        return self.thorough and (bool(self.seen.views) or number < _THOROUGH or number % _SELDOM == 0)

    def is_likely(self, number: int) -> bool:
        """Whether a picture is likely to show the board: one before it does, or it is one of the first."""
        return bool(self.seen.views) or number < _GUESS_AFTER[0]

    @property
    def at_once(self) -> int:
        """How many pictures to look at at once."""
        sought = self.sought
        return 1 if isinstance(sought, Board) and sought.kind == "checkerboard" else _THREADS

    def look_ahead(self, pictures: Iterable[Picture | np.ndarray]) -> Iterator[Look]:
        """Yield what is seen in each picture, in order; threads look at pictures while the next ones are read.

        The board may change on the way.
        """
        waiting: deque[tuple[Picture, Board | Wanted, Future]] = deque()

        def oldest() -> Look:
            picture, board, found = waiting.popleft()
            current, number = self.sought, len(self.seen)
            if board is current:
                return picture, *found.result()
            return picture, *look(picture.image, current, self.is_thorough(number), self.is_likely(number))

        with ThreadPoolExecutor(min(self.at_once, os.cpu_count() or 1)) as pool:
            failure = None
            try:
                try:
                    for number, item in enumerate(pictures):
                        picture = (
                            item if isinstance(item, Picture) else Picture(f"picture {number}", float(number), item)
                        )
                        while len(waiting) >= self.at_once:
                            yield oldest()
                        board = self.sought
                        rest = isinstance(board, Wanted) and self._is_passed(number)
                        how = self.is_thorough(number), self.is_likely(number)
                        seen = pool.submit(look, picture.image, None if rest else board, *how)
                        waiting.append((picture, board, seen))
                        if self.eager:
                            yield oldest()
                except MediaError as error:  # what came before is still good
                    failure = error
                while waiting:
                    yield oldest()
            finally:
                for _, _, found in waiting:
                    found.cancel()
            if failure:
                raise failure


def look(image: np.ndarray, board: Board | Wanted | None, thorough: bool, likely: bool) -> tuple[Pyramid, Found]:
    """Look at a picture as a camera gives it: the picture in grey, and the view of the board, or the board it shows."""
    grey = Pyramid(corners.to_grey(image))
    if board is None:
        return grey, None
    if isinstance(board, Wanted):
        return grey, recognise.look(grey, board, thorough=thorough)
    return grey, corners.find(grey, board, thorough=thorough, likely=likely)


def _with_article(words: str) -> str:
    return f"{'an' if words[0] in 'Aa' else 'a'} {words}"
