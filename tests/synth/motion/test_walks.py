"""Long paths: free space, kinds of motion."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.synth import (
    HELD_OUT,
    KINDS,
    LONG_KINDS,
    Scene,
    long_path,
    random_scene,
)
from dvo.synth.scenes.families import SHARES
from dvo.synth.textures.texture import texture_pool


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {family: random_scene(2, family, pool=texture_pool(11, count=24, size=64)) for family in SHARES}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(2, "room", pool=texture_pool(11, count=24, size=64))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_long_paths_stay_in_free_space(scenes: dict[str, Scene], kind: str) -> None:
    for family in ("room", "corridor", "street"):
        scene = scenes[family]
        path = long_path(scene, 1, kind, 6.0)
        positions = path.poses_wc(np.linspace(0, 6, 90))[:, :3]
        assert scene.clearance(positions).min() > 0.02 * scene.scale
        assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < 0.2 * scene.scale


@pytest.mark.long
@pytest.mark.parametrize("kind", [kind for kind in LONG_KINDS if kind in ("loop", "straight", "fast")])
@pytest.mark.parametrize("family", ["room", "street", "clutter"])
def test_long_kinds_do_what_they_say(kind: str, family: str) -> None:
    scene = random_scene(2, family, pool=texture_pool(11, count=24, size=64))
    path = long_path(scene, 1, kind, 8.0, speed=1.5)
    times = np.linspace(0, 8, 161)
    poses = path.poses_wc(times)
    assert scene.clearance(poses[:, :3]).min() > 0.02 * scene.scale
    length = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1).sum()
    if kind == "loop":  # the second round passes where the first did, and looks the same way
        lap = 8.0 / 1.4
        again = path.poses_wc(np.array([0.5 + lap]))[0]
        first = path.poses_wc(np.array([0.5]))[0]
        assert np.linalg.norm(again[:3] - first[:3]) < 0.1 * length
        angle = 2 * np.arccos(min(1.0, abs(float(again[3:] @ first[3:]))))
        assert angle < 0.2
    elif kind == "straight":
        assert np.linalg.norm(poses[-1, :3] - poses[0, :3]) > 0.8 * length
    else:
        calm = long_path(scene, 1, "handheld", 8.0).poses_wc(times)
        turns = [np.linalg.norm(np.diff(p[:, 3:], axis=0), axis=1).mean() for p in (poses, calm)]
        assert turns[0] > 1.5 * turns[1]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["orbit", "rotation", "drone", "stop_and_go"])
def test_kinds_of_paths_in_held_out_families(kind: str) -> None:
    for family in HELD_OUT:
        scene = random_scene(3, family, pool=texture_pool(11, count=24, size=64))
        spots = long_path(scene, 4, kind, 4.0).poses_wc(np.linspace(0, 4, 30))[:, :3]
        assert scene.clearance(spots).min() > 0.02 * scene.scale
