"""What ordinary footage shows beside a rigid scene: water, clouds, leaves, people, a bonnet, rain on the lens.

Each is drawn over a rendered image, by its depth and pose, and has a motion of its own or none: the pixels that it
covers have no rigid truth, as those of moving bodies. Everything is a function of seed and time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.core.settings import shown
from dvo.geometry.camera import Camera
from dvo.synth import salts
from dvo.synth.surroundings.canvas import Canvas, Drawing, Style
from dvo.synth.surroundings.landscape import crowd, foliage, night, screen, sky, traffic, water
from dvo.synth.surroundings.lens import bonnet, border, glass, rain, snow

Array = np.ndarray

SURROUNDINGS: dict[str, Callable[[np.random.Generator, Array, Style], Drawing]] = {
    "water": water, "sky": sky, "foliage": foliage, "crowd": crowd, "bonnet": bonnet, "rain": rain,
    "traffic": traffic, "snow": snow, "border": border, "glass": glass, "screen": screen, "night": night,
}  # fmt: skip
"""Drawings by name, of a random stream, the middle of the way of the camera ``(3,)`` and a style."""


def check_surroundings(names: str) -> None:
    """Reject names that are not known.

    Args:
        names: joined by ``+``.

    Raises:
        DvoError: an unknown name, or not a text.
    """
    for name in names.split("+") if isinstance(names, str) and names else [names] if names != "" else []:
        if name not in SURROUNDINGS:
            known = ", ".join(SURROUNDINGS)
            raise DvoError(f"no surroundings {shown(name)}", field="surroundings", remedy=f"use {known}, joined by +")


def drawings(names: str, seed: int, centre: Array, style: Style | None = None) -> tuple[Drawing, ...]:
    """Drawings of names.

    Args:
        names: joined by ``+``, see :func:`check_surroundings`.
        seed: same seed, same picture at every time.
        centre: ``(3,)`` middle of the way of the camera.
        style: of textures and outlines; that of sequences if None.
    """
    return tuple(
        SURROUNDINGS[name](np.random.default_rng([seed, salts.SURROUNDINGS, number]), centre, style or Style())
        for number, name in enumerate(filter(None, names.split("+")))
    )


def draw_over(
    surroundings: Sequence[Drawing], image: Tensor, depth: Tensor, pose_wc: Array, camera: Camera, time: float
) -> tuple[Tensor, Array]:
    """Draw surroundings over a rendered image.

    Args:
        surroundings: in the order in which they are drawn.
        image: ``(3, H, W)`` float RGB in [0, 1]; left as it is.
        depth: ``(H, W)`` along the optical axis, 0 for none.
        pose_wc: ``(7,)`` camera to world, z up.
        camera: intrinsics.
        time: seconds.

    Returns:
        ``(3, H, W)``, and the pixels ``(H, W)`` bool that they cover.
    """
    pixels = image.permute(1, 2, 0).cpu().double().numpy().copy()
    behind = depth.cpu().double().numpy()
    canvas = Canvas(pixels, np.where(behind > 0, behind, np.inf), pose_wc, camera, time)
    covered = np.zeros(behind.shape, bool)
    for draw in surroundings:
        covered |= draw(canvas)
    return torch.from_numpy(pixels.clip(0, 1)).permute(2, 0, 1).to(image), covered


__all__ = ["SURROUNDINGS", "Canvas", "Drawing", "Style", "check_surroundings", "draw_over", "drawings"]
