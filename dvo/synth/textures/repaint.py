"""Scenes painted over: the same geometry with less to see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dvo.synth.scenes.scene import Scene


def plainer(scene: Scene, share: float, seed: int) -> Scene:
    """The scene with only about ``share`` of its textures' contrast left, in [0, 1]: most surfaces turn to a bare
    colour (their own mean), the rest keep some. Light and shadows stay.
    """
    rng = np.random.default_rng([seed, 7405])
    bare = rng.random(len(scene)) >= share
    left = np.where(bare, 0.04, np.minimum(1.0, 0.3 + share))[:, None]
    mean = np.stack([scene.pool.use(int(texture)) for texture in scene.texture])
    return replace(scene, gain=scene.gain * left, offset=scene.offset + (1 - left) * scene.gain * mean, _cache={})
