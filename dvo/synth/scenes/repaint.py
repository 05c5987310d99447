"""Scenes with less texture: the same geometry and light, most surfaces bare."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dvo.synth import salts
from dvo.synth.scenes.scene import Scene


def reduce_texture(scene: Scene, share: float, seed: int) -> Scene:
    """Scene with part of its textures' contrast removed: most surfaces take their own mean colour, the rest keep some.

    Args:
        scene: original.
        share: of the contrast that is kept, about, in [0, 1].
        seed: draws the surfaces that turn bare.

    Returns:
        Scene of the same geometry, light and shadows.
    """
    rng = np.random.default_rng([seed, salts.REPAINT])
    bare = rng.random(len(scene)) >= share
    left = np.where(bare, 0.04, np.minimum(1.0, 0.3 + share))[:, None]
    mean = np.stack([scene.pool.use(int(texture)) for texture in scene.texture])
    return replace(scene, gain=scene.gain * left, offset=scene.offset + (1 - left) * scene.gain * mean, _cache={})
