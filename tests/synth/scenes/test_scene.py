"""Free space of scenes; scenes with less texture; bodies as parts of a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.geometry.camera import Camera
from dvo.synth import (
    Scene,
    Stage,
    film,
    long_path,
    random_scene,
    render,
)
from dvo.synth.render.shot import Rest
from dvo.synth.scenes.bodies import PER_SURFACE, Body
from dvo.synth.scenes.families import SHARES
from dvo.synth.scenes.repaint import reduce_texture
from dvo.synth.textures.texture import texture_pool


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {family: random_scene(2, family, pool=texture_pool(11, count=24, size=64)) for family in SHARES}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(2, "room", pool=texture_pool(11, count=24, size=64))


def test_clearance_knows_surfaces_and_solids(scenes: dict[str, Scene]) -> None:
    scene = scenes["room"]
    low, high = scene.bounds
    assert scene.clearance(np.array([(low + high) / 2 + 100]))[0] == -1
    solid = scene.solids[0]
    assert scene.clearance(solid[None, :3])[0] == -1
    near_floor = np.array([[0.0, 0.0, low[2] + 0.01]])
    assert scene.clearance(near_floor)[0] <= 0.0101


def test_bare_scenes_have_less_texture_and_the_same_geometry(scene: Scene) -> None:
    path = long_path(scene, 1, "handheld", 2.0)
    camera, times = Camera(70, 70, 39.5, 29.5, 80, 60), np.array([0.3, 1.5])
    full, bare = (film(s, path, camera, times=times).rendering(0) for s in (scene, reduce_texture(scene, 0.1, 0)))
    assert torch.equal(full.surface, bare.surface) and torch.equal(full.depth, bare.depth)

    def detail(images: torch.Tensor) -> float:
        same = (full.surface[..., 1:] == full.surface[..., :-1])[:, None]
        return float(((images[..., 1:] - images[..., :-1]).abs() * same).mean())

    assert detail(bare.images) < 0.35 * detail(full.images)
    assert float((bare.images.mean() - full.images.mean()).abs()) < 0.05


def test_body_at_rest_is_part_of_the_scene(scene: Scene) -> None:
    """Half of a scene as a body that stands still gives the picture of the whole scene."""

    def part(start: int, end: int) -> Scene:
        return replace(scene, **{name: getattr(scene, name)[start:end] for name in PER_SURFACE}, _cache={})

    half = len(scene) // 2
    stage = Stage(part(0, half), (Body(part(half, len(scene)), Rest(np.array([0, 0, 0, 0, 0, 0, 1.0]))),))
    poses = long_path(scene, 1, "handheld", 2.0).poses_wc(np.array([0.3, 1.5]))
    k = np.array([70, 70, 39.5, 29.5])
    whole, staged = render(scene, poses, k, 60, 80), render(stage, poses, k, 60, 80, times=np.zeros(2))
    assert (whole.surface == staged.surface).float().mean() > 0.999
    assert ((whole.images - staged.images).abs() > 1e-3).float().mean() < 0.002
