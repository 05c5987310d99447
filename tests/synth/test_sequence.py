"""Sequences: a source of frames, effects, determinism."""

from __future__ import annotations

import hashlib
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.synth import (
    ImuNoise,
    Scene,
    Sensor,
    SyntheticSequence,
    film,
    long_path,
    make_sequence,
    random_scene,
    render,
)
from dvo.synth.sequence import APART
from dvo.synth.textures.texture import texture_pool

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


class _Frames(Dataset[torch.Tensor]):
    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> torch.Tensor:
        sequence = make_sequence(SEED, **{**SMALL, "height": 32, "width": 48}, **EFFECTS["all"])
        return torch.from_numpy(sequence.frame(index).image)


@pytest.mark.long
def test_sequence_is_a_source_of_frames() -> None:
    sequence = make_sequence(4, frames=5, height=48, width=64, fps=10, family="room")
    frames = list(sequence)
    assert len(frames) == len(sequence) == sequence.frame_count == 5
    assert [frame.index for frame in frames] == list(range(5))
    assert [frame.timestamp for frame in frames] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert all(frame.image.shape == (48, 64, 3) and frame.image.dtype == np.uint8 for frame in frames)
    assert np.array_equal(sequence.frame(3).image, frames[3].image), "frames depend on the order of reading"
    assert np.array_equal(sequence.groundtruth.timestamps, [frame.timestamp for frame in frames])
    assert sequence.groundtruth.path_length > 0.01
    again = make_sequence(4, frames=5, height=48, width=64, fps=10, family="room")
    assert np.array_equal(again.frame(2).image, frames[2].image)
    with pytest.raises(DvoError, match="frames"):
        make_sequence(0, frames=0)
    with pytest.raises(DvoError, match="kind"):
        make_sequence(4, frames=5, height=48, width=64, family="room", kind="teleport")


def test_sequences_without_effects_keep_their_bytes(plain: SyntheticSequence) -> None:
    """Options at their neutral values change nothing, not even the draws of everything else."""
    off = {"shutter": 0.0, "rolling_shutter": 0.0, "movers": 0, "texture": 1.0, "lighting": 0.0, "light": 1.0,
           "blackout": 0.0, "drop": 0.0, "jpeg": 0, "shake": 1.0}  # fmt: skip
    assert bytes_of(make_sequence(SEED, **SMALL, **off)) == bytes_of(plain)
    bare = render(plain.scene, plain.groundtruth.poses_wc[:1], plain.camera.intrinsics, 60, 80)
    assert torch.equal(plain.rendering(0).images, bare.images) and torch.equal(plain.rendering(0).depth, bare.depth)


@pytest.mark.long
@pytest.mark.parametrize("name", EFFECTS)
def test_same_seed_same_bytes_whatever_the_effect(plain: SyntheticSequence, name: str) -> None:
    first, second = (make_sequence(SEED, **SMALL, **EFFECTS[name]) for _ in range(2))
    last = len(first) - 1
    backwards = [second.frame(i).image for i in (last, 5)][::-1]
    for index, image in zip((5, last), backwards, strict=True):
        assert np.array_equal(first.frame(index).image, image)
    assert not np.array_equal(first.frame(5).image, plain.frame(5).image), "the effect has no effect"


@pytest.mark.long
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


@pytest.mark.parametrize(
    "bad",
    [
        {"shutter": 1.5},
        {"light": 0.0},
        {"jpeg": 101},
        {"h264": 52},
        {"stabilised": 0.5},
        {"blackout": 9.0},
        {"movers": -1},
    ],
)
def test_options_out_of_range(bad: dict[str, Any]) -> None:
    with pytest.raises(DvoError, match=next(iter(bad))):
        make_sequence(SEED, **SMALL, **bad)


def test_the_crop_of_a_stabilised_video_floats() -> None:
    """By whole pixels of a textured wall: the picture moves, the camera that frames state does not."""
    still = {**SMALL, "speed": 0.0, "shake": 0.0, "kind": "handheld"}
    floats, rests = (make_sequence(SEED, stabilised=amplitude, **still) for amplitude in (0.05, 0.0))
    assert floats.sensor is not None and floats.camera == rests.camera == floats.frame(2).camera
    offsets = floats.sensor.crop_offsets(floats.groundtruth.timestamps, floats.camera.width)
    assert 0.5 < offsets.std(0).max() < 0.15 * floats.camera.width
    for index in (0, 5):
        dx, dy = offsets[index]
        grid = np.float32([[1, 0, -dx], [0, 1, -dy]])
        size = floats.camera.width, floats.camera.height
        inverse = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
        moved = cv2.warpAffine(rests.rendering(index).images[0].permute(1, 2, 0).numpy(), grid, size, flags=inverse)
        seen = floats.rendering(index).images[0].permute(1, 2, 0).numpy()
        inner = (slice(10, -10), slice(10, -10))
        assert np.median(np.abs(moved - seen)[inner]) < 0.02


def test_frames_state_their_readout(plain: SyntheticSequence, scene: Scene) -> None:
    assert plain.camera.readout == plain.frame(0).camera.readout == 0
    rolling = make_sequence(SEED, **SMALL, rolling_shutter=0.4)
    assert rolling.frame(3).camera.readout == rolling.camera.readout == rolling.shot.readout == pytest.approx(0.04)
    assert rolling.stereo(0.1).frame(0).camera.readout == rolling.camera.readout
    # what was rendered counts, not what the given camera says; lost frames do not lengthen the interval
    path, camera = long_path(scene, 0, "handheld", duration=1.0), Camera(60, 60, 31.5, 23.5, 64, 48, readout=0.5)
    times = np.arange(10) / 20
    assert film(scene, path, camera, times=times).frame(0).camera.readout == 0
    filmed = film(scene, path, camera, Sensor(readout=0.5, drop=0.6), times=times)
    assert len(filmed) < 8 and filmed.camera.readout == pytest.approx(0.025)
