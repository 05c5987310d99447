"""Flow, occlusion, moving pixels and tracks of sequences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.geometry.camera import Camera
from dvo.synth import (
    Scene,
    Shot,
    Stage,
    dynamic_mask,
    long_path,
    optical_flow,
    random_scene,
    tracks,
)
from dvo.synth.motion.movers import random_bodies
from dvo.synth.textures.texture import texture_pool
from dvo.synth.truth import hit_pixels, visible_points

CAMERA = Camera(82.0, 81.5, 47.7, 35.2, 96, 72)
TIMES = (0.4, 0.55)
LENSES = {
    "radtan": replace(CAMERA, model="radtan", coefficients=(-0.17, 0.02, 1e-3, -8e-4)),
    "fisheye": replace(CAMERA, model="fisheye", coefficients=(0.02, -0.004, 0.0, 0.0)),
}
CASES = {
    "still": {}, "bodies": {"bodies": 4}, "rolling": {"readout": 0.03}, "both": {"bodies": 4, "readout": 0.03},
    "radtan": {"bodies": 4, "camera": LENSES["radtan"]}, "fisheye": {"camera": LENSES["fisheye"]},
}  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(4, "room", pool=texture_pool(5))


def make_shot(
    scene: Scene, *, bodies: int = 0, readout: float = 0.0, exposure: float = 0.0, camera: Camera = CAMERA
) -> Shot:
    path = long_path(scene, 3, "handheld", 3.0, speed=2.0, shake=2.0)
    stage = Stage(scene, random_bodies(scene, path, 1.0, 2, bodies)) if bodies else scene
    return Shot(stage, path, camera, exposure, readout)


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_flow_lands_on_the_same_surface_and_texture_coordinate(scene: Scene, case: str) -> None:
    """A pixel moved by the flow hits, in float64, the surface and the spot on it that it showed before."""
    shot = make_shot(scene, **CASES[case])
    first = shot.sharp(TIMES[0])
    result = optical_flow(shot, *TIMES)
    assert 0.4 < result.visible.mean() < 1 and (result.visible <= result.inside).all()
    assert np.linalg.norm(result.flow[result.visible], axis=-1).mean() > 2, "hardly any motion: the test shows nothing"
    y, x = np.nonzero(result.visible)
    keep = np.random.default_rng(0).choice(len(y), min(len(y), 1500), replace=False)
    y, x = y[keep], x[keep]
    target = np.stack([x, y], -1) + result.flow[y, x]
    depth, surface, uv = shot.trace(TIMES[1], target)
    same = surface == first.surface[0].numpy()[y, x]
    assert same.mean() > 0.995  # touching surfaces share their edges
    # The spot in frame j's texture coordinates, taken back to the pixels of frame j through frame i's coordinates.
    labels = surface[same]
    tables = shot.scene.surfaces if isinstance(shot.scene, Stage) else shot.scene
    start = first.uv[0].numpy()[y, x].astype(float)[same]
    shift = start - uv[same]
    spot = shift[:, :1] * tables.u_axis[labels] + shift[:, 1:] * tables.v_axis[labels]
    before = shot.lift(TIMES[1], target[same], depth[same], labels)
    again, _ = shot.place(TIMES[1], before + spot, labels)
    assert np.linalg.norm(again - target[same], axis=-1).max() < 1e-3


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_flow_there_and_back_agree(scene: Scene, case: str) -> None:
    """A point seen by both frames flows back to where it came from, and is visible from there too."""
    shot = make_shot(scene, **CASES[case])
    there, back = optical_flow(shot, *TIMES), optical_flow(shot, *TIMES[::-1])
    y, x = np.nonzero(there.visible)
    target = np.stack([x, y], -1) + there.flow[y, x]
    depth, surface, _ = shot.trace(TIMES[1], target[::7])
    points = shot.lift(TIMES[1], target[::7], depth, surface)
    home, z = shot.place(TIMES[0], points, surface)
    close = np.linalg.norm(home - np.stack([x, y], -1)[::7], axis=-1)
    assert np.quantile(close, 0.99) < 1e-2
    assert visible_points(shot, TIMES[0], home, z, surface)[close < 1e-2].mean() > 0.99
    # On the grid of whole pixels: the flow back at the nearest pixel is minus the flow there, but for its own change.
    near = np.clip(target.round().astype(int), 0, [CAMERA.width - 1, CAMERA.height - 1])
    returned = back.flow[near[:, 1], near[:, 0]]
    assert np.median(np.linalg.norm(returned + there.flow[y, x], axis=-1)) < 0.1


@pytest.mark.slow
def test_warped_frame_is_the_same_picture() -> None:
    """Median photometric error of the warp outside occlusions below one grey level, bodies and rolling shutter too."""
    errors, unmoved = [], []
    # A long lens: pixels smaller than texels, so that interpolating the picture adds no error of its own.
    camera = Camera(420.0, 420.0, 80.0, 60.0, 160, 120)
    for seed, family in enumerate(("room", "corridor")):
        scene = random_scene(seed, family, pool=texture_pool(5))
        for case in ("bodies", "both"):
            shot = replace(make_shot(scene, **CASES[case]), camera=camera)
            result = optical_flow(shot, 0.4, 0.42)
            first, last = (shot.sharp(t).images for t in (0.4, 0.42))
            y, x = np.mgrid[: camera.height, : camera.width]
            place = (np.stack([x, y], -1) + result.flow) / [(camera.width - 1) / 2, (camera.height - 1) / 2] - 1
            grid = torch.from_numpy(place.astype(np.float32))[None]
            warped = torch.nn.functional.grid_sample(last, grid, padding_mode="border", align_corners=True)
            assert result.visible.mean() > 0.4
            errors.append(np.median((warped - first)[0].abs().mean(0).numpy()[result.visible]))
            unmoved.append(np.median((last - first)[0].abs().mean(0).numpy()[result.visible]))
    assert max(errors) < 1 / 255, errors
    assert np.median(np.array(unmoved) / errors) > 3, "the frames hardly differ: the test shows nothing"


@pytest.mark.long
def test_without_bodies_moving_pixels_the_static_flow_is_wrong(scene: Scene) -> None:
    shot = make_shot(scene, bodies=6)
    mask = dynamic_mask(shot, TIMES[0])
    assert 0.01 < mask.mean() < 0.7
    assert isinstance(shot.scene, Stage)
    pixels, depth, surface = hit_pixels(shot.sharp(TIMES[0]))
    assert np.array_equal(surface >= shot.scene.static, mask[depth.reshape(mask.shape) > 0])
    true, _ = shot.place(TIMES[1], shot.lift(TIMES[0], pixels, depth, surface), surface)
    nothing = np.zeros_like(surface)  # as if all belonged to the static scene
    static, _ = shot.place(TIMES[1], shot.lift(TIMES[0], pixels, depth, nothing), nothing)
    gap = np.linalg.norm(true - static, axis=-1)
    moving = surface >= shot.scene.static
    assert gap[~moving].max() < 1e-9 and np.median(gap[moving]) > 0.5
    assert np.array_equal(shot.scene.owner(np.array([-1, 0, shot.scene.static, shot.scene.starts[-1] - 1])),
                          [-1, 0, 1, len(shot.scene.bodies)])  # fmt: skip


@pytest.mark.long
def test_occluded_pixels_are_hidden_by_something_nearer(scene: Scene) -> None:
    shot = make_shot(scene, bodies=4)
    result = optical_flow(shot, 0.2, 0.8)
    hidden = result.inside & ~result.visible
    assert hidden.sum() > 20
    pixels, depth, surface = hit_pixels(shot.sharp(0.2))
    there, z = shot.place(0.8, shot.lift(0.2, pixels, depth, surface), surface)
    chosen = hidden[tuple(pixels[:, ::-1].astype(int).T)]
    seen, _, _ = shot.trace(0.8, there[chosen])
    one_sided = seen > z[chosen]  # its surface has turned its back
    assert (seen[~one_sided] < z[chosen][~one_sided]).all() and one_sided.mean() < 0.5


@pytest.mark.long
@pytest.mark.parametrize("case", ["bodies", "both"])
def test_tracks_follow_surface_points(scene: Scene, case: str) -> None:
    shot = make_shot(scene, **CASES[case])
    times = np.arange(4) * 0.2
    found = tracks(shot, times, 60)
    assert found.pixels.shape == (4, 60, 2) and found.visible.shape == (4, 60)
    assert 0.2 < found.visible.mean() < 1 and found.dynamic.any() and not found.dynamic.all()
    for k, time in enumerate(times):
        seen = found.visible[k]
        depth, surface, _ = shot.trace(time, found.pixels[k][seen])
        assert np.allclose(depth, found.depth[k][seen], rtol=2e-4)
        assert (surface == found.surface[seen]).mean() > 0.95
    again = tracks(shot, times, 60)
    assert np.array_equal(again.pixels, found.pixels) and np.array_equal(again.visible, found.visible)
