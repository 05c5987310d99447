"""Exactness of the renderer: geometry, texture coordinates, photometric consistency."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.geometry.poses import invert_rodrigues, look_rotation, pose_from, split
from dvo.synth import random_path, random_scene, render, trace
from dvo.synth.render.quality import Quality
from dvo.synth.render.renderer import render_depth
from dvo.synth.scenes.builder import SceneBuilder
from dvo.synth.scenes.families import SHARES
from dvo.synth.scenes.scene import Scene
from dvo.synth.textures.texture import TexturePool, texture_pool

H, W = 48, 64
K = np.array([52.0, 51.5, 31.2, 23.9])


@pytest.fixture(scope="module")
def pool() -> TexturePool:
    return texture_pool(11, count=24, size=64)


def two_views(pool: TexturePool, family: str, seed: int = 4) -> tuple[Scene, np.ndarray]:
    scene = random_scene(seed, family, pool=pool)
    path = random_path(scene, seed, "handheld").scaled(0.5)
    return scene, path.poses_wc(np.array([0.0, 0.2]))


def world_points(depth: np.ndarray, pose_wc: np.ndarray, k: np.ndarray = K) -> np.ndarray:
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    ray = np.stack([(x - k[2]) / k[0], (y - k[3]) / k[1], np.ones(depth.shape)], -1)
    rotation, centre = split(pose_wc)
    return (ray * depth[..., None]) @ rotation.T + centre


def into(points: np.ndarray, pose_wc: np.ndarray, k: np.ndarray = K) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and depth of world points in a camera."""
    rotation, centre = split(invert_rodrigues(pose_wc))
    local = points @ rotation.T + centre
    return local[..., :2] / local[..., 2:] * k[:2] + k[2:], local[..., 2]


@pytest.mark.long
@pytest.mark.parametrize("family", list(SHARES))
def test_pixel_lands_on_same_surface_and_texture_coordinate(pool: TexturePool, family: str) -> None:
    scene, poses = two_views(pool, family)
    frames = render(scene, poses, K, H, W)
    assert (frames.surface >= 0).all(), "a ray fell through a crack"
    points = world_points(frames.depth[0].numpy().astype(float), poses[0])
    pixels, depth = into(points, poses[1])
    inside = (depth > 0) & (pixels > 0).all(-1) & (pixels < [W - 1, H - 1]).all(-1)
    assert inside.mean() > 0.4
    seen, surface, uv = trace(scene, poses[1:], K, pixels[inside][None])
    labels = frames.surface[0].numpy()[inside]
    visible = np.abs(seen[0] / depth[inside] - 1) < 1e-4
    same = visible & (surface[0] == labels)
    assert visible.mean() > 0.7
    assert same.sum() >= 0.995 * visible.sum()  # touching surfaces share their edges
    # Where frame j's texture coordinate, placed in frame i, misses the pixel it came from, is the error.
    start = frames.uv[0].numpy()[inside].astype(float)
    for coordinates in (start, uv[0]):
        across, down = coordinates[:, :1] * scene.u_axis[labels], coordinates[:, 1:] * scene.v_axis[labels]
        spot = scene.origin[labels] + across + down
        error = np.linalg.norm(into(spot, poses[1])[0] - pixels[inside], axis=-1)[same]
        assert error.max() < 1e-3


@pytest.mark.long
def test_warp_is_photometrically_consistent() -> None:
    """Frame i warped to j by depth and pose equals frame j outside occlusions, in every family."""
    pool = texture_pool(5)
    errors, changes = [], []
    for seed, family in enumerate(SHARES):
        scene, poses = two_views(pool, family, seed)
        k = 2 * K + [0, 0, 0.5, 0.5]
        frames = render(scene, poses, k, 2 * H, 2 * W)
        points = world_points(frames.depth[0].numpy().astype(float), poses[0], k)
        pixels, depth = into(points, poses[1], k)
        grid = torch.from_numpy((pixels / [W - 0.5, H - 0.5] - 1).astype(np.float32))[None]
        sampled = torch.nn.functional.grid_sample(frames.images[1:], grid, align_corners=True)[0]
        there = torch.nn.functional.grid_sample(frames.depth[1:, None], grid, align_corners=True)[0, 0].numpy()
        mask = (np.abs(grid[0].numpy()) < 1).all(-1) & (np.abs(there / depth - 1) < 0.01)
        assert mask.mean() > 0.3
        errors.append(np.median((sampled - frames.images[0]).abs().mean(0).numpy()[mask]))
        changes.append(np.median((frames.images[1] - frames.images[0]).abs().mean(0).numpy()[mask]))
    # What is left is interpolation of pictures that are busy at the scale of a pixel.
    assert np.median(errors) < 1 / 255 and max(errors) < 3 / 255
    assert np.median(np.array(changes) / errors) > 3, "the frames hardly differ: the test shows nothing"


def test_smooth_texture_warps_below_one_grey_level() -> None:
    pool = texture_pool(11, count=24, size=64)
    b = SceneBuilder(np.random.default_rng(0), pool)
    paint = b.material("wall", metres=(9, 10))  # texels larger than pixels: nothing to alias
    b.rectangle([0, 4, 0], [0.2, -1, 0.1], [0, 0, 1], 30, 30, paint)
    scene = b.build("test", np.array([[-2.0, -2, -2], [2, 2, 2]]), 4.0)
    rotation = look_rotation(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    poses = pose_from(np.stack([rotation] * 2), np.array([[0.0, 0, 0], [0.3, 0.2, 0.1]]))
    frames = render(scene, poses, K, H, W)
    pixels, _ = into(world_points(frames.depth[0].numpy().astype(float), poses[0]), poses[1])
    grid = torch.from_numpy((pixels / [(W - 1) / 2, (H - 1) / 2] - 1).astype(np.float32))[None]
    sampled = torch.nn.functional.grid_sample(frames.images[1:], grid, align_corners=True)[0]
    mask = (np.abs(pixels / [W - 1, H - 1] - 0.5) < 0.5).all(-1)
    error = (sampled - frames.images[0]).abs().amax(0).numpy()[mask]
    assert frames.images.std() > 0.01
    assert np.median(error) < 1 / 255


def test_depth_of_known_plane_and_texture_is_upright() -> None:
    pool = texture_pool(11, count=24, size=64)
    b = SceneBuilder(np.random.default_rng(0), pool)
    b.rectangle([0, 2, 0], [0, -1, 0], [0, 0, 1], 1.0, 0.5, b.material())
    scene = b.build("test", np.zeros((2, 3)), 1.0)
    rotation = look_rotation(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    frames = render(scene, pose_from(rotation, np.zeros(3))[None], K, H, W)
    hit = frames.surface[0] == 0
    images = render(scene, pose_from(rotation, np.zeros(3))[None], K, H, W, quality=Quality(antialias=False)).images
    assert torch.allclose(frames.depth[0][hit], torch.tensor(2.0), rtol=1e-6)
    assert (frames.depth[0][~hit] == 0).all() and (images[0][:, ~hit] == 0).all()
    rows, columns = np.nonzero(hit.numpy())
    assert len(rows) == pytest.approx(1.0 / 2 * K[0] * 0.5 / 2 * K[1], rel=0.1)
    uv = frames.uv[0].numpy()[hit.numpy()]
    assert np.allclose(uv[:, 0], (columns - K[2]) / K[0] * 2, atol=1e-5)  # u to the right
    assert np.allclose(uv[:, 1], (rows - K[3]) / K[1] * 2, atol=1e-5)  # v down
    back = render_depth(scene, pose_from(rotation @ np.diag([-1.0, 1, -1]), np.array([0.0, 4, 0]))[None], K, H, W)[1]
    assert (back < 0).all(), "one-sided surfaces are not seen from behind"


def test_culling_changes_nothing(pool: TexturePool) -> None:
    """Frames rendered together and alone are the same bytes; windows and culling are exact."""
    scene, poses = two_views(pool, "street")
    both = render(scene, poses, K, H, W)
    alone = render(scene, poses[1:], K, H, W)
    assert torch.equal(both.surface[1:], alone.surface)
    assert torch.equal(both.images[1:], alone.images)
    y, x = np.mgrid[:H, :W]
    pixels = np.stack([x, y], -1).reshape(1, -1, 2).astype(float)
    _, surface, _ = trace(scene, poses[1:], K, pixels)
    assert (surface.reshape(H, W) == alone.surface[0].numpy()).mean() > 0.995


def test_bad_input() -> None:
    scene = random_scene(0, "planes", pool=texture_pool(11, count=24, size=64))
    pose = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
    with pytest.raises(DvoError, match="poses_wc"):
        render(scene, pose[0], K, H, W)
    with pytest.raises(DvoError, match="intrinsics"):
        render(scene, pose, K[:3], H, W)
    with pytest.raises(DvoError, match="intrinsics"):
        render(scene, pose, K * [0, 1, 1, 1], H, W)
    with pytest.raises(DvoError, match="family"):
        random_scene(0, "castle")
