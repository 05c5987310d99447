"""Ways that come back."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.synth import Scene, long_path, random_scene
from dvo.synth.motion.motion import SplinePath
from dvo.synth.motion.returns import begun_again, jump, jump_parts, there_and_back
from dvo.synth.textures.texture import texture_pool

CALM = np.zeros(6), np.zeros((6, 2, 6))


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    pool = texture_pool(11, count=24, size=64)
    return {family: random_scene(2**31 + 2, family, pool=pool) for family in ("hall", "gallery")}


def way(count: int) -> SplinePath:
    control = np.random.default_rng(1).normal(size=(count, 6))
    control[:, 3] = np.linspace(0, 9, count)  # turns by more than a whole turn
    return SplinePath("handheld", control, 0.8, *CALM)


@pytest.mark.parametrize("duration", [7.3, 20.0])
def test_the_way_back_is_the_way_there(duration: float) -> None:
    path = there_and_back(way(60), duration)
    assert path.kind == "return" and path.duration == pytest.approx(duration)
    times = np.linspace(0, duration, 57)
    assert np.allclose(path.poses_wc(times), path.poses_wc(times)[::-1], atol=1e-9)
    assert np.linalg.norm(path.poses_wc(np.array([0, duration / 2]))[:, :3], axis=1).max() > 0.05


@pytest.mark.parametrize("duration", [4.0, 6.0, 30.0, 41.7])
def test_the_same_way_after_the_jump(duration: float) -> None:
    assert jump_parts(duration) + 3 <= 60
    path, (begin, end) = begun_again(way(60), duration), jump(duration)
    assert path.kind == "kidnap" and path.duration == pytest.approx(duration)
    assert begin + end == pytest.approx(duration) and 0.5 < end - begin <= 1.8 + 1e-9
    times = np.linspace(0, begin, 41)
    first, again = path.poses_wc(times), path.poses_wc(times + end)
    assert np.allclose(first[:, :3], again[:, :3], atol=1e-6)
    assert np.allclose(np.abs((first[:, 3:] * again[:, 3:]).sum(1)), 1, atol=1e-9)
    yaw = path.control[:, 3]
    assert np.abs(np.diff(yaw)).max() <= np.pi + 1e-9


@pytest.mark.long
@pytest.mark.parametrize("family", ["hall", "gallery"])
@pytest.mark.parametrize("kind", ["revisit", "return", "kidnap"])
def test_ways_that_come_back_stay_in_free_space(scenes: dict[str, Scene], kind: str, family: str) -> None:
    scene, duration = scenes[family], 28.0
    path = long_path(scene, 3, kind, duration)
    times = np.linspace(0, duration, 281)
    lit = times if kind != "kidnap" else times[np.abs(times - duration / 2) > 0.9]
    assert scene.clearance(path.poses_wc(lit)[:, :3]).min() > 0.02 * scene.scale
    again = {"revisit": 28 / 1.4, "return": None, "kidnap": jump(duration)[1]}[kind]
    then = np.array([2.0, 5.0])
    now = duration - then if again is None else then + again
    one, two = path.poses_wc(then), path.poses_wc(now)
    assert np.linalg.norm(one[:, :3] - two[:, :3], axis=1).max() < 0.05 * scene.scale  # the shake is another
    assert np.abs((one[:, 3:] * two[:, 3:]).sum(1)).min() > np.cos(np.radians(8) / 2)
    if kind == "revisit":  # the camera faces along the way, at an angle that stays
        spots = path.poses_wc(times)
        step = np.gradient(spots[:, :2], axis=0)
        x, y, z, w = spots[:, 3:].T
        forward = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x)], 1)
        turned = step[:, 0] * forward[:, 1] - step[:, 1] * forward[:, 0]
        angle = np.unwrap(np.arctan2(turned, (step * forward).sum(1)))
        assert np.median(np.abs(angle - np.median(angle))) < 0.35
