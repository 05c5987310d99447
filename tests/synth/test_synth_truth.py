"""Ground truth of films: flow, occlusion, moving bodies, rolling shutter, tracks, inertial measurements, stereo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.synth import (
    ImuNoise,
    Scene,
    Shot,
    Stage,
    dynamic_mask,
    long_path,
    measure_imu,
    optical_flow,
    random_path,
    random_scene,
    tracks,
)
from dvo.synth.poses import compose, inverse, quaternion_to_matrix, so3_exp, split
from dvo.synth.render.shot import Rest
from dvo.synth.scenes.movers import random_bodies
from dvo.synth.sensors.imu import GRAVITY, rotation_vector
from dvo.synth.textures.pool import texture_pool
from dvo.synth.truth import hits, shows

CAMERA = Camera(82.0, 81.5, 47.7, 35.2, 96, 72)
TIMES = (0.4, 0.55)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(4, "room", pool=texture_pool(5))


LENSES = {
    "radtan": replace(CAMERA, model="radtan", coefficients=(-0.17, 0.02, 1e-3, -8e-4)),
    "fisheye": replace(CAMERA, model="fisheye", coefficients=(0.02, -0.004, 0.0, 0.0)),
}


def make_shot(
    scene: Scene, *, bodies: int = 0, readout: float = 0.0, exposure: float = 0.0, camera: Camera = CAMERA
) -> Shot:
    path = long_path(scene, 3, "handheld", 3.0, speed=2.0, shake=2.0)
    stage = Stage(scene, random_bodies(scene, path, 1.0, 2, bodies)) if bodies else scene
    return Shot(stage, path, camera, exposure, readout)


CASES = {
    "still": {}, "bodies": {"bodies": 4}, "rolling": {"readout": 0.03}, "both": {"bodies": 4, "readout": 0.03},
    "radtan": {"bodies": 4, "camera": LENSES["radtan"]}, "fisheye": {"camera": LENSES["fisheye"]},
}  # fmt: skip


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
    assert shows(shot, TIMES[0], home, z, surface)[close < 1e-2].mean() > 0.99
    # On the grid of whole pixels: the flow back at the nearest pixel is minus the flow there, but for its own change.
    near = np.clip(target.round().astype(int), 0, [CAMERA.width - 1, CAMERA.height - 1])
    returned = back.flow[near[:, 1], near[:, 0]]
    assert np.median(np.linalg.norm(returned + there.flow[y, x], axis=-1)) < 0.1


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


def test_without_bodies_moving_pixels_the_static_flow_is_wrong(scene: Scene) -> None:
    shot = make_shot(scene, bodies=6)
    mask = dynamic_mask(shot, TIMES[0])
    assert 0.01 < mask.mean() < 0.7
    assert isinstance(shot.scene, Stage)
    pixels, depth, surface = hits(shot.sharp(TIMES[0]))
    assert np.array_equal(surface >= shot.scene.static, mask[depth.reshape(mask.shape) > 0])
    true, _ = shot.place(TIMES[1], shot.lift(TIMES[0], pixels, depth, surface), surface)
    nothing = np.zeros_like(surface)  # as if all belonged to the static scene
    static, _ = shot.place(TIMES[1], shot.lift(TIMES[0], pixels, depth, nothing), nothing)
    gap = np.linalg.norm(true - static, axis=-1)
    moving = surface >= shot.scene.static
    assert gap[~moving].max() < 1e-9 and np.median(gap[moving]) > 0.5
    assert np.array_equal(shot.scene.owner(np.array([-1, 0, shot.scene.static, shot.scene.starts[-1] - 1])),
                          [-1, 0, 1, len(shot.scene.bodies)])  # fmt: skip


def test_occluded_pixels_are_hidden_by_something_nearer(scene: Scene) -> None:
    shot = make_shot(scene, bodies=4)
    result = optical_flow(shot, 0.2, 0.8)
    hidden = result.inside & ~result.visible
    assert hidden.sum() > 20
    pixels, depth, surface = hits(shot.sharp(0.2))
    there, z = shot.place(0.8, shot.lift(0.2, pixels, depth, surface), surface)
    chosen = hidden[tuple(pixels[:, ::-1].astype(int).T)]
    seen, _, _ = shot.trace(0.8, there[chosen])
    one_sided = seen > z[chosen]  # its surface has turned its back
    assert (seen[~one_sided] < z[chosen][~one_sided]).all() and one_sided.mean() < 0.5


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


@pytest.mark.parametrize("kind", ["handheld", "rotation", "fast", "loop"])
def test_exact_imu_integrates_back_to_the_path(scene: Scene, kind: str) -> None:
    path = long_path(scene, 5, kind, 3.0)
    rate = 500.0
    middles = (np.arange(750) + 0.5) / rate
    imu = measure_imu(path, middles)
    ends = path.poses_wc(np.array([0.0, 1e-4, 1.5]))
    rotation, position = split(ends[0])
    velocity = (split(path.poses_wc(np.array([1e-4])))[1][0] - split(path.poses_wc(np.array([-1e-4])))[1][0]) / 2e-4
    for omega, force in zip(imu.gyro, imu.accel, strict=True):
        half = rotation @ so3_exp(omega * 0.5 / rate)
        acceleration = half @ force + GRAVITY
        position = position + velocity / rate + 0.5 * acceleration / rate**2
        velocity = velocity + acceleration / rate
        rotation = rotation @ so3_exp(omega / rate)
    target, there = split(ends[2])
    length = np.linalg.norm(np.diff(path.poses_wc(np.linspace(0, 1.5, 150))[:, :3], axis=0), axis=1).sum()
    assert np.linalg.norm(rotation_vector(target.T @ rotation)) < 1e-4
    assert np.linalg.norm(position - there) < 1e-3 * max(length, 0.3)


def test_imu_noise_and_rest(scene: Scene) -> None:
    pose = long_path(scene, 3, "handheld", 3.0).poses_wc(np.array([0.5]))[0]
    times = np.arange(20_000) / 200
    exact = measure_imu(Rest(pose), times)
    assert np.abs(exact.gyro).max() < 1e-9
    assert np.allclose(exact.accel, -quaternion_to_matrix(pose[3:]).T @ GRAVITY, atol=1e-5)
    noise = ImuNoise()
    noisy = measure_imu(Rest(pose), times, noise=noise, seed=3)
    white = noisy.gyro - exact.gyro - noisy.gyro_bias
    assert white.std() == pytest.approx(noise.gyro * np.sqrt(200), rel=0.02)
    assert np.diff(noisy.accel_bias, axis=0).std() == pytest.approx(noise.accel_walk / np.sqrt(200), rel=0.02)
    assert np.array_equal(noisy.accel, measure_imu(Rest(pose), times, noise=noise, seed=3).accel)
    assert not np.array_equal(noisy.accel, measure_imu(Rest(pose), times, noise=noise, seed=4).accel)
    with pytest.raises(DvoError, match="times"):
        measure_imu(Rest(pose), np.array([0, 0.1, 0.3]))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3), st.floats(-8, 0))
def test_rotation_vectors_survive(direction: list[float], power: float) -> None:
    phi = np.array(direction) * 10**power
    assert np.allclose(rotation_vector(so3_exp(phi)), phi, rtol=1e-6, atol=1e-15)


def test_second_camera_of_a_pair(scene: Scene) -> None:
    """Rectified stereo: what both see lies on one row, shifted by fx b / Z."""
    shot = Shot(scene, random_path(scene, 2, "handheld"), CAMERA)
    right = shot.beside(0.1)
    pixels, depth, surface = hits(shot.sharp(0.2))
    there, z = right.place(0.2, shot.lift(0.2, pixels, depth, surface), surface)
    assert np.allclose(there[:, 1], pixels[:, 1], atol=1e-6) and np.allclose(z, depth, rtol=1e-9)
    assert np.allclose(pixels[:, 0] - there[:, 0], CAMERA.fx * 0.1 / depth)
    assert shows(right, 0.2, there, z, surface).mean() > 0.5
    relative = compose(inverse(shot.path.poses_wc(np.zeros(1))), right.path.poses_wc(np.zeros(1)))[0]
    assert np.allclose(relative, [0.1, 0, 0, 0, 0, 0, 1], atol=1e-9)
