"""Shutter, motion blur and stereo of a shot."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dvo.geometry.camera import Camera
from dvo.geometry.poses import compose_rodrigues, invert_rodrigues
from dvo.synth import (
    Scene,
    Shot,
    Stage,
    long_path,
    random_path,
    random_scene,
)
from dvo.synth.motion.movers import random_bodies
from dvo.synth.render.shot import Rest
from dvo.synth.textures.texture import texture_pool
from dvo.synth.truth import hit_pixels, visible_points

CAMERA = Camera(82.0, 81.5, 47.7, 35.2, 96, 72)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(4, "room", pool=texture_pool(5))


def make_shot(
    scene: Scene, *, bodies: int = 0, readout: float = 0.0, exposure: float = 0.0, camera: Camera = CAMERA
) -> Shot:
    path = long_path(scene, 3, "handheld", 3.0, speed=2.0, shake=2.0)
    stage = Stage(scene, random_bodies(scene, path, 1.0, 2, bodies)) if bodies else scene
    return Shot(stage, path, camera, exposure, readout)


def test_rolling_shutter_of_a_still_camera_is_none(scene: Scene) -> None:
    pose = long_path(scene, 3, "handheld", 3.0).poses_wc(np.array([0.5]))[0]
    still, rolling = (Shot(scene, Rest(pose), CAMERA, readout=r).sharp(1.0) for r in (0.0, 0.05))
    assert torch.equal(still.surface, rolling.surface)
    # Where an outline runs along a row, a sub-pixel sample may fall on either side.
    assert ((still.images - rolling.images).abs() > 2e-3).float().mean() < 0.005
    assert torch.allclose(still.depth, rolling.depth, rtol=1e-5)
    assert torch.allclose(still.uv, rolling.uv, atol=1e-4)


def test_rolling_rows_are_those_of_their_own_times(scene: Scene) -> None:
    shot = make_shot(scene, bodies=3, readout=0.04)
    frame = shot.sharp(0.5)
    for row in (0, 20, 71):
        at_once = Shot(shot.scene, shot.path, CAMERA).sharp(0.5 + (row - 35.5) * 0.04 / 72)
        assert (frame.surface[0, row] == at_once.surface[0, row]).float().mean() > 0.98
        assert (frame.depth[0, row] / at_once.depth[0, row] - 1).abs().median() < 1e-5
    middle = Shot(shot.scene, shot.path, CAMERA).sharp(0.5)
    assert not torch.equal(middle.surface[0, 0], frame.surface[0, 0]), "the top row is read earlier than the middle"


@pytest.mark.long
def test_blur_is_the_mean_along_the_path(scene: Scene) -> None:
    shot = make_shot(scene, bodies=2, exposure=0.4)
    middle = shot.sharp(0.5)
    count = shot.sub_exposures(middle, 0.5)
    assert count % 2 == 1 and count > 3
    blurred = shot.rendering(0.5)
    assert torch.equal(blurred.depth, middle.depth), "ground truth is that of mid-exposure"
    offsets = ((np.arange(count) + 0.5) / count - 0.5) * 0.4
    mean = torch.stack([shot.sharp(0.5 + s).images for s in offsets]).mean(0)
    assert (blurred.images - mean).abs().max() < 1e-3
    finer = torch.stack([shot.sharp(0.5 + s).images for s in np.linspace(-0.2, 0.2, 41)]).mean(0)
    assert (blurred.images - finer).abs().mean() < 0.25 * (middle.images - finer).abs().mean()


def test_second_camera_of_a_pair(scene: Scene) -> None:
    """Rectified stereo: what both see lies on one row, shifted by fx b / Z."""
    shot = Shot(scene, random_path(scene, 2, "handheld"), CAMERA)
    right = shot.beside(0.1)
    pixels, depth, surface = hit_pixels(shot.sharp(0.2))
    there, z = right.place(0.2, shot.lift(0.2, pixels, depth, surface), surface)
    assert np.allclose(there[:, 1], pixels[:, 1], atol=1e-6) and np.allclose(z, depth, rtol=1e-9)
    assert np.allclose(pixels[:, 0] - there[:, 0], CAMERA.fx * 0.1 / depth)
    assert visible_points(right, 0.2, there, z, surface).mean() > 0.5
    relative = compose_rodrigues(invert_rodrigues(shot.path.poses_wc(np.zeros(1))), right.path.poses_wc(np.zeros(1)))[0]
    assert np.allclose(relative, [0.1, 0, 0, 0, 0, 0, 1], atol=1e-9)
