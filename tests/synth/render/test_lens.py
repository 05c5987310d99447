"""Images through a lens with distortion (test_truth checks that the flow is exact through it)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data.open import open_source
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import Undistorter
from dvo.odometry.frames.gate import working_image
from dvo.synth import Shot, make_sequence, mesh_scene, random_path, random_scene, render, trace
from dvo.synth.export import export_sequence
from dvo.synth.render.lens import distorted_pixels, plate_of, random_lens, render_lens, undistorted_pixels
from dvo.synth.render.quality import Quality
from dvo.synth.sensors.sensor import random_intrinsics
from dvo.synth.textures.texture import texture_pool

CAMERA = Camera(130.0, 129.0, 81.0, 58.5, 160, 120)
LENSES = {
    "radtan": replace(CAMERA, model="radtan", coefficients=(-0.2, 0.03, 1e-3, -8e-4)),
    "cushion": replace(CAMERA, model="radtan", coefficients=(0.1, 0.0, 0.0, 0.0)),
    "fisheye": replace(CAMERA, model="fisheye", coefficients=(0.02, -0.004, 0.0, 0.0)),
}


def scene_and_pose():
    scene = random_scene(6, "room", pool=texture_pool(5))
    return scene, random_path(scene, 1, "handheld").poses_wc(np.array([0.3]))


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from(["radtan", "fisheye"]), st.sampled_from([(120, 160), (240, 320)]))
def test_every_drawn_lens_has_a_ray_for_every_pixel(seed, model, size):
    rng = np.random.default_rng(seed)
    fx, fy, cx, cy = random_intrinsics(rng, *size)
    camera = random_lens(rng, Camera(fx, fy, cx, cy, size[1], size[0]), model)
    edge = np.array([[-0.5, -0.5], [size[1] - 0.5, -0.5], [-0.5, size[0] - 0.5], [size[1] - 0.5, size[0] - 0.5]])
    inner = rng.uniform(0, 1, (50, 2)) * [size[1], size[0]] - 0.5
    pixels = np.concatenate([edge, inner])
    ideal = undistorted_pixels(pixels, camera)
    assert np.isfinite(ideal).all() and np.abs(distorted_pixels(ideal, camera) - pixels).max() < 1e-6
    assert camera.is_distorted


@pytest.mark.long
@pytest.mark.parametrize("lens", LENSES)
def test_depth_and_surfaces_are_those_of_the_bent_rays(lens):
    """Each pixel against a ray of its own, cast by a pinhole camera."""
    camera, (scene, pose) = LENSES[lens], scene_and_pose()
    got = render_lens(scene, pose, camera)
    y, x = np.mgrid[: camera.height : 3, : camera.width : 3]
    rays = undistorted_pixels(np.stack([x.ravel(), y.ravel()], -1).astype(float), camera)
    depth, surface, uv = trace(scene, pose, CAMERA.intrinsics, rays[None])
    same = got.surface[0].numpy()[y.ravel(), x.ravel()] == surface[0]
    assert same.mean() > 0.999
    np.testing.assert_allclose(got.depth[0].numpy()[y.ravel(), x.ravel()][same], depth[0][same], rtol=1e-5)
    np.testing.assert_allclose(got.uv[0].numpy()[y.ravel(), x.ravel()][same], uv[0][same], atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("lens", LENSES)
def test_undistorted_it_is_the_picture_without_a_lens(lens):
    """OpenCV's maps, which know nothing of the renderer, take the picture back to a pinhole's."""
    camera, (scene, pose) = LENSES[lens], scene_and_pose()
    undistorter = Undistorter(camera)
    image = (render_lens(scene, pose, camera).images[0] * 255).round().permute(1, 2, 0).byte().numpy()
    back = undistorter(image).astype(float)
    pinhole = undistorter.camera

    def error(picture: np.ndarray, shift: float = 0.0) -> np.ndarray:
        k = pinhole.intrinsics + np.array([0, 0, shift, shift])
        plain = render(scene, pose, k, pinhole.height, pinhole.width, quality=Quality(2)).images[0]
        return np.abs(picture - 255 * plain.permute(1, 2, 0).numpy())

    assert np.median(error(back)) < 1.5 and error(back).mean() < 0.45 * error(image).mean()
    # Resampling twice softens edges, so the mean is no measure of geometry; that a quarter pixel makes it worse, is.
    assert error(back).mean() < 0.85 * min(error(back, -0.25).mean(), error(back, 0.25).mean())


def test_no_lens_is_the_pinhole_picture():
    scene, pose = scene_and_pose()
    faint = replace(CAMERA, model="radtan", coefficients=(1e-12, 0.0, 0.0, 0.0))
    got, plain = render_lens(scene, pose, faint), render(scene, pose, CAMERA.intrinsics, 120, 160, quality=Quality(2))
    assert np.abs(got.images.numpy() - plain.images.numpy()).mean() < 0.5 / 255  # outlines are smoothed otherwise
    np.testing.assert_allclose(got.depth.numpy(), plain.depth.numpy(), rtol=1e-5)


@pytest.mark.long
def test_what_no_plane_can_hold_is_refused():
    with pytest.raises(DvoError, match="fold the 160x120 picture"):
        plate_of(replace(CAMERA, model="radtan", coefficients=(-2.0, 0.0, 0.0, 0.0)), 2)
    with pytest.raises(DvoError, match="nearly sideways"):
        plate_of(Camera(60.0, 60.0, 80.0, 60.0, 160, 120, "fisheye", (0.0, 0.0, 0.0, 0.0)), 2)
    scene, _ = scene_and_pose()
    with pytest.raises(DvoError, match="rolling shutter"):
        Shot(scene, random_path(scene, 0, "handheld"), LENSES["radtan"], readout=0.01)
    trimesh = pytest.importorskip("trimesh")
    with pytest.raises(DvoError, match="meshes"):
        render_lens(mesh_scene(trimesh.creation.box()), np.array([[0, 0, 3, 1.0, 0, 0, 0]]), LENSES["radtan"])


def test_behind_the_lens_range_nothing_is_in_the_picture():
    """A point far aside, which the folded polynomial would put into the middle of the picture."""
    camera, (scene, _) = LENSES["radtan"], scene_and_pose()
    shot = Shot(scene, random_path(scene, 1, "handheld"), camera)
    folded = camera.fx * np.array([[2.2, 0.0]]) + [camera.cx, camera.cy]
    assert not shot.inside(distorted_pixels(folded, camera), np.array([1.0])).any()


@pytest.mark.long
@pytest.mark.parametrize("model", ["radtan", "fisheye"])
def test_a_sequence_through_a_lens_is_read_back(model, tmp_path):
    sequence = make_sequence(3, frames=3, height=96, width=128, fps=10, family="room", lens=model)
    assert sequence.camera.model == model
    export_sequence(sequence, tmp_path / "out", "tum")
    source = open_source(tmp_path / "out")
    assert source.recorded_camera.model == model and not source.camera.is_distorted
    np.testing.assert_allclose(source.recorded_camera.coefficients, sequence.camera.coefficients, atol=1e-8)
    first = next(iter(source))
    assert working_image(first, 0)[1].model == "none"
    with pytest.raises(DvoError, match="distortion cannot be tracked"):
        working_image(sequence.frame(0), 0)
    with pytest.raises(DvoError, match="TartanAir"):
        export_sequence(sequence, tmp_path / "other", "tartanair")


def test_a_blurred_frame_through_a_lens():
    sharp, blurred = (
        make_sequence(3, frames=2, height=96, width=128, fps=5, family="room", lens="radtan", sensor=True, shutter=s)
        for s in (0.0, 0.9)
    )
    pictures = [s.rendering(1) for s in (sharp, blurred)]
    assert (pictures[0].depth == pictures[1].depth).all()
    detail = [float(p.images.diff(dim=-1).abs().mean()) for p in pictures]
    assert detail[1] < 0.9 * detail[0]
