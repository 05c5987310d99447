"""Sequences: video of any length, rendered frame by frame, with its ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.synth import salts
from dvo.synth.motion.movers import random_bodies
from dvo.synth.motion.natural import NATURAL_KINDS, natural_path
from dvo.synth.motion.walks import long_path
from dvo.synth.protocols import Motion
from dvo.synth.render.lens import random_lens
from dvo.synth.render.renderer import Rendering, render
from dvo.synth.render.shot import Offset, Shot
from dvo.synth.scenes.bodies import Stage
from dvo.synth.scenes.families import random_scene
from dvo.synth.scenes.repaint import reduce_texture
from dvo.synth.scenes.scene import Scene
from dvo.synth.sensors.imu import Imu, ImuNoise, measure_imu
from dvo.synth.sensors.sensor import (
    Sensor,
    expose,
    exposure_changes,
    floating_crop,
    low_light,
    random_intrinsics,
    random_sensor,
)
from dvo.synth.sensors.video_codec import LENGTH, compressed_video
from dvo.synth.specs import CameraSpec, SequenceSpec, sequence_spec
from dvo.synth.surroundings import Drawing, draw_over, drawings
from dvo.synth.textures.texture import texture_pool
from dvo.synth.truth import Flow, Tracks, dynamic_mask, optical_flow, tracks

APART = 2**31  # training clips draw their scene seeds below this number


@dataclass
class SyntheticSequence:
    """Source of frames with ground truth. It can be iterated any number of times; every pass gives the same bytes.

    Timestamps and poses are those of the middle of the exposure, with a rolling shutter those of the middle row;
    :mod:`dvo.synth.render.shot` states the consequences for depth and flow. Flow and tracks are those without
    surroundings and with the crop at rest.

    Attributes:
        name: family, kind of path and seed.
        camera: intrinsics and distortion of every frame, and the readout of ``sensor`` whatever readout was given.
        groundtruth: camera-to-world poses, one per frame, metres.
        scene, path: scene and camera path that are rendered.
        sensor: None for clean frames; its exposure is fixed, its shutter and readout are shares of ``interval``.
        seed: of the noise.
        supersample: rays per pixel edge for the colours.
        device: where frames are rendered.
        warnings: always empty; part of the interface of a source.
        interval: seconds between frames (where none was lost).
        surroundings: drawn over the scene (:mod:`dvo.synth.surroundings`), as they are at the time of the frame.

    Example:
        >>> sequence = make_sequence(0, frames=10, family="room")
        >>> frame, depth = sequence.frame(3), sequence.rendering(3).depth
    """

    name: str
    camera: Camera
    groundtruth: Trajectory
    scene: Scene | Stage
    path: Motion
    sensor: Sensor | None
    seed: int
    supersample: int = 1
    device: torch.device | str = "cpu"
    warnings: list[str] = field(default_factory=list)
    interval: float = 1 / 30
    surroundings: tuple[Drawing, ...] = ()
    _decoded: tuple[int, np.ndarray] | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        readout = (self.sensor or Sensor()).readout * self.interval
        self.camera = replace(self.camera, readout=readout)

    @property
    def frame_count(self) -> int | None:
        """Number of frames."""
        return len(self.groundtruth)

    def __len__(self) -> int:
        return len(self.groundtruth)

    @property
    def shot(self) -> Shot:
        """Scene, path and shutter, for ground truth at any time."""
        exposure = (self.sensor or Sensor()).shutter * self.interval
        return Shot(self.scene, self.path, self.camera, exposure, self.camera.readout, self.supersample, self.device)

    def time(self, index: int) -> float:
        """Timestamp of a frame, seconds.

        Args:
            index: of the frame.

        Returns:
            Seconds.
        """
        return float(self.groundtruth.timestamps[index])

    def rendering(self, index: int, *, coordinates: bool = True) -> Rendering:
        """Clean image, depth, surfaces and texture coordinates of one frame (batch of 1).

        Args:
            index: of the frame.
            coordinates: fill the texture coordinates too.

        Returns:
            Batch of one.
        """
        shot = replace(self.shot, camera=self._cropped(index))
        return shot.rendering(self.time(index), self.groundtruth.poses_wc[index : index + 1], coordinates)

    def _cropped(self, index: int) -> Camera:
        """Camera with its principal point where the crop of a stabilised video has it."""
        x, y = (self.sensor or Sensor()).crop_offsets(np.array([self.time(index)]), self.camera.width)[0].tolist()
        return replace(self.camera, cx=self.camera.cx + x, cy=self.camera.cy + y)

    def frame(self, index: int) -> Frame:
        """One frame as the camera delivers it, with the sensor's noise.

        Args:
            index: of the frame.

        Returns:
            Image ``(H, W, 3)`` uint8 RGB, timestamp and camera.
        """
        if self.sensor is None or not self.sensor.h264:
            return Frame(index, self.time(index), self._exposed(index), self.camera)
        return Frame(index, self.time(index), self._video(index // LENGTH)[index % LENGTH], self.camera)

    def _exposed(self, index: int) -> np.ndarray:
        """Image ``(H, W, 3)`` of the sensor."""
        if self.sensor is not None and bool(self.sensor.dark(self.groundtruth.timestamps[index : index + 1])[0]):
            images = torch.zeros(1, 3, self.camera.height, self.camera.width)  # whatever is there, it is not seen
        else:
            rendered = self.rendering(index, coordinates=False)
            images = self._covered(index, rendered)[0] if self.surroundings else rendered.images
        if self.sensor is not None:
            rng = np.random.default_rng([self.seed, salts.NOISE, index])
            images = expose(images, self.sensor, rng, times=self.groundtruth.timestamps[index : index + 1])
        return (images[0] * 255).round_().to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()

    def _video(self, part: int) -> np.ndarray:
        """Images of a part of the video ``(N, H, W, 3)`` after its compression; the last one is kept."""
        if self._decoded is None or self._decoded[0] != part:
            assert self.sensor is not None
            frames = range(part * LENGTH, min((part + 1) * LENGTH, len(self)))
            images = compressed_video(np.stack([self._exposed(k) for k in frames]), self.sensor.h264)
            self._decoded = part, images
        return self._decoded[1]

    def _covered(self, index: int, rendered: Rendering) -> tuple[torch.Tensor, np.ndarray]:
        """Image ``(1, 3, H, W)`` with the surroundings, and the pixels ``(H, W)`` that they cover."""
        pose = self.groundtruth.poses_wc[index]
        image, covered = draw_over(
            self.surroundings, rendered.images[0], rendered.depth[0], pose, self._cropped(index), self.time(index)
        )
        return image[None], covered

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in range(len(self)))

    def flow(self, start: int, end: int) -> Flow:
        """Optical flow and visibility from frame ``start`` to frame ``end``, see :func:`dvo.synth.optical_flow`.

        Args:
            start, end: indices of the frames.

        Returns:
            Flow of every pixel of the first frame.
        """
        return optical_flow(self.shot, self.time(start), self.time(end))

    def dynamic_mask(self, index: int) -> np.ndarray:
        """``(H, W)`` bool: pixels that show a moving body, or surroundings.

        Args:
            index: of the frame.

        Returns:
            ``(H, W)`` bool.
        """
        moving = dynamic_mask(self.shot, self.time(index))
        return moving | self._covered(index, self.rendering(index))[1] if self.surroundings else moving

    def tracks(self, count: int = 200, *, seed: int = 0) -> Tracks:
        """``count`` surface points followed through all frames, see :func:`dvo.synth.tracks`.

        Args:
            count: number of points.
            seed: same seed, same points.

        Returns:
            The tracks.
        """
        return tracks(self.shot, self.groundtruth.timestamps, count, seed=seed)

    def imu(
        self, rate: float = 200.0, *, noise: ImuNoise | None = None, seed: int | None = None,
        T_camera_imu: np.ndarray | None = None, margin: float = 0.0,
    ) -> Imu:  # fmt: skip
        """Inertial measurements from the first frame to the last.

        Args:
            rate: samples per second.
            noise: None for exact measurements.
            seed: of the noise; that of the sequence if None.
            T_camera_imu: ``(7,)`` pose of the sensor in the camera, metres; at the camera and with its axes if None.
            margin: seconds before the first frame and after the last one that are measured too; the path has to go on.

        Returns:
            The samples, in the frame of the sensor.
        """
        first, last = self.time(0) - margin, self.time(-1) + margin
        times = first + np.arange(int(np.floor((last - first) * rate + 1e-9)) + 1) / rate
        path = self.path if T_camera_imu is None else Offset(self.path, T_camera_imu)
        return measure_imu(path, times, noise=noise, seed=self.seed if seed is None else seed)

    def stereo(self, baseline: float) -> SyntheticSequence:
        """Second camera of a rectified stereo pair, ``baseline`` metres to the right, with noise of its own.

        Args:
            baseline: distance to the right, metres.

        Returns:
            Sequence of the right camera.
        """
        second = self.shot.beside(baseline).path
        truth = Trajectory(self.groundtruth.timestamps, second.poses_wc(self.groundtruth.timestamps))
        return replace(
            self, name=f"{self.name}-right", path=second, groundtruth=truth, seed=self.seed + 2**32, warnings=[]
        )


def film(
    scene: Scene | Stage, path: Motion, camera: Camera, sensor: Sensor | None = None, seed: int = 0,
    device: torch.device | str = "cpu", *, times: np.ndarray, supersample: int = 1, name: str = "film",
    surroundings: str = "",
) -> SyntheticSequence:  # fmt: skip
    """Sequence of a given scene and camera path.

    Args:
        scene: static, or a :class:`Stage` with moving bodies.
        path: camera to world, anything with ``poses_wc(times)``: :class:`Path`, :class:`SplinePath`, your own.
        camera: intrinsics, distortion and image size; its readout is replaced with that of the sensor.
        sensor: None for clean frames. An automatic exposure is measured on a few frames and then held.
        seed: of noise and lost frames: same arguments, same bytes (on one machine).
        device: where to render.
        times: ``(N,)`` increasing timestamps of the frames, seconds.
        supersample: rays per pixel edge for the colours.
        name: of the sequence.
        surroundings: names of what is drawn over the scene, see :class:`dvo.synth.specs.SceneSpec`.

    Returns:
        The sequence; its frames are rendered when they are read.

    Raises:
        DvoError: times that do not increase.

    Example:
        >>> scene = random_scene(0, "room")
        >>> path = long_path(scene, 0, "handheld", duration=2.0)
        >>> sequence = film(scene, path, Camera(160, 160, 79.5, 59.5, 160, 120), times=np.arange(60) / 30)
    """
    times = np.asarray(times, float)
    if times.ndim != 1 or len(times) == 0 or not (np.diff(times) > 0).all():
        raise DvoError("times of frames must increase", field="times", remedy="give np.arange(N) / fps")
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1 / 30
    if sensor is not None:
        bare = scene.scene if isinstance(scene, Stage) else scene
        sensor = fixed_exposure(sensor, bare, path.poses_wc(times[:: max(1, len(times) // 6)]), camera)
        if sensor.drop > 0:
            kept = np.random.default_rng([seed, salts.DROPPED]).random(len(times)) >= sensor.drop
            kept[0] = True
            times = times[kept]
    truth = Trajectory(times, path.poses_wc(times))
    return SyntheticSequence(
        name, camera, truth, scene, path, sensor, seed, supersample, device, interval=interval,
        surroundings=drawings(surroundings, seed, truth.positions.mean(0)),
    )  # fmt: skip


def make_sequence(
    seed: int, spec: SequenceSpec | None = None, *, device: torch.device | str = "cpu", **options: Any
) -> SyntheticSequence:
    """Sequence with a smooth camera path through one random scene.

    Args:
        seed: same seed and specification, same bytes (on one machine).
        spec: format, scene, motion and camera; the defaults if None.
        device: where to render.
        options: single settings by flat name that replace those of ``spec``, see :func:`dvo.synth.sequence_spec`.

    Returns:
        The sequence; its frames are rendered when they are read.

    Raises:
        DvoError: an unknown family, kind of path or option, or a number out of range.

    Example:
        >>> walk = make_sequence(0, frames=60, family="room", kind="handheld")
        >>> spec = SequenceSpec(SequenceFormat(frames=60), SceneSpec("street"), camera=CameraSpec(shutter=0.5))
        >>> blurred = make_sequence(0, spec)
    """
    spec = sequence_spec(spec, **options)
    form, duration = spec.format, spec.format.duration
    # The order of the draws is fixed: scene, path, intrinsics, sensor. Everything else has a stream of its own.
    rng = np.random.default_rng([seed, salts.SEQUENCE])
    pool = texture_pool(seed, folder=spec.scene.textures)
    scene_seed = int(rng.integers(2**31)) + (APART if spec.scene.apart else 0)
    scene = random_scene(scene_seed, spec.scene.family, pool=pool)
    kind = spec.motion.kind or ("forward" if scene.hints.get("heading") is not None else "handheld")
    path_seed = int(rng.integers(2**31))
    plan = natural_path if kind in NATURAL_KINDS else long_path
    path = plan(scene, path_seed, kind, duration, speed=spec.motion.speed, shake=spec.motion.shake)
    fx, fy, cx, cy = random_intrinsics(rng, form.height, form.width).tolist()
    pinhole = Camera(fx, fy, cx, cy, form.width, form.height)
    camera = random_lens(np.random.default_rng([seed, salts.LENS]), pinhole, spec.camera.lens)
    sensor = _apply_effects(random_sensor(rng), spec.camera, seed, duration)
    if spec.scene.texture < 1:
        scene = reduce_texture(scene, spec.scene.texture, seed)
    movers = spec.scene.movers
    stage = Stage(scene, random_bodies(scene, path, duration, seed, movers)) if movers else scene
    return film(
        stage, path, camera, sensor if spec.camera.sensor else None, seed, device,
        times=np.arange(form.frames) / form.fps, supersample=form.supersample, name=f"{scene.family}-{kind}-{seed}",
        surroundings=spec.scene.surroundings,
    )  # fmt: skip


def _apply_effects(sensor: Sensor, spec: CameraSpec, seed: int, duration: float) -> Sensor:
    """Sensor with the effects of a specification."""
    sensor = replace(
        sensor, shutter=spec.shutter, readout=spec.rolling_shutter, drop=spec.drop, jpeg=spec.jpeg, h264=spec.h264
    )
    if spec.stabilised > 0:
        rng = np.random.default_rng([seed, salts.CROP])
        sensor = replace(sensor, crop=floating_crop(rng, duration, spec.stabilised))
    if spec.lighting > 0:
        rng = np.random.default_rng([seed, salts.LIGHTING])
        sensor = replace(sensor, stops=exposure_changes(rng, duration, spec.lighting))
    if spec.light < 1:
        sensor = low_light(sensor, spec.light)
    if spec.blackout > 0:
        sensor = replace(sensor, blackout=(((duration - spec.blackout) / 2, (duration + spec.blackout) / 2),))
    return sensor


def fixed_exposure(sensor: Sensor, scene: Scene, poses_wc: np.ndarray, camera: Camera) -> Sensor:
    """Sensor with its automatic exposure held at the mean brightness of some views.

    Args:
        sensor: with an exposure to reach, or None.
        scene: static scene.
        poses_wc: ``(N, 7)`` camera to world of the views.
        camera: intrinsics; the views are rendered at 40x30 pixels.

    Returns:
        Sensor without automatic exposure and flicker, its colour gains scaled instead.
    """
    small = camera.resized(40, 30)
    bright = float(render(scene, poses_wc, small.intrinsics, 30, 40).images.mean())
    gain = (sensor.exposure / max(bright, 0.02)) ** 0.8 if sensor.exposure is not None else 1.0
    red, green, blue = sensor.balance
    return replace(sensor, exposure=None, flicker=0.0, balance=(red * gain, green * gain, blue * gain))
