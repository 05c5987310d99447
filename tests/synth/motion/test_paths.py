"""Short paths of training clips."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.geometry.poses import (
    compose_rodrigues,
    invert_rodrigues,
    split,
)
from dvo.synth import KINDS, random_path, random_scene
from dvo.synth.scenes.families import SHARES
from dvo.synth.scenes.scene import Scene
from dvo.synth.textures.texture import texture_pool


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {family: random_scene(2, family, pool=texture_pool(11, count=24, size=64)) for family in SHARES}


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_paths_are_smooth_and_start_in_free_space(scenes: dict[str, Scene], kind: str) -> None:
    for family, scene in scenes.items():
        path = random_path(scene, 3, kind)
        times = np.arange(0, 0.1, 0.01)
        poses = path.poses_wc(times)
        assert scene.clearance(poses[:1, :3])[0] > 0.02 * scene.scale, family
        r, t = split(compose_rodrigues(invert_rodrigues(poses[:-1]), poses[1:]))
        turn = np.arccos(np.clip((np.trace(r, axis1=1, axis2=2) - 1) / 2, -1, 1))
        assert turn.max() < 0.05 and np.linalg.norm(t, axis=1).max() < 0.05 * path.depth
        # Steps change little from one to the next: no jumps.
        assert np.linalg.norm(np.diff(t, axis=0), axis=1).max() < 0.01 * path.depth
    assert np.array_equal(random_path(scene, 3, kind).poses_wc(times), poses)
