"""Films: sensor effects change what they should and nothing else; same seed, same bytes."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from dvo.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.synth import (
    LONG_KINDS,
    ImuNoise,
    Scene,
    Sensor,
    Stage,
    SyntheticSequence,
    film,
    long_path,
    make_sequence,
    random_scene,
    render,
)
from dvo.synth.clip import make_clip
from dvo.synth.poses import compose, inverse, split
from dvo.synth.scenes.bodies import Body
from dvo.synth.scenes.movers import random_bodies
from dvo.synth.sensors.sensor import compressed, expose, exposure_changes, in_the_dark, random_sensor, random_wear
from dvo.synth.sequence import APART
from dvo.synth.textures.pool import texture_pool
from dvo.synth.textures.repaint import plainer

SMALL: dict[str, Any] = {"frames": 12, "height": 60, "width": 80, "fps": 10.0, "family": "room"}
SEED = 4
EFFECTS: dict[str, dict[str, Any]] = {
    "blur": {"shutter": 0.8, "shake": 4.0}, "rolling": {"rolling_shutter": 0.9, "shake": 4.0}, "movers": {"movers": 3},
    "lighting": {"lighting": 2.0}, "dark": {"light": 0.05}, "blackout": {"blackout": 0.5}, "drop": {"drop": 0.3},
    "jpeg": {"jpeg": 20}, "bare": {"texture": 0.1}, "all": {
        "shutter": 0.5, "rolling_shutter": 0.5, "movers": 2, "lighting": 1.0, "light": 0.2, "drop": 0.2, "jpeg": 60,
        "blackout": 0.2,
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def plain() -> SyntheticSequence:
    return make_sequence(SEED, **SMALL)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(2, "room", pool=texture_pool(11, count=24, size=64))


def bytes_of(sequence: SyntheticSequence, indices: tuple[int, ...] = (0, 5, 7)) -> str:
    images = b"".join(sequence.frame(i).image.tobytes() for i in indices)
    return hashlib.sha256(images + sequence.groundtruth.poses_wc.tobytes()).hexdigest()


def test_sequences_without_effects_keep_their_bytes(plain: SyntheticSequence) -> None:
    """What the options do when off: nothing, down to the drawing of everything else."""
    off = {"shutter": 0.0, "rolling_shutter": 0.0, "movers": 0, "texture": 1.0, "lighting": 0.0, "light": 1.0,
           "blackout": 0.0, "drop": 0.0, "jpeg": 0, "shake": 1.0}  # fmt: skip
    assert bytes_of(make_sequence(SEED, **SMALL, **off)) == bytes_of(plain)
    bare = render(plain.scene, plain.groundtruth.poses_wc[:1], plain.camera.intrinsics, 60, 80)
    assert torch.equal(plain.rendering(0).images, bare.images) and torch.equal(plain.rendering(0).depth, bare.depth)


@pytest.mark.parametrize("name", EFFECTS)
def test_same_seed_same_bytes_whatever_the_effect(plain: SyntheticSequence, name: str) -> None:
    first, second = (make_sequence(SEED, **SMALL, **EFFECTS[name]) for _ in range(2))
    last = len(first) - 1
    backwards = [second.frame(i).image for i in (last, 5)][::-1]
    for index, image in zip((5, last), backwards, strict=True):
        assert np.array_equal(first.frame(index).image, image)
    assert not np.array_equal(first.frame(5).image, plain.frame(5).image), "the effect has no effect"


class _Frames(Dataset[torch.Tensor]):
    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> torch.Tensor:
        sequence = make_sequence(SEED, **{**SMALL, "height": 32, "width": 48}, **EFFECTS["all"])
        return torch.from_numpy(sequence.frame(index).image)


def test_workers_do_not_change_frames() -> None:
    alone = torch.stack([_Frames()[i] for i in range(4)])
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # forked workers must not inherit a pool of threads
    together = torch.cat(list(DataLoader(_Frames(), batch_size=2, num_workers=2)))
    torch.set_num_threads(threads)
    assert torch.equal(together, alone)


def test_blackout_is_dark_and_passes(plain: SyntheticSequence) -> None:
    sequence = make_sequence(SEED, **SMALL, blackout=0.5)
    means = np.array([frame.image.mean() for frame in sequence])
    times = sequence.groundtruth.timestamps
    dark = (times >= 0.35) & (times < 0.85)
    assert dark.sum() == 5 and means[dark].max() < 6 and means[~dark].min() > 25
    lit = int(np.flatnonzero(~dark)[0])
    assert np.array_equal(sequence.frame(lit).image, plain.frame(lit).image)


def test_dropped_frames_leave_gaps(plain: SyntheticSequence) -> None:
    sequence = make_sequence(SEED, **SMALL, drop=0.4)
    times = sequence.groundtruth.timestamps
    assert 3 <= len(times) < 12 and times[0] == 0
    at = np.searchsorted(plain.groundtruth.timestamps, times)
    assert np.array_equal(plain.groundtruth.timestamps[at], times)
    assert np.allclose(plain.groundtruth.poses_wc[at], sequence.groundtruth.poses_wc)
    assert [frame.timestamp for frame in sequence] == times.tolist()
    assert sequence.interval == pytest.approx(0.1), "shutter times follow the rate, not the gaps"


def test_exposure_changes_brightness_over_time() -> None:
    knots = exposure_changes(np.random.default_rng(3), 8.0, 2.0)
    when, level = np.array(knots).T
    assert (np.diff(when) > 0).all() and when[0] == 0
    assert np.abs(np.diff(level)).max() > 1.2, "no sudden change"
    assert np.abs(level[-1]) < 2.0
    grey = torch.full((3, 3, 8, 8), 0.1)
    sensor = Sensor(exposure=None, stops=((0.0, 0.0), (1.0, 1.0), (2.0, -1.0)))
    out = expose(grey, sensor, np.random.default_rng(0), times=np.array([0.0, 1.0, 2.0]))
    assert torch.allclose(out.mean((1, 2, 3)), torch.tensor([0.1, 0.2, 0.05]), rtol=1e-5)


def test_low_light_is_noisy_where_it_should_be() -> None:
    grey = torch.full((1, 3, 200, 200), 0.5)
    sensor = Sensor(exposure=None, shot=0.01, read=0.003)
    good = expose(grey, sensor, np.random.default_rng(0))
    poor = expose(grey, in_the_dark(sensor, 0.05), np.random.default_rng(0))
    gain = 0.05 * 14
    assert float(poor.mean()) == pytest.approx(0.5 * gain, rel=0.02)
    expected = np.sqrt(14 * 0.01**2 * 0.5 * gain + (14 * 0.003) ** 2)
    assert float(poor.std()) == pytest.approx(expected, rel=0.03)
    assert float(poor.std()) > 4 * float(good.std())


def test_jpeg_loses_detail_by_quality(plain: SyntheticSequence) -> None:
    images = torch.from_numpy(plain.frame(0).image).permute(2, 0, 1)[None].float() / 255
    errors = [float((compressed(images, quality) - images).abs().mean()) for quality in (95, 50, 10)]
    assert 0 < errors[0] < errors[1] < errors[2] < 0.1


def test_bare_scenes_have_less_texture_and_the_same_geometry(scene: Scene) -> None:
    path = long_path(scene, 1, "handheld", 2.0)
    camera, times = Camera(70, 70, 39.5, 29.5, 80, 60), np.array([0.3, 1.5])
    full, bare = (film(s, path, camera, times=times).rendering(0) for s in (scene, plainer(scene, 0.1, 0)))
    assert torch.equal(full.surface, bare.surface) and torch.equal(full.depth, bare.depth)

    def detail(images: torch.Tensor) -> float:
        same = (full.surface[..., 1:] == full.surface[..., :-1])[:, None]
        return float(((images[..., 1:] - images[..., :-1]).abs() * same).mean())

    assert detail(bare.images) < 0.35 * detail(full.images)
    assert float((bare.images.mean() - full.images.mean()).abs()) < 0.05


def test_bodies_move_rigidly_and_keep_off_the_camera(scene: Scene) -> None:
    path = long_path(scene, 1, "handheld", 4.0)
    bodies = random_bodies(scene, path, 4.0, 7, 4)
    times = np.linspace(0, 4, 81)
    assert len(bodies) == 4
    for body in bodies:
        poses = body.motion.poses_wc(times)
        assert (np.linalg.norm(poses[:, :3] - path.poses_wc(times)[:, :3], axis=1) > body.radius).all()
        assert np.linalg.norm(np.ptp(poses[:, :3], axis=0)) > 0.3 * body.radius, "it does not move"
        step = split(compose(inverse(poses[:-1]), poses[1:]))[1]
        assert np.linalg.norm(np.diff(step, axis=0), axis=1).max() < 0.1 * body.radius, "it jumps"
    camera = Camera(70, 70, 39.5, 29.5, 80, 60)
    moving = film(Stage(scene, bodies), path, camera, times=times[::8])
    shares = [moving.dynamic_mask(i).mean() for i in range(len(moving))]
    assert np.mean(shares) > 0.01 and max(shares) < 0.9
    assert not film(scene, path, camera, times=times[::8]).dynamic_mask(0).any()
    with pytest.raises(DvoError, match="times"):
        render(Stage(scene, bodies), path.poses_wc(np.zeros(1)), camera.intrinsics, 60, 80)
    with pytest.raises(ValueError, match="pool"):
        stranger = Body(random_scene(2, "room", pool=texture_pool(12, count=24, size=64)), bodies[0].motion)
        _ = Stage(scene, (stranger,)).surfaces


def test_body_at_rest_is_part_of_the_scene(scene: Scene) -> None:
    """Half of a scene as a body that stands still gives the picture of the whole scene."""
    from dataclasses import replace

    from dvo.synth.render.shot import Rest
    from dvo.synth.scenes.bodies import PER_SURFACE

    def part(start: int, end: int) -> Scene:
        return replace(scene, **{name: getattr(scene, name)[start:end] for name in PER_SURFACE}, _cache={})

    half = len(scene) // 2
    stage = Stage(part(0, half), (Body(part(half, len(scene)), Rest(np.array([0, 0, 0, 0, 0, 0, 1.0]))),))
    poses = long_path(scene, 1, "handheld", 2.0).poses_wc(np.array([0.3, 1.5]))
    k = np.array([70, 70, 39.5, 29.5])
    whole, staged = render(scene, poses, k, 60, 80), render(stage, poses, k, 60, 80, times=np.zeros(2))
    assert (whole.surface == staged.surface).float().mean() > 0.999
    assert ((whole.images - staged.images).abs() > 1e-3).float().mean() < 0.002


@pytest.mark.parametrize("kind", [kind for kind in LONG_KINDS if kind in ("loop", "straight", "fast")])
@pytest.mark.parametrize("family", ["room", "street", "clutter"])
def test_long_kinds_do_what_they_say(kind: str, family: str) -> None:
    scene = random_scene(2, family, pool=texture_pool(11, count=24, size=64))
    path = long_path(scene, 1, kind, 8.0, speed=1.5)
    times = np.linspace(0, 8, 161)
    poses = path.poses_wc(times)
    assert scene.clearance(poses[:, :3]).min() > 0.02 * scene.scale
    length = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1).sum()
    if kind == "loop":  # the second round passes where the first did, and looks the same way
        lap = 8.0 / 1.4
        again = path.poses_wc(np.array([0.5 + lap]))[0]
        first = path.poses_wc(np.array([0.5]))[0]
        assert np.linalg.norm(again[:3] - first[:3]) < 0.1 * length
        angle = 2 * np.arccos(min(1.0, abs(float(again[3:] @ first[3:]))))
        assert angle < 0.2
    elif kind == "straight":
        assert np.linalg.norm(poses[-1, :3] - poses[0, :3]) > 0.8 * length
    else:
        calm = long_path(scene, 1, "handheld", 8.0).poses_wc(times)
        turns = [np.linalg.norm(np.diff(p[:, 3:], axis=0), axis=1).mean() for p in (poses, calm)]
        assert turns[0] > 1.5 * turns[1]


def test_sensor_wear_of_clips_is_rare_and_has_its_own_draws() -> None:
    worn = [random_wear(np.random.default_rng([0, 7302, i]), Sensor(), 1.0) for i in range(400)]
    assert 0.05 < np.mean([sensor != Sensor() for sensor in worn]) < 0.15
    assert all(30 <= sensor.jpeg < 95 or sensor.jpeg == 0 for sensor in worn)
    assert random_sensor(np.random.default_rng(0)).stops == ()
    index = next(i for i, sensor in enumerate(worn[:60]) if sensor.jpeg)
    clip, clean = (make_clip(0, index, frames=2, height=60, width=80, flow_range=(1.0, 8.0), sensor=on)
                   for on in (True, False))  # fmt: skip
    assert torch.equal(clip.depth, clean.depth) and not torch.equal(clip.images, clean.images)


def test_scenes_apart_are_none_that_training_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = []

    def spy(seed: int, *given: Any, **options: Any) -> Scene:
        seeds.append(seed)
        return random_scene(seed, *given, **options)

    monkeypatch.setattr("dvo.synth.sequence.random_scene", spy)
    make_sequence(SEED, **SMALL, apart=True)
    make_sequence(SEED, **SMALL)
    assert seeds[0] >= APART > seeds[1], "training draws scene seeds below APART"


def test_film_is_the_whole_call(scene: Scene) -> None:
    path = long_path(scene, 1, "handheld", 2.0)
    camera = Camera(70, 70, 39.5, 29.5, 80, 60)
    clip = film(scene, path, camera, Sensor(shutter=0.3), 5, "cpu", times=np.arange(4) / 10)
    assert len(clip) == 4 and clip.frame(2).image.shape == (60, 80, 3)
    assert np.allclose(clip.groundtruth.poses_wc, path.poses_wc(np.arange(4) / 10))
    assert clip.flow(0, 1).flow.shape == (60, 80, 2)
    assert clip.shot.exposure == pytest.approx(0.03)
    assert len(clip.imu(100.0).timestamps) == 31 and clip.imu(100.0, noise=ImuNoise()).gyro.shape == (31, 3)
    right = clip.stereo(0.1)
    assert not np.array_equal(right.frame(0).image, clip.frame(0).image)
    assert np.allclose(np.linalg.norm(right.groundtruth.positions - clip.groundtruth.positions, axis=1), 0.1)
    with pytest.raises(DvoError, match="times"):
        film(scene, path, camera, times=np.array([0.2, 0.1]))


@pytest.mark.parametrize("bad", [{"shutter": 1.5}, {"light": 0.0}, {"jpeg": 101}, {"blackout": 9.0}, {"movers": -1}])
def test_options_out_of_range(bad: dict[str, Any]) -> None:
    with pytest.raises(DvoError, match=next(iter(bad))):
        make_sequence(SEED, **SMALL, **bad)
