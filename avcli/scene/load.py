"""Where a scenario comes from: a built-in name, chance, a file, or a JSON object; and the changes that options make."""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avcli.formats import bounds
from avcli.formats.schema import DEEPEST, Invalid, refuse_depth
from avcli.scene import scenario, worlds
from avcli.scene.settings import BUILT_IN, SCENARIOS

RANDOM = "random"
"""The name that stands for a scenario made by chance."""


def load(
    source: str | os.PathLike | Mapping,
    *,
    seed: int = 0,
    people: int = 3,
    wishes: worlds.Wishes | None = None,
    duration: float | None = None,
    camera: str | None = None,
    camera_config: Mapping | None = None,
    camera_height: float | None = None,
) -> scenario.Scenario:
    """Load a scenario.

    Args:
        source: a built-in name ("s1"), "random", the path of a JSON file, or the JSON object itself.
        seed: of a random scenario.
        people: how many people a random scenario has.
        wishes: what else a random scenario has to be, instead of `people`.
        duration: s, instead of the scenario's own.
        camera, camera_config, camera_height: as `build` has them.

    Raises:
        ScenarioError: something in the scenario is wrong; the message says where and what.
        FileNotFoundError: neither a known name nor a file.
    """
    folder = Path()
    if isinstance(source, Mapping):
        raw, name = source, "scenario"
    elif source in (*BUILT_IN, RANDOM):
        raw, name = named(str(source), seed, wishes or worlds.Wishes(people), duration), str(source)
    else:
        path = Path(source)
        if not path.exists():
            raise FileNotFoundError(unknown(str(source)))
        raw, name, folder = decode(path.read_bytes(), str(source)), str(source), path.parent
    return build(
        raw, name, folder=folder, duration=duration, camera=camera, camera_config=camera_config,
        camera_height=camera_height,
    )  # fmt: skip


def unknown(source: str) -> str:
    """The sentence for a scenario that is neither a known name nor a file."""
    return f"{source}: no such file, and not one of the scenarios {', '.join((*BUILT_IN, RANDOM))}"


def named(name: str, seed: int, wishes: worlds.Wishes, duration: float | None = None) -> dict[str, Any]:
    """Return the JSON object of a built-in scenario, or make a random one (of 10 s where no duration is given)."""
    if name == RANDOM:
        generator = np.random.default_rng(seed)
        return worlds.random_world(wishes, 10.0 if duration is None else duration, generator, scenario.CAMERAS)
    return json.loads((SCENARIOS / f"{name}.json").read_bytes())


def decode(text: bytes, name: str) -> Any:
    """Decode a JSON file's text.

    Raises:
        ScenarioError: it is not JSON, or not UTF-8; the message begins with `name` and the place.
    """
    if len(text) > bounds.LARGEST_JSON_FILE:
        limit = bounds.LARGEST_JSON_FILE >> 20
        raise scenario.ScenarioError(f"{name}: longer than {limit} MiB, which is not a scenario")
    try:
        raw = json.loads(text)
        refuse_depth(raw)
        return raw
    except (Invalid, RecursionError):  # the latter from json, which calls itself for each list in a list
        reason = f"has lists or objects more than {DEEPEST} deep inside one another"
        raise scenario.ScenarioError(f"{name}: {reason}") from None
    except json.JSONDecodeError as error:
        raise scenario.ScenarioError(f"{name}:{error.lineno}:{error.colno}: invalid JSON: {error.msg}") from None
    except UnicodeDecodeError as error:
        raise scenario.ScenarioError(f"{name}: invalid UTF-8 at byte {error.start}") from None


def build(
    raw: Any,
    name: str,
    *,
    folder: Path = Path(),
    duration: float | None = None,
    camera: str | None = None,
    camera_config: Mapping | None = None,
    camera_height: float | None = None,
) -> scenario.Scenario:
    """Change what the options ask for in a scenario's JSON object, and build the scenario.

    Args:
        raw: the decoded JSON object.
        name: of the scenario or its file, for messages.
        folder: that paths of meshes are relative to.
        duration: s, instead of the scenario's own.
        camera: "real" or "thesis": one of the thesis's two lenses instead of the scenario's.
        camera_config: a camera_config, or an object that holds one: that camera instead of the scenario's.
        camera_height: m, instead of the scenario's.

    Raises:
        ScenarioError: something is wrong; the message says where and what.
    """
    if isinstance(raw, Mapping):  # else `parse` says what is wrong
        if duration is not None:
            raw = {**raw, "duration_s": duration}
        if camera is not None:
            raw = scenario.with_camera(raw, scenario.CAMERAS[camera])
        if camera_config is not None:
            raw = scenario.with_camera(raw, camera_config)
        if camera_height is not None:
            raw = scenario.at_height(raw, camera_height)
    return scenario.parse(raw, name, _mesh_loader(folder))


def _mesh_loader(folder: Path) -> Callable[[str], np.ndarray]:
    """A function that reads the triangles (n, 3, 3) of a mesh file, whose path is relative to the folder."""

    def load_mesh(path: str) -> np.ndarray:
        import trimesh

        if not (folder / path).is_file():
            raise ValueError(f"{path}: no such file")
        try:
            mesh = trimesh.load_mesh(folder / path, process=False)
        except Exception as error:  # each of trimesh's readers has its own
            raise ValueError(f"{path}: not a mesh that can be read: {error}") from None
        return getattr(mesh, "triangles", np.zeros((0, 3, 3)))

    return load_mesh
