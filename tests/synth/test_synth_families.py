"""Families and their textures: what is drawn, what is held out, what patterns look like."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.errors import DvoError
from dvo.synth import FAMILIES, HELD_OUT, random_scene, render
from dvo.synth.motion.paths import find_start
from dvo.synth.motion.walks import long_path
from dvo.synth.poses import pose_from
from dvo.synth.scenes.families import SHARES
from dvo.synth.textures.patterns import PATTERNS, SPECIAL
from dvo.synth.textures.pool import TexturePool, texture_pool

H, W = 48, 64
K = np.array([50.0, 50.0, 31.5, 23.5])
# Mean colour and spread of each pattern at 64 texels from seed 5: drawn before the patterns were sorted by kind.
GOLDEN = {
    "fractal": (0.8258, 0.6220, 0.5073, 0.1689),
    "stains": (0.5277, 0.5389, 0.5071, 0.0645),
    "plain": (0.5665, 0.5924, 0.6029, 0.0219),
    "cells": (0.3272, 0.2361, 0.2815, 0.1315),
    "bricks": (0.5516, 0.4996, 0.5321, 0.0926),
    "tiles": (0.2964, 0.2548, 0.1512, 0.1510),
    "wood": (0.4047, 0.2583, 0.0546, 0.1606),
    "stripes": (0.4099, 0.4122, 0.4116, 0.0468),
    "leaves": (0.4777, 0.4572, 0.4145, 0.2215),
    "foliage": (0.2682, 0.4423, 0.1352, 0.2236),
    "grass": (0.3956, 0.5310, 0.1177, 0.2157),
    "asphalt": (0.3177, 0.3218, 0.3235, 0.0529),
    "facade": (0.4967, 0.4365, 0.4120, 0.1603),
    "text": (0.5081, 0.5553, 0.5029, 0.1919),
    "shelf": (0.3163, 0.3013, 0.2891, 0.2117),
    "panel": (0.4557, 0.4748, 0.4816, 0.1675),
    "clouds": (0.6852, 0.6965, 0.7014, 0.0541),
}


@pytest.mark.parametrize("family", [*FAMILIES, *HELD_OUT])
def test_every_family_renders_the_same_twice_and_lets_cameras_pass(family: str) -> None:
    pool = texture_pool(11, count=24, size=64)
    for seed in (0, 1):
        scene, again = (random_scene(seed, family, pool=pool) for _ in range(2))
        assert scene.family == family
        start = find_start(scene, np.random.default_rng(seed))
        pose = pose_from(start.rotation, start.position)[None]
        frames, twice = render(scene, pose, K, H, W), render(again, pose, K, H, W)
        assert (frames.surface >= 0).all(), "a ray fell through"
        assert (frames.images == twice.images).all() and (frames.depth == twice.depth).all()
        assert frames.images.std() > 0.02 and 0.05 < frames.images.mean() < 0.95
        path = long_path(scene, seed, "forward" if scene.hints.get("heading") is not None else "handheld", 5.0)
        assert scene.clearance(path.poses_wc(np.linspace(0, 5, 40))[:, :3]).min() > 0.02 * scene.scale


@pytest.mark.parametrize("kind", ["orbit", "rotation", "drone", "stop_and_go"])
def test_kinds_of_paths_in_held_out_families(kind: str) -> None:
    for family in HELD_OUT:
        scene = random_scene(3, family, pool=texture_pool(11, count=24, size=64))
        spots = long_path(scene, 4, kind, 4.0).poses_wc(np.linspace(0, 4, 30))[:, :3]
        assert scene.clearance(spots).min() > 0.02 * scene.scale


def test_training_never_draws_what_is_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(SHARES) == set(FAMILIES) and not set(FAMILIES) & set(HELD_OUT)
    assert sum(SHARES.values()) == pytest.approx(1)
    for name in (*FAMILIES, *HELD_OUT):  # who is drawn, without laying anything out
        monkeypatch.setitem(FAMILIES if name in FAMILIES else HELD_OUT, name, lambda rng, pool, name=name: name)
    drawn = [str(random_scene(seed)) for seed in range(600)]
    assert set(drawn) == set(FAMILIES)
    for name, share in SHARES.items():
        assert drawn.count(name) / 600 == pytest.approx(share, abs=0.06)
    with pytest.raises(DvoError, match="hall"):
        random_scene(0, "castle")


def test_terrain_has_one_texture_across_its_triangles() -> None:
    scene = random_scene(0, "terrain", pool=texture_pool(11, count=24, size=64))
    ground = [i for i in range(len(scene)) if np.ptp(scene.corners[i][:, 2]) < 50 and not scene.two_sided[i]]
    corner: dict[tuple[float, ...], set[tuple[float, ...]]] = {}
    size = 2 * scene.pool.size
    for i in ground:
        flat = scene.corners[i] - scene.origin[i]
        uv = np.stack([flat @ scene.u_axis[i], flat @ scene.v_axis[i], np.ones(4)], -1)
        texel = uv @ scene.texture_map[i].T
        for point, at in zip(scene.corners[i].round(6), texel, strict=True):
            key = (float(scene.texture[i]), *point.tolist())
            corner.setdefault(key, set()).add(tuple((at % size).round(3).tolist()))
    shared = [places for places in corner.values() if len(places) == 1]
    assert len(shared) > 100, "neighbouring triangles disagree about the texture at their common corner"


def test_patterns_are_what_they_were() -> None:
    for name, (draw, _) in PATTERNS.items():
        image = draw(np.random.default_rng([0, 5]), 64)
        assert image.shape == (64, 64, 3) and image.dtype == np.float32
        assert np.allclose([*image.mean((0, 1)), image.std()], GOLDEN[name], atol=2e-3), name


@pytest.mark.parametrize("name", list(SPECIAL))
def test_special_patterns(name: str) -> None:
    draw, tag = SPECIAL[name]
    first, again, other = (draw(np.random.default_rng(seed), 128) for seed in (1, 1, 2))
    assert first.shape == (128, 128, 3) and first.dtype == np.float32
    assert np.array_equal(first, again) and np.abs(first - other).mean() > 0.01
    assert first.min() >= 0 and first.max() <= 1 and first.std() > 0.01
    pool = texture_pool(11, count=24, size=64)
    assert all(pool.tags[i] == tag for i in pool.tagged(tag)) and len(pool.tagged(tag)) >= 1


def test_special_patterns_leave_other_textures_alone() -> None:
    """Those that scenes without special tags can get are the first ``count``."""
    pool = texture_pool(11, count=24, size=64)
    assert not {pool.tags[i] for i in range(pool.count)} & {tag for _, tag in SPECIAL.values()}
    assert len(pool.tags) == pool.count + len(SPECIAL)


def test_textures_from_a_folder(tmp_path: Path) -> None:
    (tmp_path / "wall").mkdir()
    for index, name in enumerate(("a.png", "b.jpg", "wall/c.png")):
        picture = np.zeros((40, 60, 3), np.uint8)
        picture[..., index] = 255
        cv2.imwrite(str(tmp_path / name), picture[..., ::-1])
    pool = TexturePool(0, 18, 32, tmp_path)
    photos = [i for i in range(18) if i % 3 == 2]
    assert {pool.tags[i] for i in photos} == {"photo", "wall"}
    assert all(sorted(pool.use(i).round(1).tolist()) == [0, 0, 1] for i in photos), "not the pictures of the folder"
    assert texture_pool(0, 18, 32, folder=str(tmp_path)) is not texture_pool(0, 18, 32)
    (tmp_path / "broken.png").write_bytes(b"not a picture")
    with pytest.raises(DvoError, match="broken.png.*cannot be read"):
        TexturePool(0, 18, 32, tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DvoError, match="no pictures"):
        TexturePool(0, 18, 32, tmp_path / "empty")
    with pytest.raises(DvoError, match="no such folder"):
        TexturePool(0, 18, 32, tmp_path / "nowhere")
