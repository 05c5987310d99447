"""Free space within and around meshes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.synth import mesh_scene, random_scene
from dvo.synth.export import scene_triangles
from dvo.synth.meshes.space import triangle_distance
from dvo.synth.motion.walks import long_path
from dvo.synth.textures.texture import texture_pool

trimesh = pytest.importorskip("trimesh")


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_triangle_distance(seed: int) -> None:
    """Against the smallest distance to many points of the triangle."""
    rng = np.random.default_rng(seed)
    corners, point = rng.normal(size=(1, 3, 3)), rng.normal(size=(1, 3))
    i, j = (grid.ravel() / 60 for grid in np.mgrid[:61, :61])
    share = np.stack([1 - i - j, i, j], -1)[i + j <= 1 + 1e-9]
    sampled = np.linalg.norm(share @ corners[0] - point, axis=1).min()
    exact = float(triangle_distance(point, corners)[0])
    assert exact <= sampled + 1e-9 and exact > sampled - 0.12


@pytest.mark.long
def test_objects_are_seen_from_outside_and_rooms_from_within() -> None:
    ball = mesh_scene(trimesh.creation.icosphere(subdivisions=3), ground=False)
    assert not ball.space.inside
    points = np.array([[0, 0, 0.0], [0.5, 0, 0.2], [1.7, 0, 0.2], [0, -2, 0.4]])
    assert ball.is_free(points).tolist() == [False, False, True, True]
    assert np.allclose(ball.clearance(points)[2:], np.linalg.norm(points[2:], axis=1) - 1, atol=0.01)
    room = random_scene(0, "room", pool=texture_pool(11, count=24, size=64))
    vertices, faces, _ = scene_triangles(room)
    inside = mesh_scene(trimesh.Trimesh(vertices, faces, process=False))
    assert inside.space.inside
    low, high = room.bounds
    assert (inside.bounds[0] >= low - 0.2).all() and (inside.bounds[1] <= high + 0.2).all()
    for scene, kind in ((ball, "orbit"), (inside, "handheld")):
        path = long_path(scene, 2, kind, 4.0)
        spots = path.poses_wc(np.linspace(0, 4, 40))[:, :3]
        assert scene.clearance(spots).min() > 0.02 * scene.scale
    assert mesh_scene(trimesh.creation.box(), view="outside").space.inside is False
