"""Descriptor of places, fitted on renderings: ``python -m train places``.

Renders pictures of the families of scenes that training draws (never of the held-out ones), encodes them with the
network, and fits mean and projection of :class:`dvo.odometry.loops.place_descriptors.GridDescriptor`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.text import print_line
from dvo.core.threads import settle_threads
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import load_weights
from dvo.odometry.frames.front_end import encode_image
from dvo.odometry.loops.place_descriptors import SHIPPED, fit_grid, pool_cells, save_descriptor
from dvo.synth.scenes.families import SHARES
from dvo.synth.sequence import make_sequence

FIRST_SEED = 3_800_000_000
"""Of the sequences; those of clips, suites and benchmarks lie elsewhere."""
FRAMES, FPS, SIZE = 10, 0.8, (240, 320)


def rendered_pictures(scenes: int, seed: int = 0) -> Iterator[np.ndarray]:
    """Pictures of random scenes, ten of each, 1.25 s apart.

    Args:
        scenes: number of scenes of each family.
        seed: of the renderings.

    Returns:
        ``(H, W, 3)`` uint8 RGB, one by one.
    """
    number = FIRST_SEED + 100_000 * seed
    for _ in range(scenes):
        for family in SHARES:
            film = make_sequence(number, frames=FRAMES, fps=FPS, height=SIZE[0], width=SIZE[1], family=family)
            yield from (frame.image for frame in film)
            number += 1


def encoded(model: PatchVO, images: Iterator[np.ndarray]) -> Iterator[Tensor]:
    """Matching features of pictures.

    Args:
        model: the network.
        images: ``(H, W, 3)`` uint8 RGB.

    Returns:
        ``(1, 1, C, h, w)``, one by one.
    """
    for image in images:
        with torch.inference_mode():
            yield encode_image(model, image, torch.device("cpu")).matching


def main(arguments: list[str]) -> None:
    """``python -m train places [--weights small] [--out FILE]``.

    Raises:
        DvoError: weights of another architecture, a number out of range, or a file that cannot be written.
    """
    parser = OneLineParser(prog="python -m train places", description=__doc__.split("\n")[0])
    parser.add_argument("--weights", default="small", help="name or file (%(default)s)")
    parser.add_argument("--out", type=Path, default=SHIPPED, help="safetensors file (%(default)s)")
    parser.add_argument("--scenes", type=int, default=5, help="of each family (%(default)s)")
    parser.add_argument("--channels", type=int, default=32, help="kept of each cell (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    if given.scenes < 1:
        raise DvoError("must be 1 or more", field="--scenes", remedy="give a larger number")
    settle_threads()
    loaded = load_weights(given.weights)
    if not isinstance(loaded.model, PatchVO):
        raise DvoError(f"a {loaded.architecture}", file=given.weights, remedy="give weights of patch_vo")
    cells = [pool_cells(maps) for maps in encoded(loaded.model, rendered_pictures(given.scenes, given.seed))]
    fitted = fit_grid(np.stack(cells), given.channels)
    facts = {
        "content": "descriptor of places", "weights": loaded.name, "sha256": loaded.info.sha256 if loaded.info else "",
        "families": list(SHARES), "pictures": len(cells), "seed": given.seed,
    }  # fmt: skip
    save_descriptor(given.out, fitted, facts)
    print_line(f"{given.out}: {fitted.dimensions} numbers an image, fitted on {len(cells)} pictures")
