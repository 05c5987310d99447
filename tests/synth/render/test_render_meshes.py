"""Rendering of meshes: depth against a ray tracer, coverage, textures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.geometry.poses import invert_rodrigues, look_rotation, pose_from, so3_exp, split
from dvo.synth import FAMILIES, MeshScene, load_mesh, mesh_scene, random_scene, render, trace
from dvo.synth.export import scene_triangles
from dvo.synth.meshes.space import free_space
from dvo.synth.meshes.textures import TextureSet
from dvo.synth.motion.paths import find_start
from dvo.synth.render.meshes import mesh_depth
from dvo.synth.render.quality import Quality
from dvo.synth.scenes.scene import Scene
from dvo.synth.textures.texture import texture_pool

trimesh = pytest.importorskip("trimesh")
H, W = 60, 80
K = np.array([66.0, 65.0, 39.2, 29.7])
UP = np.array([0.0, 0.0, 1.0])
QUADRANTS = """mtllib q.mtl
v -1 1 0
v 1 1 0
v 1 -1 0
v -1 -1 0
vt 0 1
vt 1 1
vt 1 0
vt 0 0
usemtl q
f 4/4 3/3 2/2
f 4/4 2/2 1/1
"""


def looking(eye: list[float], at: list[float]) -> np.ndarray:
    """Poses ``(1, 7)`` of a camera at ``eye`` that looks at ``at``."""
    spot = np.array(eye, float)
    return pose_from(look_rotation(np.array(at, float) - spot, UP), spot)[None]


def bare(corners: np.ndarray) -> MeshScene:
    """Triangles without pictures."""
    count = len(corners)
    space = free_space(corners, "outside")
    tint, none = np.full((count, 3, 3), 0.5, np.float32), np.full(count, -1)
    return MeshScene(corners, tint, none, np.zeros((count, 3, 2)), TextureSet(), space, 1.0)


def embree_depth(vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First hit of each pixel's ray by Embree: depth ``(H, W)``, face ``(H, W)`` (-1 for none)."""
    pytest.importorskip("embreex", reason="the independent ray tracer is not installed")
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    y, x = np.mgrid[:H, :W]
    ray = np.stack([(x - K[2]) / K[0], (y - K[3]) / K[1], np.ones((H, W))], -1).reshape(-1, 3)
    rotation, centre = split(pose)
    spot, which, face = RayMeshIntersector(mesh).intersects_location(
        np.tile(centre, (len(ray), 1)), ray @ rotation.T, multiple_hits=False
    )
    depth, hit = np.zeros(H * W), np.full(H * W, -1)
    depth[which], hit[which] = ((spot - centre) @ rotation)[:, 2], face
    return depth.reshape(H, W), hit.reshape(H, W)


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A GLB: a box with a picture, a cylinder with vertex colours, a bare torus."""
    from PIL import Image

    rng = np.random.default_rng(0)
    picture = Image.fromarray(rng.integers(0, 255, (32, 48, 3), dtype=np.uint8))
    box = trimesh.creation.box((1, 0.6, 0.8))
    box = trimesh.Trimesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2] + 0.5, material=material)
    tube = trimesh.creation.cylinder(0.2, 1.2)
    tube.apply_translation([0.9, 0.2, 0])
    colours = rng.integers(0, 255, (len(tube.vertices), 4), dtype=np.uint8)
    colours[:, 3] = 255
    tube.visual = trimesh.visual.ColorVisuals(tube, vertex_colors=colours)
    torus = trimesh.creation.torus(0.4, 0.12)
    torus.apply_translation([-0.9, 0, 0])
    path = tmp_path_factory.mktemp("mesh") / "things.glb"
    trimesh.Scene([box, tube, torus]).export(path)
    return path


def test_depth_of_a_mesh_agrees_with_embree(things: Path) -> None:
    scene = load_mesh(things)
    faces = np.arange(3 * len(scene)).reshape(-1, 3)
    for eye in ([2.2, 1.1, 0.9], [-1.6, -1.9, 0.4]):
        pose = looking(eye, [0, 0, 0])
        frames = render(scene, pose, K, H, W)
        theirs, face = embree_depth(scene.corners.reshape(-1, 3), faces, pose[0])
        ours, same = frames.depth[0].numpy(), frames.surface[0].numpy() == face
        assert same.mean() > 0.995
        assert np.abs(ours[same & (face >= 0)] / theirs[same & (face >= 0)] - 1).max() < 1e-4
        assert 0.2 < (frames.surface[0].numpy() < len(scene) - 2).mean() < 0.9, "the things are not in view"


@pytest.mark.long
@pytest.mark.parametrize("family", list(FAMILIES))
def test_depth_of_families_agrees_with_embree(family: str) -> None:
    """Our scenes as triangles; where Embree sees the back of a one-sided surface, nothing is compared."""
    scene = random_scene(3, family, pool=texture_pool(11, count=24, size=64))
    start = find_start(scene, np.random.default_rng(0))
    pose = pose_from(start.rotation, start.position)
    vertices, faces, owner = scene_triangles(scene)
    theirs, face = embree_depth(vertices, faces, pose)
    frames = render(scene, pose[None], K, H, W)
    rotation, centre = split(pose)
    y, x = np.mgrid[:H, :W]
    ray = np.stack([(x - K[2]) / K[0], (y - K[3]) / K[1], np.ones((H, W))], -1) @ rotation.T
    towards = (ray * scene.normal[owner[face]]).sum(-1) < 0
    front = (face >= 0) & (towards | scene.two_sided[owner[face]])
    same = front & (frames.surface[0].numpy() == owner[face])
    assert front.mean() > 0.9
    assert same.sum() > 0.99 * front.sum()  # outlines are a rounding apart
    assert np.abs(frames.depth[0].numpy()[same] / theirs[same] - 1).max() < 1e-4


def test_a_scene_rendered_as_a_mesh_has_the_same_depth() -> None:
    """Both renderers on the same surfaces: a file made of a scene."""
    scene: Scene = random_scene(1, "tabletop", pool=texture_pool(11, count=24, size=64))
    vertices, faces, owner = scene_triangles(scene)
    start = find_start(scene, np.random.default_rng(1))
    pose = pose_from(start.rotation, start.position)[None]
    first = render(scene, pose, K, H, W)
    mesh = bare(vertices[faces])
    second = render(mesh, pose, K, H, W)
    named = np.where(second.surface.numpy() >= 0, owner[second.surface.numpy()], -1)
    same = torch.from_numpy(named) == first.surface
    assert same.float().mean() > 0.9  # a mesh is seen from behind too
    assert torch.allclose(first.depth[same], second.depth[same], rtol=1e-5)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=12, deadline=None)
def test_rasteriser_agrees_with_single_rays(seed: int) -> None:
    """Triangles at random, some behind the camera and across it, some as small as a pixel."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(0, 1, (40, 1, 3)) + rng.normal(0, 1, (40, 3, 3)) * np.exp(rng.normal(-1, 1.5, (40, 1, 1)))
    scene = bare(corners)
    pose = pose_from(so3_exp(rng.normal(0, 1, 3)), rng.normal(0, 0.5, 3))[None]
    k = np.array([12.0, 13.0, 9.3, 7.1])
    frames = render(scene, pose, k, 16, 20, quality=Quality(antialias=False))
    y, x = np.mgrid[:16, :20]
    depth, surface, uv = trace(scene, pose, k, np.stack([x, y], -1).reshape(1, -1, 2).astype(float))
    assert np.array_equal(surface.reshape(16, 20), frames.surface[0].numpy())
    assert np.allclose(depth.reshape(16, 20), frames.depth[0].numpy(), rtol=1e-6)
    assert np.allclose(uv.reshape(16, 20, 2), frames.uv[0].numpy(), atol=1e-5)
    # What the numbers say: the point of the triangle lands on its pixel.
    hit = frames.surface[0].numpy() >= 0
    a, b, c = corners[frames.surface[0].numpy()[hit]].transpose(1, 0, 2)
    weight = frames.uv[0].numpy()[hit].astype(float)
    rotation, shift = split(invert_rodrigues(pose)[0])
    local = (a + weight[:, :1] * (b - a) + weight[:, 1:] * (c - a)) @ rotation.T + shift
    near = frames.depth[0].numpy()[hit] > 0.05  # nearer, single precision moves by pixels
    at = local[:, :2] / local[:, 2:] * k[:2] + k[2:]
    assert np.abs(at - np.stack([x[hit], y[hit]], -1))[near].max(initial=0) < 0.02


def test_no_cracks_between_triangles() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    scene = bare(np.asarray(ball.vertices[ball.faces]))
    poses = np.concatenate([pose_from(so3_exp(np.array([0.3 * i, 0.7 * i, i])), np.zeros(3))[None] for i in range(3)])
    depth, surface = mesh_depth(scene, poses, np.broadcast_to(K, (3, 4)), H, W, "cpu")
    assert (surface >= 0).all() and (depth < 2.2).all()


def test_picture_of_an_obj_is_upright(tmp_path: Path) -> None:
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :32], picture[:32, 32:], picture[32:, :32] = [255, 0, 0], [0, 255, 0], [0, 0, 255]
    cv2.imwrite(str(tmp_path / "q.png"), picture[..., ::-1])
    (tmp_path / "q.mtl").write_text("newmtl q\nKd 1 1 1\nmap_Kd q.png\n")
    (tmp_path / "q.obj").write_text(QUADRANTS)
    scene = load_mesh(tmp_path / "q.obj", light=False, ground=False, view="outside")
    assert not scene.warnings
    pose = looking([0, -2.5, 0], [0, 0, 0])  # file: y up, z towards the viewer
    image = render(scene, pose, K, H, W).images[0].numpy()
    for column, row, colour in ((28, 18, [1, 0, 0]), (50, 18, [0, 1, 0]), (28, 42, [0, 0, 1]), (50, 42, [0, 0, 0])):
        assert np.allclose(image[:, row, column], colour, atol=0.02)


def test_fine_textures_are_averaged_at_distance() -> None:
    checks = (np.indices((256, 256)).sum(0) % 2).astype(np.float32)
    scene = bare(np.array([[[-9.0, 4, -9], [9, 4, -9], [9, 4, 9]], [[-9, 4, -9], [9, 4, 9], [-9, 4, 9]]]))
    corners = scene.corners
    scene = MeshScene(
        corners, np.ones((2, 3, 3), np.float32), np.zeros(2, int), corners[..., [0, 2]] / 2,
        TextureSet([np.repeat(checks[..., None], 3, 2)]), scene.space, 1.0,
    )  # fmt: skip
    image = render(scene, looking([0, 0, 0], [0, 1, 0]), K, H, W, quality=Quality(antialias=False)).images
    assert abs(float(image.mean()) - 0.5) < 0.01 and float(image.std()) < 0.02, "it shimmers"
    close = render(scene, looking([0, 3.95, 0], [0, 4, 0]), K, H, W, quality=Quality(antialias=False)).images
    # Bilinear between checks of 0 and 1: 0.5 + 0.5 times two triangle waves, whose spread is 1/6.
    assert float(close.std()) == pytest.approx(1 / 6, abs=0.02)


@pytest.mark.slow
def test_three_hundred_thousand_triangles() -> None:
    ball = trimesh.creation.icosphere(subdivisions=7)
    scene = mesh_scene(ball)
    frames = render(scene, looking([2.5, 0, 0.8], [0, 0, 0]), K, H, W)
    assert len(scene) == 327682
    theirs, _ = embree_depth(
        scene.corners.reshape(-1, 3), np.arange(3 * len(scene)).reshape(-1, 3), looking([2.5, 0, 0.8], [0, 0, 0])[0]
    )
    both = (theirs > 0) & (frames.depth[0].numpy() > 0)
    assert np.quantile(np.abs(frames.depth[0].numpy()[both] / theirs[both] - 1), 0.995) < 1e-4
