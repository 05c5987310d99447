"""Moving bodies drawn for a camera path."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.poses import compose_rodrigues, invert_rodrigues, split
from dvo.synth import (
    Scene,
    Stage,
    film,
    long_path,
    random_scene,
    render,
)
from dvo.synth.motion.movers import random_bodies
from dvo.synth.scenes.bodies import Body
from dvo.synth.textures.texture import texture_pool


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(2, "room", pool=texture_pool(11, count=24, size=64))


@pytest.mark.long
def test_bodies_move_rigidly_and_keep_off_the_camera(scene: Scene) -> None:
    path = long_path(scene, 1, "handheld", 4.0)
    bodies = random_bodies(scene, path, 4.0, 7, 4)
    times = np.linspace(0, 4, 81)
    assert len(bodies) == 4
    for body in bodies:
        poses = body.motion.poses_wc(times)
        assert (np.linalg.norm(poses[:, :3] - path.poses_wc(times)[:, :3], axis=1) > body.radius).all()
        assert np.linalg.norm(np.ptp(poses[:, :3], axis=0)) > 0.3 * body.radius, "it does not move"
        step = split(compose_rodrigues(invert_rodrigues(poses[:-1]), poses[1:]))[1]
        assert np.linalg.norm(np.diff(step, axis=0), axis=1).max() < 0.1 * body.radius, "it jumps"
    camera = Camera(70, 70, 39.5, 29.5, 80, 60)
    moving = film(Stage(scene, bodies), path, camera, times=times[::8])
    shares = [moving.dynamic_mask(i).mean() for i in range(len(moving))]
    assert np.mean(shares) > 0.01 and max(shares) < 0.9
    assert not film(scene, path, camera, times=times[::8]).dynamic_mask(0).any()
    with pytest.raises(DvoError, match="times"):
        render(Stage(scene, bodies), path.poses_wc(np.zeros(1)), camera.intrinsics, 60, 80)
    with pytest.raises(DvoError, match="pool"):
        stranger = Body(random_scene(2, "room", pool=texture_pool(12, count=24, size=64)), bodies[0].motion)
        _ = Stage(scene, (stranger,)).surfaces
