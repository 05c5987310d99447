"""Reader of map files: maps that are loaded, give their result and take a new recording; and graphs alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from tests.fuzz import text
from tests.fuzz.mutations import mutate_folder
from tests.fuzz.readers_models import MODULES, ODD, _network
from tests.fuzz.target import Target, require

SETTINGS = {
    "pixels": 96 * 72, "patches": 6, "lifetime": 4, "removal": 5, "optimisation": 4, "initial_frames": 5,
    "initial_updates": 3, "final_updates": 1, "initial_motion": 0.0, "initial_parallax": 0.0, "keyframe_motion": 0.0,
    "lost_confidence": 0.0, "min_inliers": 0.0, "search_inliers": 0.0, "join_inliers": 0.0, "initial_inliers": 0.0,
    "search_updates": 1,
}  # fmt: skip
WIDTH, HEIGHT, COUNT = 96, 72, 10
OLD = Path(__file__).parent.parent / "odometry" / "patch" / "version_2.dvo"


def _frames() -> list[Frame]:
    wall = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH + 4 * COUNT + 8, 3), dtype=np.uint8)
    camera = Camera(80.0, 80.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    return [Frame(i, 0.1 * i, np.ascontiguousarray(wall[:, 4 * i : 4 * i + WIDTH]), camera) for i in range(COUNT + 2)]


def _build(folder: Path, finished: bool = True) -> None:
    """The map of a short sequence."""
    from dvo.odometry.load import load

    odometry: Any = load("small", **SETTINGS)
    for frame in _frames()[:COUNT]:
        odometry.track(frame)
    if finished:
        odometry.finish()
    odometry.save(folder / "a.dvo")


def _build_in_progress(folder: Path) -> None:
    _build(folder, finished=False)


def _read(folder: Path, random: np.random.Generator | None) -> None:
    """Load, and use everything that was loaded: a file that is accepted must not fail later."""
    from dvo.map.io.serialisation import load_graph
    from dvo.odometry.load_map import load_map

    file = folder / "a.dvo"
    graph = load_graph(file)
    require(np.isfinite(graph.log.trajectory().poses_wc).all(), "poses that are not finite")
    odometry = load_map(file)
    for keyframe in odometry.graph.archive:
        keyframe.image()
    odometry.current()
    odometry.save(folder / "out.dvo")
    odometry = load_map(folder / "out.dvo")
    for frame in _frames()[COUNT - 6 :]:  # as another recording
        odometry.track(frame)
    odometry.finish()
    odometry.graph.problem()
    odometry.save(folder / "out.dvo")
    load_map(folder / "out.dvo")


def _build_old(folder: Path) -> None:
    """A file of version 2, as if the network of these tests had made it."""
    from dvo.models.weights import tensor_digest
    from tests.support.saved_maps import rewritten

    file = folder / "a.dvo"
    file.write_bytes(OLD.read_bytes())
    rewritten(file, {"weights.digest": tensor_digest(_network("tiny"))}, {})


def _read_old(folder: Path, random: np.random.Generator | None) -> None:
    """Its network is too small to recognise a place, so that it takes no recording."""
    from dvo.map.io.serialisation import load_graph
    from dvo.models.weights import LoadedWeights
    from dvo.odometry.load_map import load_map

    weights = LoadedWeights.of(_network("tiny"), "tiny")
    load_graph(folder / "a.dvo")
    odometry = load_map(folder / "a.dvo", weights=weights)
    require(np.isfinite(odometry.finish().trajectory.poses_wc).all(), "poses that are not finite")
    odometry.graph.problem()
    odometry.save(folder / "out.dvo")
    load_map(folder / "out.dvo", weights=weights)


def mutate_map(folder: Path, random: np.random.Generator) -> str:
    """Change a map file; mostly what is in it, with its check sums made right.

    Args:
        folder: of the input.
        random: source of all choices.

    Returns:
        Description of the change.
    """
    if random.random() < 0.25:
        return mutate_folder(folder, random)
    from dvo.map.io.map_file import open_map_file, write_map_file

    file = folder / "a.dvo"
    with open_map_file(file) as source, np.load(file) as held:
        description = source.description
        arrays = {name.removesuffix(".npy"): held[name] for name in held.files if name != "map.json"}
    if random.random() < 0.4:
        said = _mutate_description(description, folder, random)
    else:
        name = sorted(arrays)[int(random.integers(len(arrays)))]
        said = f"{name}: {_mutate_array(arrays, name, random)}"
    write_map_file(file, description, arrays)
    return said


def _mutate_description(description: dict[str, Any], folder: Path, random: np.random.Generator) -> str:
    """Change one value of the description, or its text."""
    if random.random() < 0.3:
        part = folder / "part.json"
        part.write_text(json.dumps(description), encoding="utf-8")
        said = text.MUTATIONS[int(random.integers(5))](part, random)
        try:
            found = json.loads(part.read_bytes().decode("utf-8", errors="replace"))
            json.dumps(found, allow_nan=False)
        except (ValueError, OSError):
            found = {}
        part.unlink(missing_ok=True)
        description.clear()
        description |= found if isinstance(found, dict) else {"graph": found}
        return f"text: {said}"
    inner, said = description, ""
    while True:
        key = list(inner)[int(random.integers(len(inner)))]
        said += f".{key}"
        if not isinstance(inner[key], dict) or not inner[key] or random.random() < 0.1:
            break
        inner = inner[key]
    odd = [one for one in ODD if not isinstance(one, (bytes, tuple)) and one == one]
    odd += [0, 1, 2, 5, 2**31, -0.5, 1e12, 1e300, False, [[0, 1]], [1, 2], "\ud800", 99.0]
    value = inner[key]
    if isinstance(value, (int, float)) and not isinstance(value, bool) and random.random() < 0.5:
        odd = [value + 1, value - 1, value * 2, -value, value * 1000]
    inner[key] = odd[int(random.integers(len(odd)))]
    return f"{said} is {str(inner[key])[:40]!r}"


def _mutate_array(arrays: dict[str, np.ndarray], name: str, random: np.random.Generator) -> str:
    """Change the values, the shape or the type of an array, or take it out."""
    array = arrays[name].copy()
    kind = int(random.integers(8))
    if kind == 0:
        del arrays[name]
        return "removed"
    if kind == 1:
        arrays[name] = array[: int(random.integers(len(array) + 1))] if array.ndim else array[None]
        return f"{len(arrays[name])} rows"
    if kind == 2:
        arrays[name] = array.astype([np.float32, np.float64, np.int64, np.uint8, np.complex64][int(random.integers(5))])
        return f"of the type {arrays[name].dtype}"
    if kind == 3:
        arrays[name] = [array[None], array.reshape(-1), np.repeat(array, 2, -1), array.T][int(random.integers(4))]
        return f"of the shape {arrays[name].shape}"
    flat = array.reshape(-1)
    if not flat.size:
        arrays[name] = np.zeros((1, *array.shape[1:]), array.dtype)
        return "one row"
    some = random.integers(flat.size, size=1 if random.random() < 0.5 else min(flat.size, 20))
    values = [0, -1, 1, 2, 7, 100, -1000, 2**15 - 1, 2**31 - 1, 1e6, 1e9, 1e30, 1e-30, np.nan, np.inf, 0.5]
    value = values[int(random.integers(len(values)))]
    with np.errstate(all="ignore"):
        if kind == 4:
            flat[:] = np.float64(value).astype(array.dtype)
            said = f"all {value}"
        elif kind == 5:
            flat[some] += np.float64(value).astype(array.dtype)
            said = f"{len(some)} numbers plus {value}"
        else:
            flat[some] = np.float64(value).astype(array.dtype)
            said = f"{len(some)} numbers {value}"
    arrays[name] = array
    return said


ALL = (*MODULES, "dvo.odometry.load_map", "dvo.map.io.serialisation")
TARGETS = (
    Target("map", _build, _read, mutate_map, ALL),
    Target("map_in_progress", _build_in_progress, _read, mutate_map, ALL),
    Target("map_old", _build_old, _read_old, mutate_map, ALL),
)
