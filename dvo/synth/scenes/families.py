"""Families of scenes: rooms, corridors, streets, clutter, table-tops, large planes, terrain, forest; held-out ones.

A family is a function that lays out surfaces with a :class:`SceneBuilder` and says where a camera may fly and what it
may look at: add one to ``FAMILIES`` and to ``SHARES``. Those of ``HELD_OUT`` are made only when asked for by name, so
that suites can evaluate on kinds of scenes that training has never drawn.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dvo.errors import DvoError
from dvo.synth.scenes.held_out import courtyard, gallery, hall
from dvo.synth.scenes.indoor import corridor, planes, room, tabletop
from dvo.synth.scenes.landscape import forest, terrain
from dvo.synth.scenes.outdoor import clutter, street
from dvo.synth.scenes.scene import Scene
from dvo.synth.textures.pool import TexturePool, texture_pool

FAMILIES: dict[str, Callable[[np.random.Generator, TexturePool], Scene]] = {
    "room": room, "corridor": corridor, "street": street, "clutter": clutter, "tabletop": tabletop, "planes": planes,
    "terrain": terrain, "forest": forest,
}  # fmt: skip
HELD_OUT: dict[str, Callable[[np.random.Generator, TexturePool], Scene]] = {
    "hall": hall, "courtyard": courtyard, "gallery": gallery,
}  # fmt: skip
# Chance of each family in training clips.
SHARES = {
    "room": 0.26, "corridor": 0.11, "street": 0.23, "clutter": 0.14, "tabletop": 0.08, "planes": 0.05,
    "terrain": 0.06, "forest": 0.07,
}  # fmt: skip


def random_scene(seed: int, family: str | None = None, *, pool: TexturePool | None = None) -> Scene:
    """Draw a scene.

    Args:
        seed: same seed, same scene.
        family: one of ``FAMILIES`` or ``HELD_OUT``; drawn from ``FAMILIES`` by ``SHARES`` if None.
        pool: textures; the pool of seed 0 if None.

    Raises:
        DvoError: no such family.
    """
    rng = np.random.default_rng([seed, 7101])
    drawn = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    name = family or drawn
    known = FAMILIES | HELD_OUT
    if name not in known:
        raise DvoError(f"no scene family {name!r}", field="family", remedy=f"choose one of {', '.join(known)}")
    return known[name](rng, pool or texture_pool(0))
