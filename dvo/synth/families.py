"""Families of scenes: rooms, corridors, streets, outdoor clutter, table-tops, large planes.

A family is a function that lays out surfaces with a :class:`SceneBuilder` and says where a camera may fly and what it
may look at: add one to ``FAMILIES`` and to ``SHARES``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dvo.errors import DvoError
from dvo.synth.indoor import corridor, planes, room, tabletop
from dvo.synth.outdoor import clutter, street
from dvo.synth.scene import Scene
from dvo.synth.textures import TexturePool, texture_pool

FAMILIES: dict[str, Callable[[np.random.Generator, TexturePool], Scene]] = {
    "room": room, "corridor": corridor, "street": street, "clutter": clutter, "tabletop": tabletop, "planes": planes,
}  # fmt: skip
# Chance of each family in training clips.
SHARES = {"room": 0.28, "corridor": 0.12, "street": 0.26, "clutter": 0.18, "tabletop": 0.1, "planes": 0.06}


def random_scene(seed: int, family: str | None = None, *, pool: TexturePool | None = None) -> Scene:
    """Draw a scene.

    Args:
        seed: same seed, same scene.
        family: one of ``FAMILIES``; drawn by ``SHARES`` if None.
        pool: textures; the pool of seed 0 if None.

    Raises:
        DvoError: no such family.
    """
    rng = np.random.default_rng([seed, 7101])
    drawn = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    name = family or drawn
    if name not in FAMILIES:
        raise DvoError(f"no scene family {name!r}", field="family", remedy=f"choose one of {', '.join(FAMILIES)}")
    return FAMILIES[name](rng, pool or texture_pool(0))
