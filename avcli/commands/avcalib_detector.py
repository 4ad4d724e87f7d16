"""avcalib detector: a small network for one camera and room, from a film of them and a network that knows people."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avcli.commands.filter import GateNotMet, Session, common
from avcli.commands.options import from_settings, settings_from
from avcli.detection.settings import FEWEST, TeachingSettings

if TYPE_CHECKING:
    import numpy as np

    from avcli.detection import teaching
    from avcli.detection.view import View

_EXTRA = "learning needs torch and onnx: pip install 'avcli[train]'"


@click.command("detector", epilog="Example: avcalib detector film.mp4 --teacher yolox.onnx -o room.onnx")
@click.argument("sources", nargs=-1, required=True, metavar="SOURCE...")
@click.option(
    "--teacher", required=True, metavar="FILE", help="ONNX file of a YOLO export that knows people from photographs."
)
@from_settings(TeachingSettings)
@click.option(
    "--model", metavar="FILE", show_default="the package's own", help="ONNX file of this project, to begin with."
)
@click.option("--labels", metavar="DIR", help="Boxes made by hand, NAME.txt as YOLO writes them, to compare with too.")
@common(seed=True)
def detector_command(
    session: Session, sources: tuple[str, ...], teacher: str, model: str | None, labels: str | None, **values: Any
) -> None:
    """Teach the small detector one camera and room, from a film of them.

    The teacher says where people are in the film, and the small network learns it: use a film with people, and minutes
    without. Part of the film is held back, to calibrate the scores and to compare. The result goes to -o, for
    avdetect-video --model; nothing is written (exit 3) if the network knew as much before it learnt.
    """
    settings = settings_from(TeachingSettings, values)
    if session.output_path == "-":
        session.usage("-o/--output FILE is required: the result is a network")
    if labels and not Path(labels).is_dir():
        session.usage(f"--labels {labels}: no such folder")
    session.check_outputs({}, [*sources, teacher])
    try:
        import onnx  # noqa: F401
        import torch  # noqa: F401
    except ImportError:
        session.fail(_EXTRA)
    from avcli.formats.media import MediaError

    kept = Path(session.output_path + ".part")
    try:
        taught = _taught(session, sources, settings, (teacher, model, labels), kept)
    except (MediaError, ValueError) as error:
        session.fail(str(error))
    _say(session, taught)
    kept.unlink(missing_ok=True)
    if not taught.is_better:
        raise GateNotMet(
            f"{session.output_path} was not written: the network that began agrees with the teacher as well, "
            f"or nearly: the new one is better in {taught.surer:.0%} of resampled sets of the pictures held back"
        )
    with session.output() as write:
        write(taught.model)


def _taught(
    session: Session,
    sources: tuple[str, ...],
    settings: TeachingSettings,
    files: tuple[str, str | None, str | None],
    kept: Path,
) -> teaching.Taught:
    """Let the teacher look at the film, and the small network learn."""
    from avcli.detection import lessons, teaching
    from avcli.detection.network import Network, own_model
    from avcli.formats.media import read_bytes

    name, model, labels = files
    knowing = read_bytes(name)
    learner = own_model(floats=True) if model is None else read_bytes(model)
    pictures = _pictures(session, sources, settings.pictures)
    first, picture = next(pictures)
    size = picture.shape[1], picture.shape[0]
    network = Network(learner, picture=size)
    if network.head.kind != "points":
        session.usage("--model: not a network of this project; it cannot learn")
    key = teaching.key_of(knowing, learner, settings, session.seed, *sources, picture.tobytes())
    state = teaching.State.read(kept, key)
    if state.seen:
        session.warn(f"going on from {kept}: {len(state.seen)} pictures seen, step {_step(state)}")
    watcher = teaching.Teacher(knowing, size, settings, _view(session, size))
    taken: list[lessons.Lesson] = []
    for number, (path, shown) in enumerate(session.progress(chain([(first, picture)], pictures), label="teacher")):
        if shown.shape[1::-1] != size:
            session.fail(f"{path}: {shown.shape[1]} × {shown.shape[0]} px, but the first picture has {size}")
        lit = watcher.lit(shown)
        if number >= len(state.seen):
            state.seen.append(watcher.look(lit))
            if number % 50 == 49:
                state.write(kept)
        made = None if labels is None else _labels(Path(labels), path, size)
        taken.append(lessons.lesson(path, lit, state.seen[number], network.size, made))
    state.write(kept)
    people, empty = sum(len(one.people) for one in taken), sum(not len(one.people) for one in taken)
    session.warn(f"the teacher sees {people} people in {len(taken)} pictures, {empty} of which show nobody to it")

    def keep(now: teaching.State) -> None:
        if _step(now) % 25 == 0:
            now.write(kept)

    metadata = {"teacher": Path(name).name, "film": ", ".join(Path(one).name for one in sources)}
    metadata |= {"pictures": str(len(taken)), "steps": str(settings.steps)}
    steps = teaching.teach(learner, taken, settings, session.seed, state, keep, metadata)
    result: teaching.Taught | None = None
    for one in session.progress(steps, settings.steps + 1, label="learning"):
        if isinstance(one, teaching.Taught):
            result = one
        elif one % 100 == 0 and not session.shows_progress:
            session.warn(f"step {one} of {settings.steps}")
    assert result is not None
    return result


def _step(state: teaching.State) -> int:
    return state.progress.step if state.progress else 0


def _pictures(session: Session, sources: tuple[str, ...], most: int) -> Iterator[tuple[str, np.ndarray]]:
    """Names and pictures at equal steps through the film."""
    from avcli.formats import footage

    try:
        live = [one.name for one in footage.sources(sources) if one.is_live]
    except FileNotFoundError as error:
        session.usage(f"{error.filename}: {error.strerror}")
    names = footage.in_numbers(sources)
    count = None if live else footage.count_pictures(names)
    if count is None:
        session.usage(f"{(live or sources)[0]}: record a film first; it is read from its beginning to its end")
    if count < FEWEST:
        session.fail(f"the film has {count} pictures; {FEWEST} or more are needed")
    taken = min(most, count)
    wanted = {k * count // taken for k in range(taken)}
    for number, picture in enumerate(footage.pictures(names, say=session.warn)):
        if number in wanted:
            yield picture.name, picture.image[..., :3]


def _labels(folder: Path, path: str, size: tuple[int, int]) -> np.ndarray | None:
    """The boxes (m, 4) px that were made by hand for a picture; None if there is no file of its name."""
    import numpy as np

    file = folder / (Path(path).stem + ".txt")
    if not file.is_file():
        return None
    try:
        rows = np.array([line.split()[1:5] for line in file.read_text().splitlines() if line.strip()], float)
        rows = rows.reshape(-1, 4)
    except ValueError:
        raise ValueError(f"{file}: expected lines of five numbers: class, x, y, width, height in parts") from None
    return np.concatenate([rows[:, :2] - rows[:, 2:] / 2, rows[:, :2] + rows[:, 2:] / 2], axis=1) * np.tile(size, 2)


def _view(session: Session, size: tuple[int, int]) -> View | None:
    """The camera that config.json describes, where it was named."""
    from avcli.detection.view import View

    if not session.has_config:
        return None
    camera = session.config.camera
    if (camera.width_px, camera.height_px) != size:
        session.fail(f"{session.config.name}: camera_config has {camera.width_px} × {camera.height_px} px, not {size}")
    return View(camera.lens, camera.T_room_camera, size, camera.theta_max, circle=camera.circle)


def _say(session: Session, taught: teaching.Taught) -> None:
    """Say how far the networks agree with the teacher, and with labels."""
    for name, one in (("before", taught.before), ("after", taught.after)):
        empty = "" if one.false_empty is None else f", {one.false_empty:.2f} people in a picture where it sees nobody"
        session.warn(
            f"{name}: AP {one.ap:.2f} against the teacher on {taught.held_back} pictures held back; at score .5 "
            f"precision {one.precision:.2f}, recall {one.recall:.2f}{empty}"
        )
    session.warn("the pictures held back are of the same film; expect less in other films of the room")
    if taught.teacher_labels is not None:
        before, after = taught.before.ap_labels, taught.after.ap_labels
        teacher = taught.teacher_labels
        session.warn(f"against the labels: AP {before:.2f} before, {after:.2f} after, the teacher {teacher:.2f}")
