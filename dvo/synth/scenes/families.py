"""Families of scenes by name.

A family is a function ``(rng, pool) -> Scene`` that lays out surfaces with a :class:`SceneBuilder` and states the
bounds of camera positions and the points of interest. To add one, write it in a file of its own and add a line to
``FAMILIES``, or register it from another package (entry points of the group ``dvo.scene_families``). A family is drawn
for training clips only if it has a share in ``SHARES``; the others are made only when they are named.
"""

from __future__ import annotations

import numpy as np

from dvo.core.context import use_threads
from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.synth import salts
from dvo.synth.scenes.scene import Scene
from dvo.synth.textures.texture import TexturePool, texture_pool

FAMILIES = Registry(
    "scene family",
    "dvo.scene_families",
    {
        "room": "dvo.synth.scenes.indoor:room",
        "corridor": "dvo.synth.scenes.indoor:corridor",
        "street": "dvo.synth.scenes.outdoor:street",
        "clutter": "dvo.synth.scenes.outdoor:clutter",
        "tabletop": "dvo.synth.scenes.indoor:tabletop",
        "planes": "dvo.synth.scenes.indoor:planes",
        "terrain": "dvo.synth.scenes.landscape:terrain",
        "forest": "dvo.synth.scenes.landscape:forest",
        "hall": "dvo.synth.scenes.held_out:hall",
        "courtyard": "dvo.synth.scenes.held_out:courtyard",
        "gallery": "dvo.synth.scenes.held_out:gallery",
    },
)
# Families that training never draws, so that suites evaluate on unseen kinds of scenes.
HELD_OUT = ("hall", "courtyard", "gallery")
# Probability of each family in training clips. A change of the table changes the scene of every seed.
SHARES = {
    "room": 0.26, "corridor": 0.11, "street": 0.23, "clutter": 0.14, "tabletop": 0.08, "planes": 0.05,
    "terrain": 0.06, "forest": 0.07,
}  # fmt: skip


def random_scene(seed: int, family: str | None = None, *, pool: TexturePool | None = None) -> Scene:
    """Draw a scene.

    Args:
        seed: same seed, family and pool, same scene.
        family: name in ``FAMILIES``; drawn by ``SHARES`` if None.
        pool: textures; the pool of seed 0 if None.

    Returns:
        The scene, with baked light.

    Raises:
        DvoError: an unknown family.
    """
    use_threads()
    rng = np.random.default_rng([seed, salts.SCENE])
    drawn = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    name = family or drawn
    if name not in FAMILIES:
        raise DvoError(f"no scene family '{name}'", field="family", remedy=f"choose one of {', '.join(FAMILIES)}")
    scene: Scene = FAMILIES.resolve(name)(rng, pool or texture_pool(0))
    return scene
