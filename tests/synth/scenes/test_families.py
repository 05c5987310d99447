"""Families of scenes: rendering, shares in training, registration from other packages."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.geometry.poses import pose_from
from dvo.synth import FAMILIES, HELD_OUT, Scene, make_sequence, random_scene, render
from dvo.synth.motion.paths import find_start
from dvo.synth.motion.walks import long_path
from dvo.synth.scenes.builder import SceneBuilder
from dvo.synth.scenes.families import SHARES
from dvo.synth.textures.texture import TexturePool, texture_pool

RECORDED = "tabletop planes corridor clutter street planes room planes tabletop street street street"
H, W = 48, 64
K = np.array([50.0, 50.0, 31.5, 23.5])


@pytest.mark.long
@pytest.mark.parametrize("family", list(FAMILIES))
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


def names_instead_of_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make ``random_scene`` return the name of the family that it draws, without laying anything out."""
    monkeypatch.setattr(Registry, "resolve", lambda self, name: lambda rng, pool: name)


def test_training_never_draws_what_is_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(SHARES) | set(HELD_OUT) == set(FAMILIES) and not set(SHARES) & set(HELD_OUT)
    assert sum(SHARES.values()) == pytest.approx(1)
    names_instead_of_scenes(monkeypatch)
    drawn = [str(random_scene(seed)) for seed in range(600)]
    assert set(drawn) == set(SHARES)
    for name, share in SHARES.items():
        assert drawn.count(name) / 600 == pytest.approx(share, abs=0.06)
    with pytest.raises(DvoError, match="hall"):
        random_scene(0, "castle")


def test_the_draw_of_a_family_keeps_its_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Families of seeds 0 to 11, recorded before families had a registry."""
    names_instead_of_scenes(monkeypatch)
    assert " ".join(str(random_scene(seed)) for seed in range(12)) == RECORDED


def empty(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """A family of this module: an empty room."""
    builder = SceneBuilder(rng, pool)
    builder.box([0, 0, 0], [3, 3, 3], np.eye(3), [builder.material("wall")], inside=True)
    return builder.build("empty", np.array([[-1.0, -1, -1], [1, 1, 1]]), 2.0)


def test_a_module_outside_the_package_adds_a_family(monkeypatch: pytest.MonkeyPatch) -> None:
    outside = ModuleType("stranger")
    outside.empty = empty  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "stranger", outside)
    FAMILIES.register("empty", "stranger:empty")
    try:
        sequence = make_sequence(1, frames=2, height=32, width=48, fps=10, family="empty", sensor=False)
        assert sequence.name.startswith("empty-") and float(sequence.rendering(0).depth.max()) > 1
        names_instead_of_scenes(monkeypatch)
        drawn = " ".join(str(random_scene(seed)) for seed in range(12))
        assert drawn == RECORDED, "a family that is added is drawn only when it is named"
    finally:
        FAMILIES.unregister("empty")


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
