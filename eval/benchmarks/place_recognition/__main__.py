"""Recognition of places: `python -m eval.benchmarks.place_recognition` prints how often a place is found again.

Renders loops (the second round repeats the first up to the shake of the hand) and walks (which come back to a place
from another side) through scenes of held-out families. Every third frame is a keyframe (of walks, rendered at 5
frames/s, every frame). Keyframes at least 10 s older are candidates; a right one shares at least 30 % of the view by
the rendered depth. Three conditions:

- rendered: as they are.
- relit: the image that searches has another gamma, exposure, white balance, shading from left to right, and more noise.
- moved: candidates that share more than 60 % of the view are taken away.

Columns: right ones among the first 1, 3 and 5 candidates, and recall at 100 % precision by the score alone, in percent
of the keyframes that have a right candidate (a false one shares less than 1 %).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

import dvo
from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.threads import settle_threads
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import load_model
from dvo.odometry.frames.front_end import encode_image
from dvo.synth.sequence import make_sequence
from eval.benchmarks.place_recognition.methods import Method, fit_vlad, grid_method, orb_method, vlad_method
from eval.benchmarks.place_recognition.scoring import COUNTS, Recall, recall_of
from eval.scoring.overlap import depth_maps, shared_view
from eval.suites.rendered import rendered_folder
from eval.systems.peers.orbslam3 import vocabulary_file

OLDER = 10.0
"""Seconds between a keyframe and its candidates."""
MOVED = 0.6
"""Largest shared view of a candidate in the condition ``moved``."""
SIZE = {"height": 240, "width": 320, "speed": 1.0, "apart": True, "version": 1}
LOOP = {"kind": "loop", "frames": 900, "fps": 15}
WALK = {"kind": "handheld", "frames": 300, "fps": 5}
SEQUENCES: dict[str, tuple[dict[str, Any], int]] = {
    "hall loop": ({"seed": 3_700_000_000, "family": "hall", **LOOP}, 3),
    "courtyard loop": ({"seed": 3_700_000_001, "family": "courtyard", **LOOP}, 3),
    "gallery loop": ({"seed": 3_700_000_002, "family": "gallery", **LOOP}, 3),
    "hall walk": ({"seed": 3_700_000_100, "family": "hall", **WALK}, 1),
    "gallery walk": ({"seed": 3_700_000_101, "family": "gallery", **WALK}, 1),
}
"""Options of the rendering, and frames from one keyframe to the next."""


@dataclass(frozen=True)
class Places:
    """Keyframes of a sequence with their truth.

    Attributes:
        images: of the keyframes.
        shared: ``(N, N)`` shared view of a keyframe (row) with older ones.
        older: ``(N, N)`` bool.
    """

    images: list[np.ndarray]
    shared: np.ndarray
    older: np.ndarray


def read_places(name: str, frames: int | None = None) -> Places:
    """Keyframes of a sequence, rendered unless they are in the cache.

    Args:
        name: in :data:`SEQUENCES`.
        frames: of the sequence; None for all.
    """
    options, step = SEQUENCES[name]
    options = {**SIZE, **options}
    source = list(dvo.open(str(rendered_folder(name.replace(" ", "-"), options))))[:frames:step]
    sequence = make_sequence(**{key: value for key, value in options.items() if key != "version"})
    indices = np.arange(len(sequence))[:frames:step]
    times = sequence.groundtruth.timestamps[indices]
    older = times[None] <= times[:, None] - OLDER
    depth, intrinsics = depth_maps(sequence, indices)
    shared = shared_view(depth, intrinsics, sequence.groundtruth.poses_wc[indices], older)
    return Places([frame.image for frame in source], shared, older)


def relight(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Image in another light.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        rng: draws gamma, exposure, white balance, shading and noise.

    Returns:
        ``(H, W, 3)`` uint8.
    """
    bright = (image.astype(np.float32) / 255) ** rng.uniform(0.6, 1.6) * rng.uniform(0.5, 1.3)
    bright = bright * rng.uniform(0.9, 1.1, 3)
    bright = bright * np.linspace(1 - rng.uniform(-0.3, 0.3), 1, image.shape[1])[None, :, None]
    return (np.clip(bright + rng.normal(0, 0.02, image.shape), 0, 1) * 255).astype(np.uint8)


def measure(
    methods: list[Method], places: Places, model: PatchVO, apart: int, seed: int
) -> dict[str, dict[str, tuple[Recall, float, float]]]:
    """Recall of each method in each condition.

    Args:
        methods: to compare.
        places: keyframes of a sequence.
        model: network of the matching features.
        apart: see :func:`recall_of`.
        seed: of the other light.

    Returns:
        By method and condition: recall, milliseconds to describe and score a keyframe, bytes of one.
    """
    rng = np.random.default_rng([seed, 7703])
    device = torch.device("cpu")
    relit = [relight(image, rng) for image in places.images]
    with torch.inference_mode():
        maps = {kind: [encode_image(model, image, device).matching.half() for image in images]
                for kind, images in (("as it is", places.images), ("relit", relit))}  # fmt: skip
    found: dict[str, dict[str, tuple[Recall, float, float]]] = {}
    count = len(places.images)
    for method in methods:
        begin = time.process_time()
        entries = [method.describe(i, m.float()) for i, m in zip(places.images, maps["as it is"], strict=True)]
        scores = np.stack([method.score(entry, entries) for entry in entries])
        spent = 1e3 * (time.process_time() - begin) / count
        size = float(np.mean([method.size(entry) for entry in entries]))
        others = [method.describe(i, m.float()) for i, m in zip(relit, maps["relit"], strict=True)]
        lit = np.stack([method.score(entry, entries) for entry in others])
        near = places.older & (places.shared <= MOVED)
        found[method.name] = {
            "rendered": (recall_of(scores, places.shared, places.older, apart), spent, size),
            "relit": (recall_of(lit, places.shared, places.older, apart), spent, size),
            "moved": (recall_of(scores, places.shared, near, apart), spent, size),
        }
    return found


def report(methods: list[Method], found: dict[str, dict[str, dict[str, tuple[Recall, float, float]]]]) -> Iterator[str]:
    """Lines of the tables, in Markdown.

    Args:
        methods: in the order of the rows.
        found: by sequence, results of :func:`measure`.
    """
    names = list(found)
    first = methods[0].name
    for condition in ("rendered", "relit", "moved"):
        asked = [found[name][first][condition][0].queries for name in names]
        heads = [f"{name} ({count})" for name, count in zip(names, asked, strict=True)]
        yield f"\n| {condition} | {' | '.join(heads)} | mean |\n|---|{'---|' * (len(names) + 1)}"
        for method in methods:
            rows = [found[name][method.name][condition][0] for name in names]
            numbers = np.array([[*row.first, row.precise] for row in rows])
            cells = [" / ".join(f"{100 * x:.0f}" for x in row) for row in [*numbers, np.nanmean(numbers, 0)]]
            yield f"| {method.name} | {' | '.join(cells)} |"
    yield "\n| cost | ms a keyframe | bytes a keyframe | bytes shipped |\n|---|---|---|---|"
    for method in methods:
        spent = np.mean([found[name][method.name]["rendered"][1:] for name in names], axis=0)
        yield f"| {method.name} | {spent[0]:.2f} | {spent[1]:.0f} | {method.shipped} |"
    yield f"\ncells: right among the first {', '.join(map(str, COUNTS))} / at 100 % precision, percent"


def choose_methods(model: PatchVO, names: list[str], scenes: int) -> Iterator[Method]:
    """Methods by name.

    Args:
        model: network of the matching features.
        names: ``grid``, ``shifted``, ``vlad``, ``orb``.
        scenes: training scenes of each family for VLAD.
    """
    if "shifted" in names:
        yield grid_method(shifted=True)
    if "grid" in names:
        yield grid_method(shifted=False)
    if "vlad" in names:
        from train.places import encoded, rendered_pictures

        yield vlad_method(fit_vlad(encoded(model, rendered_pictures(scenes))))
    if "orb" in names:
        yield orb_method(vocabulary_file())


def main() -> None:
    """Entry point."""
    parser = OneLineParser(
        prog="python -m eval.benchmarks.place_recognition", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    kinds = ["shifted", "grid", "vlad", "orb"]
    parser.add_argument("--weights", default="small", help="name or file (%(default)s)")
    parser.add_argument("--methods", nargs="+", default=kinds, choices=kinds)
    parser.add_argument("--sequences", nargs="+", default=list(SEQUENCES), choices=list(SEQUENCES), metavar="NAME")
    parser.add_argument("--frames", type=int, help="of each sequence; default: all")
    parser.add_argument("--apart", type=int, default=0, help="numbers of two candidates differ by more (%(default)s)")
    parser.add_argument("--scenes", type=int, default=5, help="training scenes of each family for VLAD (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the other light")
    given = parser.parse_args()
    settle_threads()
    try:
        model = load_model(given.weights)
        if not isinstance(model, PatchVO):
            raise DvoError("not patch_vo", file=given.weights, field="--weights", remedy="give weights of patch_vo")
        methods = list(choose_methods(model, given.methods, given.scenes))
        found = {}
        for name in given.sequences:
            found[name] = measure(methods, read_places(name, given.frames), model, given.apart, given.seed)
        print("\n".join(report(methods, found)))
    except DvoError as error:
        raise SystemExit(f"error: {error}") from error


if __name__ == "__main__":
    main()
